"""Find the cells that must hold a hidden step: their borders contradict the neighbours'.

Where one surface ends whole cycles in front of another, the phase may go on as if nothing were there. A cell in which
that happens belongs to one of the surfaces as a whole, and part of it wrongly. It shows at the cell's border, where the
phase of the other surface goes on over many pixels, too, but the orders step by whole cycles: such pixels are a seam.
So does the brightness: where it has an edge the border of the surfaces is seen, and lies between the cells.
"""

from tikernels._taichi import F32Array2, I32Array2, f32, i32, ti, vec3, vec4
from tikernels.launching import kernel
from tikernels.phase.phase_vector import TINY
from tikernels.phase.smoothing import MAX_DEPARTURE
from tikernels.unwrapping.continuity import cycles_and_departure, frame_rates
from tikernels.unwrapping.tables import (
    CELL_HEIGHT,
    CELL_WIDTH,
    HIDES_STEP,
    ORDER_BITS,
    ORDER_MASK,
    Final,
    Seam,
    cell_bounds,
)

#: From this many pixels on a cell's border, those on its shorter sides counted double, a seam is none by chance: a step
#: that crosses the border shows two or three.
MIN_SEAM_PX = 6
# Where brightness changes by more than this factor over so many px across a cell's border (an edge is as wide as blur),
# and by more than over as many next to them, as shading does not, the surface ends there, and hides no step.
_EDGE, _EDGE_PX = 0.9, 5


@ti.func
def has_edge(brightness: F32Array2, y: i32, x: i32, dy: i32, dx: i32) -> i32:
    """Return whether brightness has an edge between a pixel and the next: it changes there by more than next to it."""
    seen = vec4(0.0)
    for k in ti.static(range(4)):
        away = ti.static((2 * k - 3) * _EDGE_PX // 2 + 1)
        y2 = ti.max(ti.min(y + away * dy, brightness.shape[0] - 1), 0)
        x2 = ti.max(ti.min(x + away * dx, brightness.shape[1] - 1), 0)
        seen[k] = brightness[y2, x2]
    change = vec3(0.0)
    for k in ti.static(range(3)):
        change[k] = ti.min(seen[k], seen[k + 1]) / ti.max(seen[k], seen[k + 1], TINY)
    return ti.cast(change[1] < ti.min(_EDGE, change[0], change[2]), i32)


@ti.func
def on_seam(
    phase: F32Array2,
    brightness: F32Array2,
    labels: I32Array2,
    final: I32Array2,
    rate: f32,
    y: i32,
    x: i32,
    down: i32,
) -> i32:
    """Return whether phase and brightness continue to the next pixel, below or to the right, but not the orders."""
    contradicts = 0
    dy, dx = down, 1 - down
    y2, x2 = y + dy, x + dx
    label, label2 = labels[y, x], labels[y2, x2]
    if (label | label2) >= 0:
        draft, draft2 = label >> ORDER_BITS, label2 >> ORDER_BITS
        difference = phase[y2, x2] - phase[y, x]
        cycles, departs = cycles_and_departure(difference, rate)
        jump = (label2 & ORDER_MASK) + final[Final.ORDER, draft2] - (label & ORDER_MASK) - final[Final.ORDER, draft]
        goes_on = departs < MAX_DEPARTURE
        if goes_on and jump != cycles and final[Final.REGION, draft] > 0 and final[Final.REGION, draft2] > 0:
            contradicts = 1 - has_edge(brightness, y, x, dy, dx)
    return contradicts


@ti.func
def seam_around(seams: I32Array2, columns: i32, cell: i32) -> i32:
    """Pixels of a seam on the four sides of a cell."""
    total = seams[Seam.RIGHT, cell] + seams[Seam.BELOW, cell]
    if cell % columns > 0:
        total += seams[Seam.RIGHT, cell - 1]
    if cell >= columns:
        total += seams[Seam.BELOW, cell - columns]
    return total


@kernel
def mark_hidden_steps_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
    brightness: F32Array2,  # (H, W)
    rates: F32Array2,  # see `frame_rates`
    labels: I32Array2,  # (H, W)
    seams: I32Array2,  # (2, cells) see `Seam`; scratch
    final: I32Array2,  # (3, cells << bits) see `Final`; where a cell hides a step, that is written
):
    """Count the pixels of seams around each cell, and mark cells that have too many of them."""
    height, width = phase.shape[0], phase.shape[1]
    columns = (width + CELL_WIDTH - 1) // CELL_WIDTH
    for cell in range(seams.shape[1]):
        along, across, _ = frame_rates(rates)
        top, left, bottom, right = cell_bounds(cell, height, width)
        for down in range(2):  # along the cell's last column, and along its last row
            count, rate = 0, ti.select(down == 1, across, along)
            y, x = ti.select(down == 1, bottom - 1, top), ti.select(down == 1, left, right - 1)
            length = ti.select(down == 1, right - left, bottom - top)
            if ti.select(down == 1, bottom < height, right < width):
                for k in range(length):
                    count += on_seam(phase, brightness, labels, final, rate, y + k * (1 - down), x + k * down, down)
            seams[Seam.RIGHT + down, cell] = ti.select(down == 1, CELL_HEIGHT // CELL_WIDTH, 1) * count
    for cell in range(seams.shape[1]):
        row, column, rows, most = cell // columns, cell % columns, seams.shape[1] // columns, 0
        # At the image's border the side that would show it may be missing, and the step continues from the next cell.
        for k in range(5):
            down, right = ti.cast(k == 1, i32) - ti.cast(k == 2, i32), ti.cast(k == 3, i32) - ti.cast(k == 4, i32)
            at_border = ti.select(down != 0, column == 0 or column == columns - 1, row == 0 or row == rows - 1)
            y, x = row + down, column + right
            if (k == 0 or at_border) and y >= 0 and y < rows and x >= 0 and x < columns:
                most = ti.max(most, seam_around(seams, columns, y * columns + x))
        if most >= MIN_SEAM_PX:
            final[Final.STEPS, cell] = HIDES_STEP
