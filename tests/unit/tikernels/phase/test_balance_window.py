"""The balance window against full-resolution Gaussians."""

import numpy as np
import pytest

from tikernels.phase.balance_window import SIGMA_ACROSS, SIGMA_ALONG, BalanceWindow, block_rows, half_gaussian


def test_the_window_passes_next_to_nothing_of_the_fringe():
    """A Gaussian's transfer at one cycle; what is left is a phase error of 1e-6 of the contrast."""
    assert np.exp(-0.5 * (2 * np.pi * SIGMA_ACROSS) ** 2) < 1e-6


@pytest.mark.parametrize(("period_px", "rows"), [(4.0, 1), (5.0, 2), (9.9, 2), (12.0, 4), (40.0, 16), (1e4, 2048)])
def test_blocks_sample_a_cycle_two_and_a_half_times(period_px, rows):
    assert block_rows(period_px) == rows
    assert rows == 1 or rows * 2.5 <= period_px


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_half_a_gaussian_ends_at_three_deviations(offset):
    taps = half_gaussian(2.5, offset)
    reach = np.arange(len(taps)) + offset
    np.testing.assert_allclose(taps, np.exp(-0.5 * (reach / 2.5) ** 2), rtol=1e-6)
    assert 7.5 <= reach[-1] < 9.5


@pytest.mark.parametrize("shape", [(1, 1), (7, 130), (96, 64), (131, 45)])
def test_sums_are_those_of_a_gaussian_around_each_node(arch, shape):
    """Blocks at whole places, nodes between two of them; where the window leaves the image nothing is added."""
    period_px, channels = 12.3, 8
    window = BalanceWindow(*shape, period_px)
    rng = np.random.default_rng(1)
    sums = rng.random((*window.blocks, channels), np.float32)
    half, out = np.empty((2, *window.grid, channels), np.float32)
    window.smooth(sums, half, out)

    def weights(nodes: np.ndarray, places: np.ndarray, sigma: float, reach: float) -> np.ndarray:
        distance = np.abs(nodes[:, None] - places)
        return np.where(distance <= reach + 1e-9, np.exp(-0.5 * (distance / sigma) ** 2), 0)

    across, along = SIGMA_ACROSS * period_px / window.rows, SIGMA_ALONG * period_px / window.spacing_px
    nodes = 2 * np.arange(window.grid[0]) + 0.5
    rows = weights(nodes, np.arange(window.blocks[0]), across, np.ceil(3 * across) + 0.5)
    columns = weights(np.arange(window.grid[1]), np.arange(window.blocks[1]), along, np.ceil(3 * along))
    expected = np.einsum("ib,bjk,nj->ink", rows, sums.astype(np.float64), columns)
    np.testing.assert_allclose(out, expected, rtol=1e-5)
    assert window.spacing_px == 2 * window.rows
    assert window.grid[0] * window.spacing_px >= shape[0]
    assert window.grid[1] * window.spacing_px >= shape[1]
