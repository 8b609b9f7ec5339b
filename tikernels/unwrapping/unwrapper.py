"""Find the order of every fringe from its neighbours: patches, joined along the best supported contacts first.

Two ways to make patches, cell by cell of 8 x 16 pixels, and to judge their contacts:

- "directional": row runs without a doubt inside, which join the run above by a vote over their whole contact (sections
  4.1 and 4.2 of Je, Lee and Park 2004; `patches.py`). The paper grows one region pixel by pixel from a bright start
  near the centre, by priority of intensity, location and direction; here all cells grow at once. Contacts that agree
  on the shift have their votes added up.
- "reliability": the spanning forest of the most reliable edges between pixels (`reliability.py`, `trees.py`).

The patches are then joined in rounds (`merging.py`): every region joins the neighbour with which its contact is the
best supported. The result does not depend on the number of threads. Nothing is joined across a step, so a surface that
nothing connects to the rest becomes a region of its own, whose start is its reliable pixel nearest the image's centre.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import _checks, runtime
from tikernels._taichi import (
    F32Array1,
    F32Array2,
    F32Array3,
    I32Array1,
    I32Array2,
    Static,
    U8Array2,
    f32,
    i32,
    ti,
    vec3,
)
from tikernels.depth.triangulation import ProjectorGeometry, load_projector, projected
from tikernels.errors import ShapeError
from tikernels.phase.phase_vector import PI
from tikernels.phase.smoothing import MAX_DEPARTURE, measure_rates_kernel, rates_buffer
from tikernels.phase.wrapped_phase import mark_no_phase_kernel
from tikernels.strips import STRIP
from tikernels.transposing import transpose
from tikernels.unwrapping.edge_reliability import NO_EDGE, weigh_edges_kernel
from tikernels.unwrapping.hidden_steps import TORN, mark_torn_cells_kernel
from tikernels.unwrapping.patch_growing import (
    BETWEEN,
    CELL_HEIGHT,
    CELL_WIDTH,
    FIRST,
    FROM,
    HEAD,
    KEY,
    N_CONTACTS,
    N_CROWDED,
    N_MERGED,
    N_PATCHES,
    OFFSET,
    ORDER_BITS,
    ORDER_MASK,
    ORDER_ZERO,
    PIXELS,
    ROOT,
    SHIFT,
    SUPPORT,
    TO,
    VOTES,
    WEIGHT,
    collect_patches_kernel,
    grow_patches_kernel,
    note_borders_kernel,
    number_patches_kernel,
    patch_number,
)
from tikernels.unwrapping.region_merging import close_gaps_kernel, merge_patches_kernel, settle_patches_kernel
from tikernels.unwrapping.spanning_forest import (
    grow_trees_kernel,
    join_trees_kernel,
    note_contacts_kernel,
    root_trees_kernel,
)

#: Regions smaller than a cell are noise or slivers behind a step, whose order says nothing.
MIN_REGION_PX = 128
# Below this many patches or contacts one CPU thread is done before others have woken up ten times a round.
_SERIAL = 12000
# Rows of the table of regions.
_REGION_PIXELS, _REGION_SCORE, _REGION_START, _REGION_ORDER = range(4)
# A cell drafts up to 2^3 patches, and four times as many contacts, in places of its own: clean surfaces need one and
# two. Where noise needs more, the drafts grow. Counters shared by all threads would do without drafts, but their order
# is chance, and Mesa's software Vulkan loses threads that wait for one inside a loop.
_DRAFT_BITS = 3
# Trees in a cell: 14 on average, whatever the noise.
_TREE_DRAFT_BITS = 5


class PatchGraph(NamedTuple):
    """Patches, and the contacts inside a region that agree with its orders."""

    root: npt.NDArray[np.int32]  # (P,) the patch that stands for the region
    offset: npt.NDArray[np.int32]  # (P,) what its orders lack to be the region's
    pixels: npt.NDArray[np.int32]  # (P,)
    first: npt.NDArray[np.int32]  # (P,) its first pixel, row * width + column
    ends: npt.NDArray[np.int32]  # (2, C) the two patches of each contact
    votes: npt.NDArray[np.int32]  # (C,) their weight


strip_of_integers = ti.types.vector(STRIP, ti.i32)
strip_of_floats = ti.types.vector(STRIP, ti.f32)


class Unwrapper:
    """Buffers to unwrap frames of one size, stripes along the rows.

    Parameters
    ----------
    height, width : int
        Size of the frames.
    method : {"directional", "reliability"}
        How patches grow and join: by votes, or along the most reliable edges.
    max_departure : float
        Neighbours on one surface change by no more than this more or less than usual, rad; "reliability" only.
    """

    def __init__(
        self, height: int, width: int, method: str = "directional", max_departure: float = MAX_DEPARTURE
    ) -> None:
        self.shape = (height, width)
        self.by_votes = method == "directional"
        self.max_departure = max_departure
        self.on_cpu = runtime.started() == "cpu"
        self.labels = runtime.empty((height, width), np.int32)
        self.counters = runtime.empty((4,), np.int32)
        rows, columns = -(-height // CELL_HEIGHT), -(-width // CELL_WIDTH)
        self.cells = rows * columns
        self.firsts = runtime.empty((3, self.cells + 1), np.int32)
        self.seams = runtime.empty((2, self.cells), np.int32)
        if not self.by_votes:
            self.edges = runtime.empty((4, rows * CELL_HEIGHT + 1, columns * CELL_WIDTH + 1), np.int32)
        self._allocate(_DRAFT_BITS if self.by_votes else _TREE_DRAFT_BITS)

    def _allocate(self, draft_bits: int) -> None:
        self.draft_bits = draft_bits
        patches = self.cells << draft_bits
        self.draft_patches = runtime.empty((3, patches), np.int32)
        self.draft_contacts = runtime.empty((5, 4 * patches), np.int32)
        if not self.by_votes:
            self.trees = runtime.empty((5, patches), np.int32)
        self.patches = runtime.empty((12, patches), np.int32)
        self.contacts = runtime.empty((5, 4 * patches), np.int32)
        self.regions = runtime.empty((4, patches), np.int32)
        self.final = runtime.empty((3, patches), np.int32)
        # A table for contacts by what they join: crowded in the first round, where hardly any two join the same, and
        # all but empty when the large regions meet.
        self.table = runtime.empty((3, 2 ** int(np.ceil(np.log2(4 * self.cells)))), np.int32)

    def _serial(self, count: int) -> bool:
        return self.on_cpu and count < _SERIAL

    def join(self, phase: Any, quality: Any, rates: Any) -> None:
        """Sort the pixels into patches and the patches into regions.

        Parameters
        ----------
        phase : (H, W) float32
            rad in [-pi, pi]; NO_PHASE outside the mask.
        quality : (H, W) float32
            Larger is better; the modulation.
        rates
            What `measure_rates_kernel` found.
        """
        while True:
            drafts: Any = (self.draft_patches, self.draft_contacts, self.firsts)
            if self.by_votes:
                growing: Any = (phase, quality, rates, self.draft_bits, self.labels)
                grow_patches_kernel(*growing, *drafts)
                note_borders_kernel(*growing, self.draft_contacts, self.firsts)
            else:
                weigh_edges_kernel(phase, rates, self.max_departure, self.edges)
                growing = (self.draft_bits, self.labels)
                grow_trees_kernel(self.edges, quality, rates, *growing, self.draft_patches, self.trees, self.firsts)
                join_trees_kernel(self.cells, self.edges, rates, *growing, self.firsts, self.trees)
                note_contacts_kernel(self.edges, rates, *growing, self.trees, self.draft_contacts, self.firsts)
            number_patches_kernel(self.cells, self.firsts, self.counters)
            counts = runtime.to_host(self.counters)  # synchronises
            if counts[N_CROWDED] <= 1 << self.draft_bits:
                break
            self._allocate(int(counts[N_CROWDED] - 1).bit_length())
        patches, contacts = int(counts[N_PATCHES]), int(counts[N_CONTACTS])
        drafts = (self.cells, self.draft_bits, *drafts)
        collect_patches_kernel(self._serial(contacts), *drafts, self.patches, self.contacts)
        if not self.by_votes:
            root_trees_kernel(self.cells, self.draft_bits, self.trees, self.firsts, self.patches)
        while True:
            tables = (self.patches, self.contacts, self.table, self.counters)
            merge_patches_kernel(self._serial(contacts), self.by_votes, contacts, *tables)
            if runtime.to_host(self.counters)[N_MERGED] == 0:  # synchronises
                break
            if self.on_cpu:  # a GPU passes over spent contacts faster than one of its threads could close the gaps
                close_gaps_kernel(contacts, self.contacts, self.counters)
                contacts = int(runtime.to_host(self.counters)[N_CONTACTS])
        settle_patches_kernel(self._serial(patches), patches, self.patches)
        self.patch_count = patches
        self._choose_starts()

    def _choose_starts(self) -> None:
        count = self.patch_count
        choose_starts_kernel(self._serial(count), count, self.labels, self.patches, self.regions)

    def patch_roots(self) -> npt.NDArray[np.int32]:
        """Return (P,) int32: the patch that stands for the region of each patch."""
        roots: npt.NDArray[np.int32] = runtime.to_host(self.patches)[ROOT, : self.patch_count]  # synchronises
        return roots

    def graph(self) -> PatchGraph:
        """Return the patches, and where they touch, as the host sees them."""
        patches = runtime.to_host(self.patches)[:, : self.patch_count]  # synchronises
        firsts, drafts = runtime.to_host(self.firsts), runtime.to_host(self.draft_contacts)
        counts = np.diff(firsts[1])
        within = np.arange(firsts[1, -1]) - np.repeat(firsts[1, :-1], counts)
        noted = drafts[:, (np.repeat(np.arange(self.cells), counts) << (self.draft_bits + 2)) + within]
        ends = noted[[FROM, TO]]
        ends = firsts[0, ends >> self.draft_bits] + (ends & ((1 << self.draft_bits) - 1))
        agree = patches[OFFSET, ends[1]] == patches[OFFSET, ends[0]] + noted[SHIFT]
        agree &= (patches[ROOT, ends[0]] == patches[ROOT, ends[1]]) & (ends[0] != ends[1])
        ends, votes = ends[:, agree], noted[VOTES, agree]
        if not self.by_votes:
            # Pieces of a tree hang together by better edges than any between trees, which noted no contacts.
            pieces = np.setdiff1d(np.flatnonzero(patches[HEAD] != np.arange(self.patch_count)), ends).astype(np.int32)
            ends = np.concatenate([np.stack([patches[HEAD, pieces], pieces]), ends], axis=1)
            # An edge twice as reliable is worth twice as much.
            votes = np.concatenate([np.full(len(pieces), NO_EDGE, np.int32), NO_EDGE // np.maximum(NO_EDGE - votes, 1)])
        return PatchGraph(
            root=patches[ROOT],
            offset=patches[OFFSET],
            pixels=patches[PIXELS],
            first=patches[FIRST],
            ends=ends,
            votes=votes,
        )

    def split(self, roots: npt.NDArray[np.int32]) -> None:
        """Make regions of the patches that share a root, which is one of them; their orders stay."""
        patches = runtime.to_host(self.patches)
        patches[ROOT, : self.patch_count] = roots
        self._write_back(self.patches, patches)
        self._choose_starts()

    def set_orders(self, roots: npt.NDArray[np.integer], orders: npt.NDArray[np.integer]) -> None:
        """Add these whole cycles to the orders that the regions with these roots had when they were joined."""
        regions = runtime.to_host(self.regions)
        regions[_REGION_ORDER, roots] = -orders
        self._write_back(self.regions, regions)

    def orders(self, roots: npt.NDArray[np.integer]) -> npt.NDArray[np.int32]:
        """Return the whole cycles that are added to the orders of the regions with these roots."""
        orders: npt.NDArray[np.int32] = runtime.to_host(self.regions)[_REGION_ORDER, roots]
        return -orders

    def region_pixels(self) -> npt.NDArray[np.int32]:
        """Return (regions,) int32: how many pixels each region that was written had when it was joined."""
        pixels: npt.NDArray[np.int32] = runtime.to_host(self.regions)[_REGION_PIXELS, self.roots]  # synchronises
        return pixels

    def _write_back(self, buffer: Any, host: npt.NDArray[np.int32]) -> None:
        if buffer is not host:
            buffer.from_numpy(host)

    def place(self, phase: Any, rays: Any, projector: ProjectorGeometry, depth_mm: float) -> None:
        """Give every region the orders that bring it nearest to a depth, instead of 0 at its start.

        Parameters
        ----------
        phase : (H, W) float32
            rad in [-pi, pi].
        rays : (H, W, 2) float32
            x and y of every camera pixel's ray at unit depth.
        projector : ProjectorGeometry
            Where the projector stands.
        depth_mm : float
            Where the object is expected.
        """
        packed, axis, _ = projector.arguments()
        arguments = (self.patch_count, phase, self.labels, rays, depth_mm, packed, axis)
        place_regions_kernel(self._serial(self.patch_count), *arguments, self.patches, self.regions)

    def write(self, phase: Any, rates: Any, out_unwrapped: Any, out_mask: Any, out_region: Any) -> None:
        """Write the unwrapped phase (rad, NaN outside), the mask, and the region (from 1, the largest).

        The last pixel before a step is left out where the step has a pixel that belongs to neither side, or where only
        the orders show it: at the rim of a round object it can pass for the other surface. So are cells whose borders
        tell that they hold a step of whole cycles.
        """
        # Numbering a handful of regions by their size is the host's work; ties go to the start's place in the image.
        table = runtime.to_host(self.regions)[:, : self.patch_count]  # synchronises
        roots = np.flatnonzero(table[_REGION_PIXELS] >= MIN_REGION_PX)
        order = np.lexsort((table[_REGION_START, roots], -table[_REGION_PIXELS, roots]))
        numbers = np.zeros(max(self.patch_count, 1), np.int32)
        numbers[roots[order]] = np.arange(1, len(roots) + 1)
        self.roots = roots[order]  # of regions 1, 2 ...
        columns = -(-self.shape[1] // CELL_WIDTH)
        tables = (self.patches, self.draft_contacts, self.regions, numbers)
        finish_patches_kernel(
            self._serial(self.patch_count), self.cells, columns, self.firsts, self.draft_bits, *tables, self.final
        )
        mark_torn_cells_kernel(phase, rates, self.labels, self.seams, self.final)
        outputs = (out_unwrapped, out_mask, out_region)
        write_unwrapped_kernel(phase, rates, self.labels, self.final, *outputs)


@ti.kernel
def choose_starts_kernel(
    serial: Static,
    count: i32,
    labels: I32Array2,  # (H, W)
    patches: I32Array2,
    out_regions: I32Array2,  # (4, capacity) by root: pixels, score, first pixel of the start, order there
):
    height, width = labels.shape[0], labels.shape[1]
    ti.loop_config(serialize=serial)
    for i in range(count):
        out_regions[_REGION_PIXELS, i] = 0
        out_regions[_REGION_SCORE, i] = -(2**31)
        out_regions[_REGION_START, i] = 2147483647
        out_regions[_REGION_ORDER, i] = 0
    ti.loop_config(serialize=serial)
    for i in range(count):
        first = patches[FIRST, i]
        dy, dx = first // width - height // 2, first % width - width // 2
        # Nearest to the centre wins, reliable patches (at least half full and three quarters as bright as usual) first.
        # All in integers: a start must not depend on rounding.
        score = 2**29 - dy * dy - dx * dx
        if 2 * patches[PIXELS, i] >= CELL_WIDTH * CELL_HEIGHT and patches[WEIGHT, i] >= 3 * patches[PIXELS, i]:
            score += 2**29
        patches[SUPPORT, i] = score
        ti.atomic_add(out_regions[_REGION_PIXELS, patches[ROOT, i]], patches[PIXELS, i])
        ti.atomic_max(out_regions[_REGION_SCORE, patches[ROOT, i]], score)
    ti.loop_config(serialize=serial)
    for i in range(count):
        root = patches[ROOT, i]
        if patches[SUPPORT, i] == out_regions[_REGION_SCORE, root]:
            ti.atomic_min(out_regions[_REGION_START, root], patches[FIRST, i])
    ti.loop_config(serialize=serial)
    for i in range(count):
        first = patches[FIRST, i]
        if first == out_regions[_REGION_START, patches[ROOT, i]]:
            order = (labels[first // width, first % width] & ORDER_MASK) - ORDER_ZERO
            out_regions[_REGION_ORDER, patches[ROOT, i]] = patches[OFFSET, i] + order


@ti.kernel
def place_regions_kernel(
    serial: Static,
    count: i32,
    phase: F32Array2,  # (H, W) rad
    labels: I32Array2,  # (H, W)
    rays: F32Array3,  # (H, W, 2)
    depth: f32,  # mm
    projector: F32Array1,
    axis: i32,
    patches: I32Array2,
    regions: I32Array2,  # the order that is taken off each region is written
):
    width = labels.shape[1]
    ti.loop_config(serialize=serial)
    for i in range(count):
        patches[SUPPORT, i] = 0
        patches[KEY, i] = 0
    ti.loop_config(serialize=serial)
    for i in range(count):
        rotation, translation, lens, focal, center, period = load_projector(projector)
        # The cycles that a patch's first pixel lacks to lie at the depth; a region takes the mean over its patches, in
        # 64ths of a cycle, because sums of integers are the same in any order.
        first = patches[FIRST, i]
        y, x = first // width, first % width
        q = rotation @ (depth * vec3(rays[y, x, 0], rays[y, x, 1], 1.0)) + translation
        expected = projected(q, focal, center, lens, axis) / period
        order = (labels[y, x] & ORDER_MASK) - ORDER_ZERO + patches[OFFSET, i]
        lacking = expected - phase[y, x] / (2.0 * PI) - ti.cast(order, ti.f32)
        ti.atomic_add(patches[SUPPORT, patches[ROOT, i]], ti.cast(ti.round(64.0 * lacking), ti.i32))
        ti.atomic_add(patches[KEY, patches[ROOT, i]], 1)
    ti.loop_config(serialize=serial)
    for i in range(count):
        if patches[KEY, i] > 0:
            mean = ti.cast(patches[SUPPORT, i], ti.f32) / (64.0 * ti.cast(patches[KEY, i], ti.f32))
            regions[_REGION_ORDER, i] = -ti.cast(ti.round(mean), ti.i32)


@ti.kernel
def finish_patches_kernel(
    serial: Static,
    cells: i32,
    columns: i32,  # cells a row
    firsts: I32Array2,  # (3, cells + 1)
    draft_bits: i32,
    patches: I32Array2,
    draft_contacts: I32Array2,
    regions: I32Array2,
    numbers: I32Array1,  # number of the region of each root; 0: too small
    out_final: I32Array2,  # (3, cells << bits) of drafts: region's number, what orders lack; of cells: 1 steps, TORN
):
    # A cell has steps where a pixel lies between surfaces, a patch is too small a region, or a contact was overruled.
    ti.loop_config(serialize=serial)
    for cell in range(cells):
        for k in range(firsts[0, cell + 1] - firsts[0, cell]):
            draft, patch = (cell << draft_bits) + k, firsts[0, cell] + k
            root = patches[ROOT, patch]
            out_final[0, draft] = numbers[root]
            out_final[1, draft] = patches[OFFSET, patch] - regions[_REGION_ORDER, root] - ORDER_ZERO
            if numbers[root] == 0:
                firsts[2, cell] = 1
        for k in range(firsts[1, cell + 1] - firsts[1, cell]):
            e = (cell << (draft_bits + 2)) + k
            draft_a, draft_b = draft_contacts[FROM, e], draft_contacts[TO, e]
            a, b = patch_number(draft_a, firsts, draft_bits), patch_number(draft_b, firsts, draft_bits)
            if patches[OFFSET, b] != patches[OFFSET, a] + draft_contacts[SHIFT, e]:
                firsts[2, draft_a >> draft_bits] = 1
                firsts[2, draft_b >> draft_bits] = 1
    ti.loop_config(serialize=serial)
    for cell in range(cells):
        column = cell % columns
        steps = firsts[2, cell]
        if column > 0:
            steps |= firsts[2, cell - 1]
        if column < columns - 1:
            steps |= firsts[2, cell + 1]
        if cell >= columns:
            steps |= firsts[2, cell - columns]
        if cell + columns < cells:
            steps |= firsts[2, cell + columns]
        out_final[2, cell] = steps


@ti.func
def beside_step(phase: F32Array2, rates: F32Array2, labels: I32Array2, final: I32Array2, y: i32, x: i32) -> i32:
    """Whether a neighbour saw two surfaces, is too small a region, or lies whole cycles away."""
    height, width, last = labels.shape[0], labels.shape[1], rates.shape[0] - 1
    label = labels[y, x]
    draft = label >> ORDER_BITS
    beside = 0
    for side in ti.static(range(4)):
        dy, dx = ti.static((-1, 1, 0, 0)[side]), ti.static((0, 0, -1, 1)[side])
        y2 = ti.min(ti.max(y + dy, 0), height - 1)
        x2 = ti.min(ti.max(x + dx, 0), width - 1)
        label2 = labels[y2, x2]
        draft2 = label2 >> ORDER_BITS
        if draft2 != draft:
            if label2 == BETWEEN:
                beside = 1
            elif label2 >= 0:
                if final[0, draft2] == 0:
                    beside = 1
                elif final[0, draft2] == final[0, draft]:
                    cycles = (label2 & ORDER_MASK) - (label & ORDER_MASK) + final[1, draft2] - final[1, draft]
                    change = phase[y2, x2] - phase[y, x] + 2.0 * PI * ti.cast(cycles, ti.f32)
                    if ti.abs(change - dx * rates[last, 0] - dy * rates[last, 1]) > 2.0 * MAX_DEPARTURE:
                        beside = 1
    return beside


@ti.kernel
def write_unwrapped_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
    rates: F32Array2,  # last row: usual change along and across the stripes, rad a px
    labels: I32Array2,  # (H, W)
    final: I32Array2,  # (3, cells << bits)
    out_unwrapped: F32Array2,  # (H, W) rad; NaN outside the mask
    out_mask: U8Array2,  # (H, W) 1 inside
    out_region: I32Array2,  # (H, W) region's number from 1; 0 outside
):
    height, width = phase.shape[0], phase.shape[1]
    strips = (width + STRIP - 1) // STRIP
    for t in range(height * strips):
        y, first = t // strips, (t % strips) * STRIP
        count = ti.min(STRIP, width - first)
        label, region, unwrapped = strip_of_integers(0), strip_of_integers(0), strip_of_floats(0.0)
        for k in range(count):
            label[k] = labels[y, first + k]
            unwrapped[k] = phase[y, first + k]
        for k in range(count):
            if label[k] >= 0:
                draft = label[k] >> ORDER_BITS
                region[k] = final[0, draft]
                label[k] = (label[k] & ORDER_MASK) + final[1, draft]
        cell = (y // CELL_HEIGHT) * ((width + CELL_WIDTH - 1) // CELL_WIDTH) + first // CELL_WIDTH
        for c in range((count + CELL_WIDTH - 1) // CELL_WIDTH):
            if final[2, cell + c] == TORN:
                for k in range(c * CELL_WIDTH, ti.min((c + 1) * CELL_WIDTH, count)):
                    region[k] = 0
            elif final[2, cell + c] == 1:
                for k in range(c * CELL_WIDTH, ti.min((c + 1) * CELL_WIDTH, count)):
                    if region[k] > 0:
                        if beside_step(phase, rates, labels, final, y, first + k):
                            region[k] = 0
        for k in range(STRIP):
            value = unwrapped[k] + 2.0 * PI * ti.cast(label[k], ti.f32)
            unwrapped[k] = ti.select(region[k] > 0, value, ti.math.nan)
        for k in range(count):
            out_unwrapped[y, first + k] = unwrapped[k]
            out_mask[y, first + k] = ti.cast(region[k] > 0, ti.u8)
            out_region[y, first + k] = region[k]


def unwrap_phase(
    wrapped_phase: Any,
    quality: Any,
    mask: Any,
    stripes: str = "horizontal",
    method: str = "directional",
    *,
    out: Any | None = None,
) -> Any:
    """Unwrap a phase map.

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
    method : {"directional", "reliability"}
        "directional" joins row runs by votes, the best supported first. "reliability" joins pixels along the edges of
        least second difference, as scikit-image's `unwrap_phase` does, and takes three times as long. Neither crosses a
        step, which is where neighbours change by 0.8 rad more or less than usual.
    out : (H, W) float32, optional
        Where the result goes.

    Returns
    -------
    (H, W) float32
        Wrapped phase plus whole cycles, rad; NaN outside the mask, in specks of fewer than 128 pixels, and in cells
        that contradict their neighbours. Each connected region has order 0 at its start, the reliable pixel nearest
        the image's centre.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, `stripes` or `method` is unknown, or `out` cannot be written.

    References
    ----------
    M. Arevallilo Herraez et al., Applied Optics 41, 7437 (2002), doi:10.1364/AO.41.007437.

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
    if method not in ("directional", "reliability"):
        raise ShapeError(f"method is {method!r}: choose directional or reliability")
    wrapped_phase = _checks.read_array("wrapped_phase", wrapped_phase, (None, None), np.float32)
    shape = (int(wrapped_phase.shape[0]), int(wrapped_phase.shape[1]))
    quality = _checks.read_array("quality", quality, shape, np.float32)
    mask = _checks.read_mask("mask", mask, shape)
    out = _checks.out_array("out", out, shape, np.float32)
    phase = runtime.empty(shape, np.float32)
    mark_no_phase_kernel(wrapped_phase, mask, phase)
    result = out
    if stripes == "vertical":
        phase, quality, shape = transpose(phase), transpose(quality), shape[::-1]
        result = runtime.empty(shape, np.float32)
    unwrapper = Unwrapper(*shape, method)
    rates = rates_buffer(shape[0])
    measure_rates_kernel(phase, quality, rates)
    unwrapper.join(phase, quality, rates)
    unwrapper.write(phase, rates, result, runtime.empty(shape, np.uint8), runtime.empty(shape, np.int32))
    if stripes == "vertical":
        transpose(result, out)
    return out
