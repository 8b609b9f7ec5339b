"""The patches of a frame, sorted into regions: what finding the fringe orders sees of unwrapping."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels.arrays import F32, I32, U8
from tikernels.depth.triangulation import ProjectorGeometry
from tikernels.errors import ShapeError
from tikernels.unwrapping.drafts import Drafts
from tikernels.unwrapping.hidden_steps import mark_hidden_steps_kernel
from tikernels.unwrapping.region_placing import choose_starts_kernel, place_regions_kernel
from tikernels.unwrapping.region_writing import finish_patches_kernel, write_unwrapped
from tikernels.unwrapping.surface_borders import Borders
from tikernels.unwrapping.table_columns import columns_at, first_columns, put_columns
from tikernels.unwrapping.tables import CONTACT_BITS, Cell, Contact, Patch, Region, cells_of, numbers_of

#: Regions smaller than a cell are noise or slivers behind a step, whose order means nothing.
MIN_REGION_PX = 128
# Below this many patches or contacts one CPU thread is done before others have woken up ten times a round.
_SERIAL = 12000


def one_thread_is_faster(count: int) -> bool:
    """Return whether one thread is done with this many patches or contacts before others have woken up."""
    return runtime.started() == "cpu" and count < _SERIAL


class PatchGraph(NamedTuple):
    """Patches, and the contacts inside a region that agree with its orders."""

    root: npt.NDArray[np.int32]
    """(P,) the patch that stands for the region."""
    offset: npt.NDArray[np.int32]
    """(P,) what its orders lack to be the region's."""
    pixels: npt.NDArray[np.int32]
    """(P,) how many it has."""
    first: npt.NDArray[np.int32]
    """(P,) its first pixel, row * width + column."""
    ends: npt.NDArray[np.int32]
    """(2, C) the two patches of each contact."""
    votes: npt.NDArray[np.int32]
    """(C,) how well each contact is supported."""
    borders: Borders | None = None
    """Evidence of the borders of all patches; None: none were measured."""


class RegionTable(NamedTuple):
    """The regions that were written, from number 1 on: the largest first."""

    roots: npt.NDArray[np.int64]
    """(regions,) the patch that stands for each."""
    pixels: npt.NDArray[np.int32]
    """(regions,) how many pixels each had when it was joined."""


class Patches:
    """The patches of one frame; valid until the next one is joined, for the buffers are the unwrapper's.

    Parameters
    ----------
    count : int
        Number of patches.
    drafts : Drafts
        Labels, and contacts as they were noted; numbered.
    table : (11, capacity) int32
        See `Patch`; roots and offsets are settled.
    region_table : (4, capacity) int32
        See `Region`; written.
    final : (3, capacity) int32
        See `Final`; what `write` needs.
    seams : (2, cells) int32
        See `Seam`; scratch.
    """

    def __init__(self, count: int, drafts: Drafts, table: I32, region_table: I32, final: I32, seams: I32) -> None:
        self.count = count
        self.cells = drafts.cells
        self.labels = drafts.labels
        self.cell_table = drafts.cell_table
        self.draft_bits = drafts.bits
        self.table = table
        self.final = final
        self._draft_contacts = drafts.contacts
        self._regions = region_table
        self._seams = seams
        # What the host has read of the table: nobody but `split` and `shift_orders` changes it from here on.
        self._read: npt.NDArray[np.int32] | None = None
        #: What the patches' borders show; None: none were measured.
        self.borders: Borders | None = None
        #: (P,) the patch that stands for the region which each patch's region goes on with most, though not enough to
        #: be one with it; its own where there is none. None: nothing was parted.
        self.beside: npt.NDArray[np.int32] | None = None
        self._choose_starts()

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the frame."""
        return int(self.labels.shape[0]), int(self.labels.shape[1])

    def roots(self) -> npt.NDArray[np.int32]:
        """Return (P,) int32: the patch that stands for the region of each patch."""
        return np.array(self._columns()[Patch.ROOT], np.int32)  # synchronises

    def graph(self) -> PatchGraph:
        """Return the patches, and where they touch inside their regions."""
        table = self._columns()  # synchronises
        ends, shift, votes = self._contacts
        offset, root = table[Patch.OFFSET].copy(), table[Patch.ROOT].copy()
        agree = offset[ends[1]] == offset[ends[0]] + shift
        agree &= (root[ends[0]] == root[ends[1]]) & (ends[0] != ends[1])
        ends, votes = ends.compress(agree, axis=1), votes.compress(agree)
        pixels, first = table[Patch.PIXELS].copy(), table[Patch.FIRST].copy()
        return PatchGraph(root, offset, pixels, first, ends, votes, self.borders)

    def shift_orders(self, shifts: npt.NDArray[np.integer]) -> None:
        """Add whole cycles to the orders of single patches, which other regions are to have; see `split`.

        Parameters
        ----------
        shifts : (P,) int
            For each patch.

        Raises
        ------
        ShapeError
            There is not one for each patch.
        """
        if np.shape(shifts) != (self.count,):
            raise ShapeError(f"shifts has shape {np.shape(shifts)}, expected one for each of {self.count} patches")
        table = self._columns()
        table[Patch.OFFSET] += shifts
        put_columns(table, self.table)

    def split(self, roots: npt.NDArray[np.int32], left_out: npt.NDArray[np.bool_] | None = None) -> None:
        """Make regions of the patches that share a root, which is one of them; their orders stay.

        Parameters
        ----------
        roots : (P,) int32
            The patch that stands for each patch's region.
        left_out : (P,) bool, optional
            Patches that count no pixels from now on, and are not written.

        Raises
        ------
        ShapeError
            There is not one root for each patch, or one is not the number of a patch.
        """
        if np.shape(roots) != (self.count,):
            raise ShapeError(f"roots has shape {np.shape(roots)}, expected one for each of {self.count} patches")
        self._check_numbers("roots", roots)
        table = self._columns()
        table[Patch.ROOT] = roots
        if left_out is not None:
            table[Patch.PIXELS][left_out] = 0
        put_columns(table, self.table)
        self._choose_starts()

    def set_orders(self, roots: npt.NDArray[np.integer], orders: npt.NDArray[np.integer]) -> None:
        """Add these whole cycles to the orders that the regions with these roots had when they were joined.

        Where a root is named twice, the last order counts.

        Parameters
        ----------
        roots : (R,) int
            The patches that stand for the regions.
        orders : (R,) int
            Whole cycles for each.

        Raises
        ------
        ShapeError
            There is not one order for each root, or a root is not the number of a patch.
        """
        self._check_numbers("roots", roots)
        if np.shape(orders) != np.shape(roots):
            raise ShapeError(f"orders has shape {np.shape(orders)}, expected {np.shape(roots)}: one for each root")
        if len(roots) == 0:
            return
        regions = first_columns(self._regions, self.count)
        regions[Region.ORDER, roots] = -orders
        put_columns(regions, self._regions)

    def orders(self, roots: npt.NDArray[np.integer]) -> npt.NDArray[np.int32]:
        """Return the whole cycles that are added to the orders of the regions with these roots."""
        return np.array(-first_columns(self._regions, self.count)[Region.ORDER, roots], np.int32)  # synchronises

    def place(self, phase: F32, rays: F32, projector: ProjectorGeometry, depth_mm: float) -> None:
        """Give every region the orders that bring it nearest to a depth, instead of 0 at its start.

        Parameters
        ----------
        phase : (H, W) float32
            rad in [-pi, pi].
        rays : (H, W, 2) float32
            x and y of every camera pixel's ray at unit depth.
        projector : ProjectorGeometry
            The projector's pose.
        depth_mm : float
            Expected depth of the object.

        Raises
        ------
        ShapeError
            A shape or dtype is another one.
        """
        phase = checks.read_array("phase", phase, self.shape, np.float32)
        rays = checks.read_array("rays", rays, (*self.shape, 2), np.float32)
        packed, axis, _ = projector.arguments()
        arguments = (self.count, phase, self.labels, rays, depth_mm, packed, axis)
        place_regions_kernel(one_thread_is_faster(self.count), *arguments, self.table, self._regions)

    def write(
        self, phase: F32, brightness: F32, rates: F32, out_unwrapped: F32, out_mask: U8, out_region: I32
    ) -> RegionTable:
        """Write the unwrapped phase, the mask, and the region.

        The last pixel before a step is left out, and so are cells that hide a step; see `region_writing.py`.

        Parameters
        ----------
        phase : (H, W) float32
            rad in [-pi, pi].
        brightness : (H, W) float32
            Of the surface, without the fringe; up to a factor.
        rates : (N, 5) float32
            Results of `measure_rates`.
        out_unwrapped : (H, W) float32
            rad; NaN outside the mask.
        out_mask : (H, W) uint8
            1 inside.
        out_region : (H, W) int32
            The region's number, from 1, the largest; 0 outside.

        Returns
        -------
        RegionTable
            The regions, by number.

        Raises
        ------
        ShapeError
            A shape or dtype is another one, or an output cannot be written.
        """
        phase = checks.read_array("phase", phase, self.shape, np.float32)
        brightness = checks.read_array("brightness", brightness, self.shape, np.float32)
        rates = checks.read_array("rates", rates, (None, 5), np.float32)
        out_unwrapped = checks.out_array("out_unwrapped", out_unwrapped, self.shape, np.float32)
        out_mask = checks.out_array("out_mask", out_mask, self.shape, np.uint8)
        out_region = checks.out_array("out_region", out_region, self.shape, np.int32)
        # Numbering a handful of regions by their size is the host's work; ties go to the start's place in the image.
        regions = first_columns(self._regions, self.count)  # synchronises
        roots = np.flatnonzero(regions[Region.PIXELS] >= MIN_REGION_PX)
        roots = roots[np.lexsort((regions[Region.START, roots], -regions[Region.PIXELS, roots]))]
        numbers = np.zeros(max(self.count, 1), np.int32)
        numbers[roots] = np.arange(1, len(roots) + 1)
        pixels = regions[Region.PIXELS, roots]
        tables = (self.table, self._draft_contacts, self._regions, numbers)
        cells = (self.cells, cells_of(*self.shape)[1], self.cell_table, self.draft_bits)
        finish_patches_kernel(one_thread_is_faster(self.count), *cells, *tables, self.final)
        mark_hidden_steps_kernel(phase, brightness, rates, self.labels, self._seams, self.final)
        write_unwrapped(phase, rates, self.labels, self.final, out_unwrapped, out_mask, out_region)
        return RegionTable(roots, pixels)

    @cached_property
    def _contacts(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """(2, C) the patches of each contact that was noted, (C,) its shift, and (C,) its votes."""
        cells = runtime.to_host(self.cell_table)  # synchronises
        counts = np.diff(cells[Cell.CONTACTS])
        within = np.arange(cells[Cell.CONTACTS, -1]) - np.repeat(cells[Cell.CONTACTS, :-1], counts)
        cell = np.repeat(np.arange(self.cells), counts)
        noted = columns_at(self._draft_contacts, (cell << (self.draft_bits + CONTACT_BITS)) + within)
        ends = numbers_of(noted[[Contact.FROM, Contact.TO]], cells, self.draft_bits)
        return ends, noted[Contact.SHIFT], noted[Contact.VOTES]

    def _columns(self) -> npt.NDArray[np.int32]:
        """Return the table's columns, (11, P): on the CPU a look at them, on a GPU a copy."""
        if self._read is None:
            self._read = first_columns(self.table, self.count)  # synchronises
        return self._read

    def _check_numbers(self, name: str, numbers: npt.NDArray[np.integer]) -> None:
        """Refuse what are not the numbers of patches: as indices they would write beyond the patches' rows."""
        if numbers.ndim != 1 or not np.issubdtype(numbers.dtype, np.integer):
            raise ShapeError(f"{name} is {numbers.ndim}-dimensional {numbers.dtype}, expected a row of integers")
        if numbers.size and not (numbers.min() >= 0 and numbers.max() < self.count):
            raise ShapeError(
                f"{name} holds {numbers.min()} to {numbers.max()}, expected numbers of patches, 0 to {self.count - 1}"
            )

    def _choose_starts(self) -> None:
        serial = one_thread_is_faster(self.count)
        choose_starts_kernel(serial, self.count, self.labels, self.table, self._regions)
