"""The contrast of whole cycles in blocks of four columns."""

import numpy as np
import pytest
from support.coded_blocks import WIDTH, grid

from pipeline.contrast_code import ContrastCode
from pipeline.orders.code_blocks import change_by_cycle, read_blocks
from tikernels.order_evidence.contrast_reading import BACKGROUND, BLOCKS, MODULATION, SUMS

CONTRAST = np.array([0.8, 1.0, 0.7, 0.9, 0.75])
# Phase at which the border between two patches cuts each cycle, rad.
CUT = -0.6
# Orders that a patch may hold.
SLOTS = 7


def weight_below(phase):
    """Return which share of a cycle's weights lies below a phase."""
    u = np.asarray(phase) / np.pi
    return (u - 2 * u**3 / 3 + u**5 / 5 + 8 / 15) / (16 / 15)


def sums_of(contrast=CONTRAST, period_px=12.0, *, seen=(-np.pi, np.pi), ripple=(0.0, 0.0), cut=CUT):
    """Return what two columns of patches show of blurred cycles, each cut by the border between two patches.

    Of every cycle phases in this range are seen. The logarithm of its contrast has so much of cosine and sine of three
    times the phase.
    """
    period_px = np.broadcast_to(period_px, len(contrast))
    sums = np.zeros((len(contrast) + 1, 2, SLOTS, BLOCKS, SUMS), np.float32)
    for k, (value, period) in enumerate(zip(contrast * blur_leaves(period_px), period_px, strict=True)):
        for row, low, high in ((k, seen[0], min(cut, seen[1])), (k + 1, max(cut, seen[0]), seen[1])):
            if low >= high:
                continue
            phase = low + (high - low) * (np.arange(2000) + 0.5) / 2000
            pixels = 4 * period * (high - low) / (2 * np.pi) / 2000 * (1 - (phase / np.pi) ** 2) ** 2
            waves = np.stack([np.cos(3 * phase), np.sin(3 * phase)])
            modulation = 80 * value * np.exp(np.array(ripple) @ waves)
            one = np.ones(len(phase))
            sums[row, :, k - row + SLOTS // 2] = np.stack([one, modulation, 80 * one, phase, *waves]) @ pixels
    return sums.reshape(-1, *sums.shape[2:])


def blur_leaves(period_px):
    """Return what a lens and a pixel's area leave of the contrast of cycles: a Gaussian of a third of a px squared."""
    return np.exp(-2 * np.pi**2 / 3 / period_px**2)


def read(sums, noise=1.0, columns=2):
    return read_blocks(sums, grid(len(sums) // columns, columns), WIDTH, noise)


def test_cycles_that_borders_cut_are_put_together():
    blocks = read(sums_of())
    order = blocks.order
    assert sorted(order) == sorted(2 * BLOCKS * list(range(5)))
    np.testing.assert_allclose(blocks.contrast, np.log(CONTRAST)[order], atol=1e-5)
    brightness = 80 * (1 + CONTRAST * blur_leaves(12.0))
    np.testing.assert_allclose(blocks.brightness, brightness[order], rtol=1e-5)
    np.testing.assert_allclose(blocks.off, 0, atol=1e-5)
    assert not blocks.root.any()
    row, column = blocks.place.T
    first = float(weight_below(CUT))
    np.testing.assert_allclose(row, 16 * (order + 1 - first + 0.5) - 0.5, atol=1e-3)
    assert set(column) == {1.5, 5.5, 9.5, 13.5}
    # Which patches hold how much of each.
    patch_row, patch_column = np.divmod(blocks.patch, 2)
    expected = np.where(patch_row == order[blocks.block], first, 1 - first)
    np.testing.assert_allclose(blocks.share, expected, atol=1e-5)
    np.testing.assert_array_equal(patch_column, column[blocks.block] // 8)


@pytest.mark.parametrize(("low", "high"), [(-np.pi, 0.3), (-np.pi, -0.3), (-0.3, np.pi), (0.1, np.pi)])
def test_cycles_of_which_a_part_is_seen(low, high):
    """Of a cut cycle blur is undone as of a whole one, and its distance from the cycle's middle is stated."""
    sums = sums_of()
    sums[1::2, :, 0] = sums_of(seen=(low, high))[1::2, :, 0]
    blocks = read(sums)
    cut = blocks.place[:, 1] == 9.5
    assert sorted(blocks.order[cut]) == list(range(5))
    np.testing.assert_allclose(blocks.contrast, np.log(CONTRAST)[blocks.order], atol=1e-5)
    phase = np.linspace(low, high, 2001)
    weight = (1 - (phase / np.pi) ** 2) ** 2
    np.testing.assert_allclose(blocks.off[cut], weight @ phase / weight.sum() / (2 * np.pi), atol=1e-4)
    np.testing.assert_allclose(blocks.off[~cut], 0, atol=1e-5)


def test_too_little_of_a_cycle_does_not_count():
    """A third of it."""
    sums = sums_of()
    sums[1::2, :, 0] = sums_of(seen=(-np.pi, CUT))[1::2, :, 0]
    blocks = read(sums)
    assert set(blocks.place[:, 1]) == {1.5, 5.5, 13.5} and len(blocks.order) == 3 * 5


@pytest.mark.parametrize("ripple", [(0.1, 0.0), (0.0, -0.1), (-0.07, 0.08)])
def test_ripple_within_cycles_is_taken_off(ripple):
    """Patches' borders cut cycles anywhere, and of those in every second column of patches a part is seen."""
    cuts = np.linspace(-2, 2, 10)
    sums, part = (
        np.concatenate([sums_of(ripple=ripple, cut=cut, seen=seen)[None].reshape(6, 2, -1) for cut in cuts], axis=1)
        for seen in ((-np.pi, np.pi), (-np.pi, 0.3))
    )
    sums[:, 1::2] = part[:, 1::2]
    # What the part is off by itself.
    of_part = part.reshape(-1, SUMS).sum(axis=0)
    by_itself = np.log(of_part[MODULATION] / of_part[BACKGROUND]) - np.log(np.mean(CONTRAST * blur_leaves(12.0)))
    blocks = read(sums.reshape(-1, SLOTS, BLOCKS, SUMS), columns=2 * len(cuts))
    assert len(blocks.order) == 5 * 2 * len(cuts) * BLOCKS
    # The mean of a ripple's exponential is a little above 1.
    expected = np.log(CONTRAST)[blocks.order] + np.square(ripple).sum() / 4
    assert np.abs(blocks.contrast - expected).max() < 0.002 < 0.2 * abs(by_itself)


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


def test_torn_cycles_count_where_most_is_left():
    """Of the first cycle the second row shows two thirds, and the first row a third."""
    contrast = np.array([0.8, 1.0, 0.7])
    for row, slot, expected in ((1, -1, {1, 2}), (0, 0, {0, 1, 2})):
        sums = sums_of(contrast)
        sums[2 * row : 2 * row + 2, SLOTS // 2 + slot] = 0
        assert set(read(sums).order) == expected


def test_short_cycles_do_not_count():
    assert set(read(sums_of(period_px=np.array([12.0, 2.5, 12.0, 12.0, 12.0]))).order) == {0, 2, 3, 4}


def test_blocks_belong_to_the_patches_parts():
    graph = grid(6, 2)._replace(root=np.tile([0, 1], 6).astype(np.int32))
    blocks = read_blocks(sums_of(), graph, WIDTH, 1.0)
    np.testing.assert_array_equal(blocks.root, blocks.place[:, 1] // 8)


def test_no_cycles_at_all():
    blocks = read(np.zeros((12, SLOTS, BLOCKS, SUMS), np.float32))
    assert len(blocks.order) == len(blocks.patch) == 0 and blocks.place.shape == (0, 2)
    assert change_by_cycle(blocks) == 0.0


def test_a_plain_pattern_changes_less_than_the_code_under_any_response():
    """Half of what the code changes by at least is far from both."""
    assert change_by_cycle(read(sums_of())) == pytest.approx(np.median(np.abs(np.diff(np.log(CONTRAST)))), abs=1e-5)
    least = ContrastCode.named("contrast").least_change
    shaded = np.exp(0.01 * np.arange(12.0))
    assert change_by_cycle(read(sums_of(shaded))) < least / 2
    for levels in ContrastCode.named("contrast").levels()[..., 0]:
        assert change_by_cycle(read(sums_of(np.exp(levels[20:40].astype(np.float64))))) > 0.8 * least
