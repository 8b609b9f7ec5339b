"""First order of a region: 0 at its start, or the one that brings it nearest to an expected depth."""

from tikernels._taichi import F32Array1, F32Array2, F32Array3, I32Array2, Static, f32, i32, ti, vec3
from tikernels.depth.triangulation import load_projector, projected
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH, MOST, ORDER_MASK, ORDER_ZERO, Patch, Region

# A reliable patch fills half a cell.
_RELIABLE_PX = CELL_WIDTH * CELL_HEIGHT // 2
# Reliable patches come before all others, for images up to about 30,000 px per side.
_RELIABLE_SCORE = 2**29
# What is lacking is summed in 64ths of a cycle: sums of integers are the same in any order.
_UNITS = 64.0


@ti.func
def first_order(labels: I32Array2, patches: I32Array2, i: i32) -> i32:
    """Return the order that a patch's first pixel has in its region."""
    first = patches[Patch.FIRST, i]
    return (
        patches[Patch.OFFSET, i] + (labels[first // labels.shape[1], first % labels.shape[1]] & ORDER_MASK) - ORDER_ZERO
    )


@kernel
def choose_starts_kernel(
    serial: Static,  # whether one thread does it
    count: i32,
    labels: I32Array2,  # (H, W)
    patches: I32Array2,  # (11, capacity) see `Patch`
    out_regions: I32Array2,  # (4, capacity) see `Region`
):
    """Choose the patch nearest to the image's centre as the start of each region, a reliable one if there is any."""
    height, width = labels.shape[0], labels.shape[1]
    ti.loop_config(serialize=serial)
    for i in range(count):
        out_regions[Region.PIXELS, i] = 0
        out_regions[Region.SCORE, i] = -MOST - 1
        out_regions[Region.START, i] = MOST
        out_regions[Region.ORDER, i] = 0
    ti.loop_config(serialize=serial)
    for i in range(count):
        first = patches[Patch.FIRST, i]
        dy, dx = first // width - height // 2, first % width - width // 2
        # All in integers: a start must not depend on rounding.
        score = _RELIABLE_SCORE - dy * dy - dx * dx
        pixels = patches[Patch.PIXELS, i]
        if pixels >= _RELIABLE_PX:
            score += _RELIABLE_SCORE
        patches[Patch.SUPPORT, i] = score
        ti.atomic_add(out_regions[Region.PIXELS, patches[Patch.ROOT, i]], pixels)
        ti.atomic_max(out_regions[Region.SCORE, patches[Patch.ROOT, i]], score)
    ti.loop_config(serialize=serial)
    for i in range(count):
        root = patches[Patch.ROOT, i]
        if patches[Patch.SUPPORT, i] == out_regions[Region.SCORE, root]:
            ti.atomic_min(out_regions[Region.START, root], patches[Patch.FIRST, i])
    ti.loop_config(serialize=serial)
    for i in range(count):
        if patches[Patch.FIRST, i] == out_regions[Region.START, patches[Patch.ROOT, i]]:
            out_regions[Region.ORDER, patches[Patch.ROOT, i]] = first_order(labels, patches, i)


@kernel
def place_regions_kernel(
    serial: Static,  # whether one thread does it
    count: i32,
    phase: F32Array2,  # (H, W) rad
    labels: I32Array2,  # (H, W)
    rays: F32Array3,  # (H, W, 2) x and y of every camera pixel's ray at unit depth
    depth: f32,  # mm
    projector: F32Array1,  # see `load_projector`
    axis: i32,  # 0: the phase changes with the projector's column, 1: with its row
    patches: I32Array2,  # (11, capacity) see `Patch`; scratch is written
    regions: I32Array2,  # (4, capacity) see `Region`; the order is written
):
    """Give every region the orders that bring the first pixels of its patches nearest to a depth, on average."""
    width = labels.shape[1]
    ti.loop_config(serialize=serial)
    for i in range(count):
        patches[Patch.SUPPORT, i] = 0
        patches[Patch.KEY, i] = 0
    ti.loop_config(serialize=serial)
    for i in range(count):
        rotation, translation, lens, focal, center, period = load_projector(projector)
        first = patches[Patch.FIRST, i]
        y, x = first // width, first % width
        q = rotation @ (depth * vec3(rays[y, x, 0], rays[y, x, 1], 1.0)) + translation
        expected = projected(q, focal, center, lens, axis) / period
        lacking = expected - phase[y, x] / (2.0 * PI) - ti.cast(first_order(labels, patches, i), ti.f32)
        ti.atomic_add(patches[Patch.SUPPORT, patches[Patch.ROOT, i]], ti.cast(ti.round(_UNITS * lacking), ti.i32))
        ti.atomic_add(patches[Patch.KEY, patches[Patch.ROOT, i]], 1)
    ti.loop_config(serialize=serial)
    for i in range(count):
        if patches[Patch.KEY, i] > 0:
            mean = ti.cast(patches[Patch.SUPPORT, i], ti.f32) / (_UNITS * ti.cast(patches[Patch.KEY, i], ti.f32))
            regions[Region.ORDER, i] = -ti.cast(ti.round(mean), ti.i32)
