"""The ways to sort pixels into patches; to add one, write it here and name it in `METHODS`."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels.arrays import F32, I32
from tikernels.phase.smoothing import MAX_DEPARTURE
from tikernels.unwrapping.drafts import Drafts
from tikernels.unwrapping.edge_reliability import NO_EDGE, weigh_edges_kernel
from tikernels.unwrapping.patch_contacts import note_borders_kernel
from tikernels.unwrapping.patch_growing import grow_patches_kernel
from tikernels.unwrapping.spanning_forest import grow_trees_kernel
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH, Edge, Tree, cells_of
from tikernels.unwrapping.tree_contacts import join_trees_kernel, note_contacts_kernel, root_trees_kernel

# A cell drafts up to 2^3 patches, and four times as many contacts: clean surfaces need one and two. Where noise needs
# more, the drafts grow.
_RUN_DRAFT_BITS = 3
# Trees in a cell: 14 on average, whatever the noise.
_TREE_DRAFT_BITS = 5


class PatchMethod(Protocol):
    """How pixels are sorted into patches, and what is known of patches that touch."""

    draft_bits: int
    """A cell has places for 2^draft_bits patches at first."""
    adds_votes: bool
    """Whether contacts between the same regions that agree on the shift have their votes added up."""
    parts_regions: bool = False
    """Whether regions that hang together by the smaller part of a border are parted."""

    def grow(self, phase: F32, quality: F32, rates: F32, drafts: Drafts) -> None:
        """Sort the pixels of every cell into patches, and note their contacts.

        A cell that needs more places than it has counts on, and is done again when there are.

        Parameters
        ----------
        phase : (H, W) float32
            rad in [-pi, pi]; NO_PHASE outside the mask, STEP_PHASE between two surfaces.
        quality : (H, W) float32
            Larger is better; the modulation.
        rates : (N, 5) float32
            What `measure_rates` found.
        drafts : Drafts
            What is written.
        """

    def hang_together(self, drafts: Drafts, table: I32) -> None:
        """Hang patches that belong together without a contact under one of them: see `Patch.HEAD` and its shift.

        Parameters
        ----------
        drafts : Drafts
            Its cells are numbered.
        table : (12, capacity) int32
            See `Patch`; each is a region of its own.
        """
        return

    def complete_graph(
        self, heads: npt.NDArray[np.int32], ends: npt.NDArray[np.int32], votes: npt.NDArray[np.int32]
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """Return the ends and votes of the contacts inside regions, with what holds together without a contact.

        Parameters
        ----------
        heads : (P,) int32
            `Patch.HEAD` of every patch.
        ends : (2, C) int32
            The two patches of each contact.
        votes : (C,) int32
            Their votes.
        """
        return ends, votes


class VotedRuns(PatchMethod):
    """Row runs without a doubt inside, which join the run above by a vote over their whole contact.

    The paper (sections 4.1 and 4.2 of Je, Lee and Park 2004) grows one region pixel by pixel from a bright start near
    the centre, by priority of intensity, location and direction; here all cells grow at once.
    """

    draft_bits, adds_votes, parts_regions = _RUN_DRAFT_BITS, True, True

    def __init__(self, height: int, width: int) -> None:
        pass

    def grow(self, phase: F32, quality: F32, rates: F32, drafts: Drafts) -> None:
        """See `PatchMethod.grow`."""
        growing = (phase, quality, rates, drafts.bits, drafts.labels)
        grow_patches_kernel(*growing, drafts.patches, drafts.contacts, drafts.cell_table)
        note_borders_kernel(*growing, drafts.contacts, drafts.cell_table)


class SpanningForest(PatchMethod):
    """The spanning forest of the most reliable edges between pixels, those of least second difference.

    scikit-image's `unwrap_phase` goes by the same edges. Unwrapping by it takes three times as long as by `VotedRuns`.

    Parameters
    ----------
    height, width : int
        Size of the frames.
    max_departure : float
        Largest departure between neighbours on one surface, rad.

    References
    ----------
    M. Arevallilo Herraez et al., Applied Optics 41, 7437 (2002), doi:10.1364/AO.41.007437.
    """

    draft_bits, adds_votes = _TREE_DRAFT_BITS, False

    def __init__(self, height: int, width: int, max_departure: float = MAX_DEPARTURE) -> None:
        rows, columns = cells_of(height, width)
        self._max_departure = max_departure
        self._edges: I32 = runtime.empty((len(Edge), rows * CELL_HEIGHT + 1, columns * CELL_WIDTH + 1), np.int32)
        self._trees: I32 = runtime.empty((len(Tree), rows * columns << self.draft_bits), np.int32)

    def grow(self, phase: F32, quality: F32, rates: F32, drafts: Drafts) -> None:
        """See `PatchMethod.grow`."""
        if self._trees.shape[1] != drafts.patches.shape[1]:
            self._trees = runtime.empty((len(Tree), int(drafts.patches.shape[1])), np.int32)
        drafting = (drafts.bits, drafts.labels)
        weigh_edges_kernel(phase, rates, self._max_departure, self._edges)
        grow_trees_kernel(self._edges, quality, rates, *drafting, drafts.patches, self._trees, drafts.cell_table)
        join_trees_kernel(drafts.cells, self._edges, rates, *drafting, drafts.cell_table, self._trees)
        note_contacts_kernel(self._edges, rates, *drafting, self._trees, drafts.contacts, drafts.cell_table)

    def hang_together(self, drafts: Drafts, table: I32) -> None:
        """Hang every patch under the root of its tree; only trees have contacts."""
        root_trees_kernel(drafts.cells, drafts.bits, self._trees, drafts.cell_table, table)

    def complete_graph(
        self, heads: npt.NDArray[np.int32], ends: npt.NDArray[np.int32], votes: npt.NDArray[np.int32]
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """Return the contacts with the links inside trees, which are of better edges than any between trees."""
        pieces = np.setdiff1d(np.flatnonzero(heads != np.arange(len(heads))), ends).astype(np.int32)
        ends = np.concatenate([np.stack([heads[pieces], pieces]), ends], axis=1)
        # An edge twice as reliable is worth twice as much.
        links = np.full(len(pieces), NO_EDGE, np.int32)
        return ends, np.concatenate([links, NO_EDGE // np.maximum(NO_EDGE - votes, 1)])


#: Every method by name, and how it is made for frames of a height and width, stripes along the rows.
METHODS: dict[str, Callable[[int, int], PatchMethod]] = {"directional": VotedRuns, "reliability": SpanningForest}
