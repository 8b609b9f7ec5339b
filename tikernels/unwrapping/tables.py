"""Tables of unwrapping, row by row: of pixels, cells, patches, contacts and regions.

A *cell* is a rectangle of 8 x 16 pixels. A *patch* is what surely belongs together of a cell's pixels, with orders that
count from its own zero. A *contact* is where two patches touch: it shows by how much the zeros of their orders differ,
and how well that is supported. Patches that contacts have joined are a *region*, of which one patch is the *root*. A
*shift* is the whole cycles to add to one patch's orders to make them count from another one's zero; a *step* is one of
the surface, across which nothing joins.

Cells are worked on at the same time, so each first writes its patches and contacts as *drafts* to places of its own:
`cell << bits` and the following ones. Then they are numbered without gaps. Counters that all threads share would do
without drafts, but their order is chance, and Mesa's software Vulkan loses threads that wait for one inside a loop.

Every pixel has a label: its draft of a patch and, in the lowest six bits, its order in the patch plus ORDER_ZERO.
"""

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from tikernels._taichi import I32Array2, Static, i32, ti

# Short along the stripe: where a hidden step of whole cycles slips into a run, at most half a cell is wrong.
CELL_WIDTH, CELL_HEIGHT = 8, 16
# An order inside a patch stays within the cell's +-24 pixels, which six bits hold.
# Shifts, because Taichi's integer division rounds down and branches to do so.
ORDER_BITS, ORDER_MASK, ORDER_ZERO = 6, 63, 32
#: Labels of pixels without a phase, and of those that saw two surfaces.
NOTHING, BETWEEN = -1, -2
#: 2^32 / golden ratio, odd: multiplying by it shuffles the 32-bit numbers one to one.
GOLDEN = -1640531527
#: A cell has 2^2 times as many places for contacts as for patches: noise makes that many.
CONTACT_BITS = 2
#: Larger than whatever is compared with it.
MOST = 2**31 - 1


class Patch(IntEnum):
    """Rows of the table of patches; drafts have the first two."""

    PIXELS = 0  # how many it has
    FIRST = 1  # its first pixel, row * width + column
    ROOT = 2  # the patch that stands for its region
    OFFSET = 3  # whole cycles to add to its orders to make them the region's
    PARENT = 4  # in a round of joining: the region that this root is joined to,
    PARENT_SHIFT = 5  # and the shift from there to here
    HEAD = 6  # the root that this patch has been joined to, directly or through others,
    HEAD_SHIFT = 7  # and the shift from there to here
    SUPPORT = 8  # scratch: votes of the best contact; a start's score
    KEY = 9  # scratch: name of the best contact
    CHOICE = 10  # scratch: the best contact


class Contact(IntEnum):
    """Rows of the table of contacts: each claims that a patch's OFFSET is that of another one plus a shift."""

    FROM = 0  # the other patch,
    TO = 1  # the one patch,
    SHIFT = 2  # and the shift from there to here
    VOTES = 3  # how well it is supported; 0: it is spent
    NAME = 4  # different for each, and in no order: it decides between equal votes


class Cell(IntEnum):
    """Rows of the table of cells, which has a column more than there are cells."""

    PATCHES = 0  # how many it has; once they are numbered, the first one's number
    CONTACTS = 1  # the same
    STEPS = 2  # 1 where it holds a pixel between surfaces or of too small a region, or a contact that was overruled


class Region(IntEnum):
    """Rows of the table of regions, by their roots."""

    PIXELS = 0
    SCORE = 1  # of its best start
    START = 2  # the start: row * width + column of a patch's first pixel
    ORDER = 3  # what is taken off its orders


class Final(IntEnum):
    """Rows of what is needed to write the result: the first two by the draft of a patch, the third by cell."""

    REGION = 0  # number from 1, the largest first; 0: too small
    ORDER = 1  # what to add to a label's order bits to have its order
    STEPS = 2  # 0, or one of the two below


#: A cell or one next to it has steps, so its pixels are checked one by one; or its borders show that a step of whole
#: cycles is hidden in it, so none of its pixels is written.
HAS_STEPS, HIDES_STEP = 1, 2


class Counter(IntEnum):
    """Places of the counters."""

    PATCHES = 0
    CONTACTS = 1
    MERGED = 2  # 1 if a round has joined anything
    CROWDED = 3  # the most patches, or a quarter of the most contacts, that any cell has


class Seam(IntEnum):
    """Rows of the scratch that counts border pixels whose phase goes on, but not their orders."""

    RIGHT = 0
    BELOW = 1


class Match(IntEnum):
    """Rows of the table in which contacts that say the same find each other; see `table_place`."""

    NAME = 0  # the smallest name of those that need this place
    CONTACT = 1  # whose name it is
    VOTES = 2  # of the others that say the same


def cells_of(height: int, width: int) -> tuple[int, int]:
    """Return how many rows and columns of cells an image has."""
    return -(-height // CELL_HEIGHT), -(-width // CELL_WIDTH)


def numbers_of(drafts: npt.NDArray[np.int32], cells: npt.NDArray[np.int32], bits: int) -> npt.NDArray[np.int32]:
    """Return the numbers of drafted patches, given the table of cells; see `patch_number`."""
    return np.asarray(cells[Cell.PATCHES, drafts >> bits] + (drafts & ((1 << bits) - 1)), np.int32)


@ti.func
def cell_bounds(cell: i32, height: i32, width: i32):
    """Return a cell's first row and column, and those past its last."""
    columns = (width + CELL_WIDTH - 1) // CELL_WIDTH
    top, left = (cell // columns) * CELL_HEIGHT, (cell % columns) * CELL_WIDTH
    return top, left, ti.min(top + CELL_HEIGHT, height), ti.min(left + CELL_WIDTH, width)


@ti.func
def cell_count(height: i32, width: i32) -> i32:
    """Return how many cells an image has."""
    return ((width + CELL_WIDTH - 1) // CELL_WIDTH) * ((height + CELL_HEIGHT - 1) // CELL_HEIGHT)


@ti.func
def step_to(side: i32):
    """Return by how many rows and columns the next pixel on a side lies further: above, below, left, right."""
    way = 2 * (side % 2) - 1
    return ti.select(side < 2, way, 0), ti.select(side < 2, 0, way)


@ti.func
def patch_number(draft: i32, cells: I32Array2, draft_bits: i32) -> i32:
    """Return the number of a drafted patch."""
    return cells[Cell.PATCHES, draft >> draft_bits] + (draft & ((1 << draft_bits) - 1))


@ti.func
def add_alone(entry: Static, more: Static):
    """Add to an entry that only this thread writes: Taichi's "+=" on an array is atomic, which costs time."""
    entry = entry + more
