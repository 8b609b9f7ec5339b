"""Drafts of the patches and contacts of each cell, before they are numbered."""

import numpy as np

from tikernels import runtime
from tikernels.arrays import I32
from tikernels.unwrapping.tables import CONTACT_BITS, Cell, Contact, Patch, cells_of


class Drafts:
    """Labels of the pixels, and for every cell places of its own for patches and contacts.

    Parameters
    ----------
    height, width : int
        Size of the frames.
    bits : int
        A cell has places for 2^bits patches, and four times as many contacts.

    Attributes
    ----------
    labels : (H, W) int32
        Draft of a patch and order inside it.
    cell_table : (3, cells + 1) int32
        See `Cell`: how many patches and contacts each cell has, more than there are places for if it is crowded.
    patches : (2, cells << bits) int32
        See `Patch`: pixels and first pixel.
    contacts : (5, 4 cells << bits) int32
        See `Contact`, between drafts of patches.
    """

    patches: I32
    contacts: I32

    def __init__(self, height: int, width: int, bits: int) -> None:
        rows, columns = cells_of(height, width)
        self.cells = rows * columns
        self.labels: I32 = runtime.empty((height, width), np.int32)
        self.cell_table: I32 = runtime.empty((len(Cell), self.cells + 1), np.int32)
        self.make_room(bits)

    def make_room(self, bits: int) -> None:
        """Give every cell places for 2^bits patches; what was drafted is lost."""
        self.bits = bits
        self.patches = runtime.empty((1 + Patch.FIRST, self.cells << bits), np.int32)
        self.contacts = runtime.empty((len(Contact), self.cells << (bits + CONTACT_BITS)), np.int32)
