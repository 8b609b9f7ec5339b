"""Find the order of every fringe from its neighbours: patches, joined along the best supported contacts first.

In every cell, unambiguous row runs join the run above by a vote over their whole contact (`patch_growing.py`): they
form patches, and it is noted where two patches touch. The patches are then joined in rounds (`region_merging.py`):
every region joins the neighbour with which its contact is the best supported. The result does not depend on the number
of threads. Nothing is joined across a step, and regions that only touch where the step is a whole cycle are parted
again (`region_parting.py`). So a surface that nothing connects to the rest becomes a region of its own, whose start is
its reliable pixel nearest the image's centre.

The paper (sections 4.1 and 4.2 of Je, Lee and Park 2004) grows one region pixel by pixel from a bright start near the
centre, by priority of intensity, location and direction; here all cells grow at once.
"""

import numpy as np

from tikernels import checks, runtime
from tikernels.arrays import F32, I32, Mask
from tikernels.errors import ShapeError
from tikernels.phase.phase_change import measure_rates
from tikernels.phase.wrapped_phase import mark_no_phase_kernel
from tikernels.transposing import transpose
from tikernels.unwrapping.drafts import Drafts
from tikernels.unwrapping.even_light import patches_of_even_light
from tikernels.unwrapping.given_regions import GivenRegions
from tikernels.unwrapping.patch_contacts import note_borders_kernel
from tikernels.unwrapping.patch_growing import grow_patches_kernel
from tikernels.unwrapping.patch_numbering import collect_patches_kernel, number_patches_kernel
from tikernels.unwrapping.patch_slopes import measure_slopes
from tikernels.unwrapping.patches import Patches, one_thread_is_faster
from tikernels.unwrapping.region_merging import close_gaps_kernel, merge_patches_kernel, settle_patches_kernel
from tikernels.unwrapping.region_parting import part_regions, regions_that_step, set_apart
from tikernels.unwrapping.surface_borders import measure_borders, sample_cells
from tikernels.unwrapping.tables import Contact, Counter, Final, Match, Patch, Region, Seam
from tikernels.unwrapping.union_find import rounds_at_once

# Rounds of joining regions that a GPU does before it is queried whether anything was left: eight are usual.
_ROUNDS_AT_ONCE = 4
# A cell drafts up to 2^3 patches, and four times as many contacts: clean surfaces need one and two. Where noise needs
# more, the drafts grow.
_DRAFT_BITS = 3


class RegionUnwrapper:
    """Buffers to unwrap frames of one size, stripes along the rows.

    Parameters
    ----------
    height, width : int
        Size of the frames.
    given : GivenRegions, optional
        Source of the patches instead of growing; they are not parted.
    """

    _table: I32
    _contacts: I32
    _regions: I32
    _final: I32

    def __init__(self, height: int, width: int, given: GivenRegions | None = None) -> None:
        self.shape = (height, width)
        self._given = given
        self._drafts = Drafts(height, width, _DRAFT_BITS)
        cells = self._drafts.cells
        self._counters: I32 = runtime.empty((len(Counter),), np.int32)
        self._seams: I32 = runtime.empty((len(Seam), cells), np.int32)
        # Crowded in the first round, where hardly any two contacts claim the same, and nearly empty when the large
        # regions meet.
        self._matches: I32 = runtime.empty((len(Match), 2 ** int(np.ceil(np.log2(4 * cells)))), np.int32)
        self._allocate()

    def _allocate(self) -> None:
        patches, contacts = (int(drafts.shape[1]) for drafts in (self._drafts.patches, self._drafts.contacts))
        self._table = runtime.empty((len(Patch), patches), np.int32)
        self._contacts = runtime.empty((len(Contact), contacts), np.int32)
        self._regions = runtime.empty((len(Region), patches), np.int32)
        self._final = runtime.empty((len(Final), patches), np.int32)

    def join(self, phase: F32, quality: F32, rates: F32) -> Patches:
        """Sort the pixels into patches and the patches into regions.

        Parameters
        ----------
        phase : (H, W) float32
            rad in [-pi, pi]; NO_PHASE outside the mask.
        quality : (H, W) float32
            Larger is better; the modulation.
        rates : (N, 5) float32
            Results of `measure_rates`.

        Returns
        -------
        Patches
            Valid until the next call.

        Raises
        ------
        ShapeError
            A shape or dtype is another one.
        """
        phase = checks.read_array("phase", phase, self.shape, np.float32)
        quality = checks.read_array("quality", quality, self.shape, np.float32)
        rates = checks.read_array("rates", rates, (None, 5), np.float32)
        count, contacts = self._grow(phase, quality, rates)
        drafts, table = self._drafts, self._table
        noted = (drafts.cells, drafts.bits, drafts.patches, drafts.contacts, drafts.cell_table)
        collect_patches_kernel(one_thread_is_faster(contacts), *noted, table, self._contacts)
        self._merge(contacts)
        settle_patches_kernel(one_thread_is_faster(count), count, table)
        patches = Patches(count, drafts, table, self._regions, self._final, self._seams)
        if self._given is None:
            self._part(patches, phase, quality, rates)
        return patches

    def _part(self, patches: Patches, phase: F32, quality: F32, rates: F32) -> None:
        """Leave out cells of even light, and part regions that are connected by less than most of a border."""
        of_patches = (patches.labels, patches.cell_table, patches.draft_bits)
        samples = sample_cells(phase, rates, patches.labels)
        even = patches_of_even_light(samples.changes, patches.cell_table, patches.count)
        if even.any():
            patches.split(set_apart(patches.roots(), even).astype(np.int32), even)
        patches.borders = measure_borders(phase, quality, rates, *of_patches, patches.table, samples.departures)
        if regions_that_step(patches.roots(), patches.borders).any():
            slopes = measure_slopes(phase, *of_patches, patches.count)
            roots, slivers, beside = part_regions(patches.graph(), patches.borders, slopes)
            patches.split(roots, slivers)
            patches.beside = beside

    def _grow(self, phase: F32, quality: F32, rates: F32) -> tuple[int, int]:
        """Draft patches, with more places if a cell is crowded; return how many patches and contacts there are."""
        drafts = self._drafts
        while True:
            growing = (phase, quality, rates, drafts.bits, drafts.labels)
            if self._given is None:
                grow_patches_kernel(*growing, drafts.patches, drafts.contacts, drafts.cell_table)
                note_borders_kernel(*growing, drafts.contacts, drafts.cell_table)
            else:
                self._given.grow(phase, quality, drafts)
            at_once = rounds_at_once()
            for first in range(0, drafts.cells, at_once):
                stop = min(first + at_once, drafts.cells)
                number_patches_kernel(first, stop, drafts.cell_table, self._counters)
            counts = runtime.to_host(self._counters)  # synchronises
            crowded = int(counts[Counter.CROWDED])
            if crowded <= 1 << drafts.bits:
                break
            drafts.make_room((crowded - 1).bit_length())
        if self._table.shape[1] != drafts.patches.shape[1]:
            self._allocate()
        return int(counts[Counter.PATCHES]), int(counts[Counter.CONTACTS])

    def _merge(self, contacts: int) -> None:
        """Join regions round by round until no contact is left between two of them."""
        tables = (self._table, self._contacts, self._matches, self._counters)
        # To query a GPU whether anything is left takes longer than a round in which nothing is.
        rounds = 1 if runtime.started() == "cpu" else _ROUNDS_AT_ONCE
        while True:
            for _ in range(rounds):
                merge_patches_kernel(one_thread_is_faster(contacts), contacts, *tables)
            if runtime.to_host(self._counters)[Counter.MERGED] == 0:  # synchronises
                break
            # A GPU passes over spent contacts faster than one of its threads could close the gaps.
            if runtime.started() == "cpu":
                close_gaps_kernel(contacts, self._contacts, self._counters)
                contacts = int(runtime.to_host(self._counters)[Counter.CONTACTS])


def unwrap_phase(
    wrapped_phase: F32,
    quality: F32,
    mask: Mask,
    stripes: str = "horizontal",
    *,
    out: F32 | None = None,
) -> F32:
    """Unwrap a phase map, across no step: where neighbours change by 0.8 rad more or less than usual.

    Parameters
    ----------
    wrapped_phase : (H, W) float32
        rad in [-pi, pi].
    quality : (H, W) float32
        Larger is better; usually the modulation.
    mask : (H, W) bool or uint8
        Valid pixels.
    stripes : {"horizontal", "vertical"}
        "horizontal" where the phase changes from row to row.
    out : (H, W) float32, optional
        Output array.

    Returns
    -------
    (H, W) float32
        Wrapped phase plus whole cycles, rad; NaN outside the mask, in specks of fewer than 128 pixels, and in cells
        that contradict their neighbours. Each connected region has order 0 at its start, the reliable pixel nearest
        the image's centre.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, `stripes` is unknown, or `out` cannot be written.

    Examples
    --------
    >>> import numpy as np, tikernels
    >>> _ = tikernels.init("cpu")
    >>> true = np.broadcast_to(0.5 * np.arange(64, dtype=np.float32)[:, None], (64, 48))
    >>> wrapped = (true - 2 * np.pi * np.round(true / (2 * np.pi))).astype(np.float32)
    >>> ones = np.ones((64, 48), np.float32)
    >>> unwrapped = unwrap_phase(wrapped, ones, ones > 0)
    >>> round(float(np.ptp(unwrapped)), 2)
    31.5
    """
    if stripes not in ("horizontal", "vertical"):
        raise ShapeError(f"stripes is {stripes!r}: choose horizontal or vertical")
    wrapped_phase = checks.read_array("wrapped_phase", wrapped_phase, (None, None), np.float32)
    shape = (int(wrapped_phase.shape[0]), int(wrapped_phase.shape[1]))
    quality = checks.read_array("quality", quality, shape, np.float32)
    mask = checks.read_mask("mask", mask, shape)
    out = checks.out_array("out", out, shape, np.float32)
    phase = runtime.empty(shape, np.float32)
    mark_no_phase_kernel(wrapped_phase, mask, phase)
    result = out
    if stripes == "vertical":
        phase, quality, shape = transpose(phase), transpose(quality), shape[::-1]
        result = runtime.empty(shape, np.float32)
    unwrapper = RegionUnwrapper(*shape)
    rates = measure_rates(phase, quality)
    patches = unwrapper.join(phase, quality, rates)
    patches.write(phase, quality, rates, result, runtime.empty(shape, np.uint8), runtime.empty(shape, np.int32))
    if stripes == "vertical":
        transpose(result, out)
    return out
