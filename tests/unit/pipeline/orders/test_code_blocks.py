"""The contrast of whole cycles in blocks of four columns."""

import numpy as np
import pytest
from support.coded_blocks import WIDTH, grid

from pipeline.orders.code_blocks import read_blocks
from tikernels.order_evidence.contrast_reading import BACKGROUND, BLOCKS, MODULATION, ORDER_SLOTS, PHASE, SUMS, TOTAL

CONTRAST = np.array([0.8, 1.0, 0.7, 0.9, 0.75])
# The weights of one row of a block's four columns, on average over a cycle.
ROW = 4 * 8 / 15


def sums_of(contrast=CONTRAST, period_px=12.0):
    """Return what two columns of patches show of blurred cycles, each cut by the border between two patches."""
    period_px = np.broadcast_to(period_px, len(contrast))
    sums = np.zeros((2 * (len(contrast) + 1), ORDER_SLOTS, BLOCKS, SUMS), np.float32)
    for k, (value, weight) in enumerate(zip(contrast * blur_leaves(period_px), ROW * period_px, strict=True)):
        for row, part, phase in ((k, 0.4, 1.2), (k + 1, 0.6, -0.8)):
            cycle = part * weight * np.array([1, 80 * value, 80, phase])
            sums[2 * row : 2 * row + 2, k - row + ORDER_SLOTS // 2][..., [TOTAL, MODULATION, BACKGROUND, PHASE]] = cycle
    return sums


def blur_leaves(period_px):
    """Return what a lens and a pixel's area leave of the contrast of cycles: a Gaussian of a third of a px squared."""
    return np.exp(-2 * np.pi**2 / 3 / period_px**2)


def read(sums, rising=True, noise=1.0):
    graph = grid(len(sums) // 2, 2)
    if not rising:
        graph, sums = graph._replace(offset=-graph.offset), sums[:, ::-1]
    return read_blocks(sums, graph, WIDTH, noise)


@pytest.mark.parametrize("rising", [True, False])
def test_cut_cycles_are_put_together(rising):
    blocks = read(sums_of(), rising)
    order = blocks.order if rising else -blocks.order
    assert sorted(order) == sorted(2 * BLOCKS * list(range(5)))
    np.testing.assert_allclose(blocks.contrast, np.log(CONTRAST)[order], atol=1e-5)
    brightness = 80 * (1 + CONTRAST * blur_leaves(12.0))
    np.testing.assert_allclose(blocks.brightness, brightness[order], rtol=1e-5)
    assert not blocks.root.any()
    row, column = blocks.place.T
    np.testing.assert_allclose(row, 16 * (order + 0.6 + 0.5) - 0.5, atol=1e-3)
    assert set(column) == {1.5, 5.5, 9.5, 13.5}
    # Which patches hold how much of each.
    patch_row, patch_column = np.divmod(blocks.patch, 2)
    np.testing.assert_allclose(blocks.share, np.where(patch_row == order[blocks.block], 0.4, 0.6), atol=1e-5)
    np.testing.assert_array_equal(patch_column, column[blocks.block] // 8)


def test_blur_is_undone_where_the_fringe_gets_finer():
    """Of one block only half of the pixels are left, so that those next to it tell how long its cycles are."""
    sums = sums_of(period_px=np.array([12.0, 11.0, 9.5, 8.0, 7.0]))
    sums[1::2, :, 0] *= 0.5
    blocks = read(sums)
    np.testing.assert_allclose(blocks.contrast, np.log(CONTRAST)[blocks.order], atol=1e-5)


def test_variance_by_noise_is_that_of_so_many_pixels():
    one, noisier = read(sums_of()), read(sums_of(), noise=3.0)
    np.testing.assert_allclose(noisier.variance, 9 * one.variance)
    # Twice as large where half of the pixels are missing, and larger where the fringe is weaker.
    half = sums_of()
    half[1::2, :, 0] *= 0.5
    half = read(half)
    missing = half.place[:, 1] == 9.5
    np.testing.assert_allclose(half.variance[missing], 2 * one.variance[missing], rtol=1e-5)
    by_order = {int(order): variance for order, variance in zip(one.order, one.variance, strict=True)}
    assert np.array_equal(np.argsort([by_order[k] for k in range(5)]), np.argsort(-CONTRAST))
    # No less than that of the likeliest contrast of a white surface, and no more than three times as much.
    within = np.linspace(-1, 1, 1001)
    counted = 4 * 12 * np.mean((1 - within**2) ** 2) ** 2 / np.mean((1 - within**2) ** 4)
    likeliest = (2 / 3 / (80 * CONTRAST) ** 2 + 1 / 3 / 80**2)[one.order] / counted
    assert (likeliest < one.variance).all() and (one.variance < 3 * likeliest).all()


def test_cycles_of_which_little_is_seen_do_not_count():
    """Two fifths of one do, and say how far off its middle they lie; a fifth does not."""
    sums = sums_of(np.array([0.8, 1.0, 0.7]))
    sums[2:4, ORDER_SLOTS // 2 - 1] = 0  # what the second row shows of the first cycle
    blocks = read(sums)
    np.testing.assert_allclose(blocks.off, np.where(blocks.order == 0, 1.2 / (2 * np.pi), 0), atol=1e-5)
    sums[:2, ORDER_SLOTS // 2] *= 0.5
    assert set(read(sums).order) == {1, 2}


def test_short_cycles_do_not_count():
    assert set(read(sums_of(period_px=np.array([12.0, 2.5, 12.0, 12.0, 12.0]))).order) == {0, 2, 3, 4}


def test_blocks_belong_to_the_patches_parts():
    graph = grid(6, 2)._replace(root=np.tile([0, 1], 6).astype(np.int32))
    blocks = read_blocks(sums_of(), graph, WIDTH, 1.0)
    np.testing.assert_array_equal(blocks.root, blocks.place[:, 1] // 8)


def test_no_cycles_at_all():
    blocks = read(np.zeros((12, ORDER_SLOTS, BLOCKS, SUMS), np.float32))
    assert len(blocks.order) == len(blocks.patch) == 0 and blocks.place.shape == (0, 2)
