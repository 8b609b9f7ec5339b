"""Sums over a Gaussian window around every node of a coarse grid: the balance and the channels' model are made of them.

Along the stripes neighbours say the same, so one pixel a row of each block stands for it. A block is `rows` image rows
by twice as many columns; the grid has a node in the middle of every two blocks, one above the other, so nodes are
`spacing_px` apart both ways. Sums of the blocks are smoothed across the stripes, onto the nodes, and then along them.
"""

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels._taichi import F32Array1, F32Array3, Static, f32, i32, ti
from tikernels.arrays import F32
from tikernels.launching import kernel
from tikernels.phase.phase_vector import SIGMAS
from tikernels.strips import STRIP, strip_at, strip_count

#: The window across and along the stripes, as a standard deviation in cycles. At 0.85 cycles a Gaussian passes 1e-6 of
#: the fringe; wider ones blur the reflectance without gaining anything.
SIGMA_ACROSS, SIGMA_ALONG = 0.85, 1.0
# A block still samples a cycle two and a half times.
_ROWS_A_CYCLE = 2.5
numbers = ti.types.vector(STRIP, ti.f32)


class BalanceWindow:
    """Places of blocks and nodes in an image of one size, and the window's weights.

    Parameters
    ----------
    height, width : int
        The image's, stripes along the rows, px.
    period_px : float
        Camera px per cycle.
    """

    def __init__(self, height: int, width: int, period_px: float) -> None:
        self.rows = block_rows(period_px)
        self.spacing_px = 2 * self.rows
        #: (Hb, Wb) how many blocks there are.
        self.blocks = (-(-height // self.rows), -(-width // self.spacing_px))
        #: (Hg, Wg) how many nodes there are.
        self.grid = (-(-self.blocks[0] // 2), self.blocks[1])
        # Across, a node stands between two blocks, so the taps sit at half-integer distances.
        across = half_gaussian(SIGMA_ACROSS * period_px / self.rows, offset=0.5)
        along = half_gaussian(SIGMA_ALONG * period_px / self.spacing_px)
        self._across, self._along = runtime.to_device(across), runtime.to_device(along)
        #: How many samples, one a row of each block, a window that nothing cuts off has, by their weights.
        self.samples = float(self.rows * 2 * across.sum() * (2 * along.sum() - along[0]))

    def smooth(self, sums: F32, half: F32, out: F32) -> None:
        """Add up the blocks' sums over the window at every node.

        Parameters
        ----------
        sums : (Hb, Wb, N) float32
            A block's sums.
        half : (Hg, Wg, N) float32
            Scratch.
        out : (Hg, Wg, N) float32
            Output array.
        """
        smooth_across_kernel(sums, self._across, half)
        smooth_along_kernel(half, self._along, out)


def block_rows(period_px: float) -> int:
    """Rows of a block: the largest power of two that still samples a cycle two and a half times."""
    rows = 1
    while 2 * rows * _ROWS_A_CYCLE <= period_px:
        rows *= 2
    return rows


def half_gaussian(sigma: float, offset: float = 0.0) -> npt.NDArray[np.float32]:
    """Half of a Gaussian of this deviation (in samples) from an offset on, cut at three deviations."""
    reach = np.arange(int(np.ceil(SIGMAS * sigma)) + 1) + offset
    return np.asarray(np.exp(-0.5 * (reach / sigma) ** 2), np.float32)


@ti.func
def add_shifted(total: Static, weight: f32, sums: F32Array3, i: i32, place: i32, first: i32, stop: i32):
    """Add a strip of a row to a total that is changed, weighed, from its first to its stop-th number.

    The sums of a row's blocks lie one after another, so a strip of them is treated as sums of the first block.
    """
    for k in range(first, stop):
        total[k] += weight * sums[i, 0, place + k]


@kernel
def smooth_across_kernel(
    sums: F32Array3,  # (Hb, Wb, N) a block's sums
    taps: F32Array1,  # half a Gaussian, from its middle
    out: F32Array3,  # (Hg, Wg, N)
):
    """Smooth across the stripes, from blocks to nodes."""
    for t in range(out.shape[0] * strip_count(out.shape[1] * out.shape[2], STRIP)):
        i, place, count = strip_at(t, out.shape[1] * out.shape[2], STRIP)
        total = numbers(0.0)
        for step in range(2 * taps.shape[0]):  # up and down, alternating
            tap = step // 2
            row = ti.select(step % 2 == 0, 2 * i - tap, 2 * i + 1 + tap)
            if row >= 0 and row < sums.shape[0]:
                add_shifted(total, taps[tap], sums, row, place, 0, count)
        for k in range(count):
            out[i, 0, place + k] = total[k]


@kernel
def smooth_along_kernel(
    sums: F32Array3,  # (Hg, Wg, N)
    taps: F32Array1,  # half a Gaussian, from its middle
    out: F32Array3,  # (Hg, Wg, N)
):
    """Smooth along the stripes, from node to node."""
    for t in range(out.shape[0] * strip_count(out.shape[1] * out.shape[2], STRIP)):
        row = out.shape[1] * out.shape[2]
        i, place, count = strip_at(t, row, STRIP)
        total = numbers(0.0)
        for step in range(1, 2 * taps.shape[0]):  # left and right, alternating
            tap = step // 2
            first = place + ti.select(step % 2 == 0, -tap, tap) * out.shape[2]
            add_shifted(total, taps[tap], sums, i, first, ti.max(-first, 0), ti.min(row - first, count))
        for k in range(count):
            out[i, 0, place + k] = total[k]
