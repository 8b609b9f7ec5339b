"""Sums over a Gaussian window around every node of a coarse grid: the balance and the channels' model are made of them.

Along the stripes neighbours say the same, so one pixel a row of each block stands for it. A block is `rows` image rows
by twice as many columns; the grid has a node in the middle of every two blocks, one above the other, so nodes are
`spacing_px` apart both ways. Sums of the blocks are smoothed across the stripes, onto the nodes, and then along them.
"""

import numpy as np
import numpy.typing as npt

from tikernels._taichi import F32Array1, F32Array3, Static, f32, i32, ti
from tikernels.arrays import F32
from tikernels.launching import kernel

#: The window across and along the stripes, as a standard deviation in cycles. At 0.85 cycles a Gaussian passes 1e-6 of
#: the fringe; wider ones blur the reflectance without gaining anything.
SIGMA_ACROSS, SIGMA_ALONG = 0.85, 1.0
# A block still samples a cycle two and a half times, and is no higher than 64 rows.
_ROWS_A_CYCLE = 2.5
_MAX_ROWS = 64
# The window ends at three standard deviations.
_REACH = 3


class BalanceWindow:
    """Where blocks and nodes lie in an image of one size, and how the window weighs them.

    Parameters
    ----------
    height, width : int
        The image's, stripes along the rows, px.
    period_px : float
        Camera px a cycle.
    """

    def __init__(self, height: int, width: int, period_px: float) -> None:
        self.rows = block_rows(period_px)
        self.spacing_px = 2 * self.rows
        #: (Hb, Wb) how many blocks there are.
        self.blocks = (-(-height // self.rows), -(-width // self.spacing_px))
        #: (Hg, Wg) how many nodes there are.
        self.grid = (-(-self.blocks[0] // 2), self.blocks[1])
        # Across, a node stands between two blocks, so the taps sit at half-integer distances.
        self._across = half_gaussian(SIGMA_ACROSS * period_px / self.rows, offset=0.5)
        self._along = half_gaussian(SIGMA_ALONG * period_px / self.spacing_px)
        #: How many samples, one a row of each block, a window that nothing cuts off has, by their weights.
        self.samples = float(self.rows * 2 * self._across.sum() * (2 * self._along.sum() - self._along[0]))

    def smooth(self, sums: F32, half: F32, out: F32) -> None:
        """Add up the blocks' sums over the window at every node.

        Parameters
        ----------
        sums : (Hb, Wb, N) float32
            A block's sums.
        half : (Hg, Wg, N) float32
            Scratch.
        out : (Hg, Wg, N) float32
            Where the result goes.
        """
        smooth_blocks_kernel(int(sums.shape[2]), sums, self._across, self._along, half, out)


def block_rows(period_px: float) -> int:
    """Rows of a block: the largest power of two that still samples a cycle two and a half times."""
    rows = 1
    while 2 * rows * _ROWS_A_CYCLE <= period_px and rows < _MAX_ROWS:
        rows *= 2
    return rows


def half_gaussian(sigma: float, offset: float = 0.0) -> npt.NDArray[np.float32]:
    """Half of a Gaussian of this deviation (in samples) from an offset on, cut at three deviations."""
    reach = np.arange(int(np.ceil(_REACH * sigma)) + 1) + offset
    return np.asarray(np.exp(-0.5 * (reach / sigma) ** 2), np.float32)


@kernel
def smooth_blocks_kernel(
    channels: Static,  # N
    sums: F32Array3,  # (Hb, Wb, N) a block's sums
    taps_across: F32Array1,  # half a Gaussian, from its middle
    taps_along: F32Array1,
    half: F32Array3,  # (Hg, Wg, N) scratch: smoothed across the stripes
    out: F32Array3,  # (Hg, Wg, N)
):
    """Smooth across the stripes, from blocks to nodes, then along them."""
    for node in range(half.shape[0] * half.shape[1]):
        i, j = node // half.shape[1], node % half.shape[1]
        total = ti.Vector.zero(f32, channels)
        for tap in range(taps_across.shape[0]):
            above, below = 2 * i - tap, 2 * i + 1 + tap
            if above >= 0:
                add_weighted(total, taps_across[tap], sums, above, j, channels)
            if below < sums.shape[0]:
                add_weighted(total, taps_across[tap], sums, below, j, channels)
        for k in ti.static(range(channels)):
            half[i, j, k] = total[k]
    for node in range(half.shape[0] * half.shape[1]):
        i, j = node // half.shape[1], node % half.shape[1]
        total = ti.Vector.zero(f32, channels)
        add_weighted(total, taps_along[0], half, i, j, channels)
        for tap in range(1, taps_along.shape[0]):
            left, right = j - tap, j + tap
            if left >= 0:
                add_weighted(total, taps_along[tap], half, i, left, channels)
            if right < half.shape[1]:
                add_weighted(total, taps_along[tap], half, i, right, channels)
        for k in ti.static(range(channels)):
            out[i, j, k] = total[k]


@ti.func
def add_weighted(total: Static, weight: f32, sums: F32Array3, i: i32, j: i32, channels: Static):
    """Add one place's sums to a total that is changed."""
    for k in ti.static(range(channels)):
        total[k] += weight * sums[i, j, k]
