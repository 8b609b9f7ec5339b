"""The two codes: how far stretches and windows of them are apart, what they leak and cost, and how they are read."""

import numpy as np
import pytest
from support.code_windows import lowest_distances, words_of_distance_five

from pipeline.calibration import Pattern
from pipeline.contrast_code import CYCLES, GAMMAS, ContrastCode
from pipeline.pattern import make_pattern
from tikernels.phase.balance_window import SIGMA_ACROSS, SIGMA_ALONG

CELL_PX = 8.0
CODES = (ContrastCode.named("contrast"), ContrastCode.named("contrast2", CELL_PX))
each_code = pytest.mark.parametrize("code", CODES, ids=lambda code: code.name)


def words():
    """Return the second code's symbols, 0 and 1, (CYCLES, cells)."""
    return (CODES[1].contrasts == 1).astype(np.int64)


@pytest.mark.parametrize(("length", "least"), [(5, 1), (6, 1), (7, 2), (8, 2), (10, 3), (12, 5)])
def test_no_two_stretches_change_alike(length, least):
    """Six cycles and more name their place, whatever gain the contrast has; squared, in distances of symbols."""
    symbols = np.unique(CODES[0].contrasts, return_inverse=True)[1].reshape(-1)
    steps = np.lib.stride_tricks.sliding_window_view(np.diff(symbols), length - 1)
    apart = ((steps[:, None] - steps[None]) ** 2).sum(axis=-1)
    assert apart[np.triu_indices(len(steps), 1)].min() >= least


def test_words_differ_in_five_cells():
    known = {tuple(word) for word in words_of_distance_five()}
    found = {tuple(word) for word in words()}
    assert len(found) == CYCLES and found <= known
    apart = (words()[:, None] != words()).sum(axis=-1)
    assert apart[np.triu_indices(CYCLES, 1)].min() == 5
    assert 5 <= words().sum(axis=1).min() and words().sum(axis=1).max() <= 10, "no word is as even as a gain"


@pytest.mark.parametrize(
    ("shape", "least", "lowest"),
    [
        ((1, 15), 3.33, 3.33),
        ((2, 8), 0.94, 2.44),
        ((4, 4), 0.94, 2.44),
        ((8, 2), 0.94, 2.44),
        ((9, 1), 0.0, 0.89),
        ((12, 1), 0.92, 0.92),
    ],
)
def test_no_two_windows_at_the_same_cells_are_alike(shape, least, lowest):
    """The least squared distance, whatever gain either has, and that of the .1 % of pairs that are least apart."""
    assert lowest_distances(words(), shape) == pytest.approx((least, lowest), abs=0.006)


@each_code
def test_middles_have_their_contrast_and_the_code_repeats_along_the_stripe(code):
    middles = (np.arange(code.contrasts.shape[1]) + 0.5) * (code.cell_px or 1)
    modulation = code.modulation(np.arange(CYCLES)[:, None], middles)
    np.testing.assert_allclose(modulation / (1 - modulation), code.contrasts, atol=1e-12)
    np.testing.assert_allclose(
        code.modulation(7.3, middles), code.modulation(7.3, middles + 3 * code.repeats_px), atol=1e-12
    )
    assert code.usual == pytest.approx({"contrast": 0.871, "contrast2": 0.9}[code.name], abs=0.01)


def test_a_cell_is_flat_over_half_of_it():
    along = 5 * CELL_PX + np.linspace(0.25, 0.75, 9) * CELL_PX
    assert np.ptp(CODES[1].modulation(np.arange(CYCLES)[:, None], along), axis=1).max() < 1e-12
    border = CODES[1].modulation(np.arange(CYCLES), 6 * CELL_PX)
    np.testing.assert_allclose(
        border, CODES[1].modulation(np.arange(CYCLES)[:, None], along[[0, 0]] + [0, CELL_PX]).mean(axis=1)
    )


@pytest.mark.parametrize(("code", "cost"), [*zip(CODES, (1.088, 1.061), strict=True)], ids=["contrast", "contrast2"])
def test_what_a_code_costs_the_phase(code, cost):
    """The noise, RMS over the pattern, of that of a plain one: it goes with one over the modulation."""
    modulation = code.modulation(np.arange(0, CYCLES - 1, 1 / 16)[:, None], np.arange(0, code.repeats_px, 0.5))
    assert np.sqrt(np.mean((0.5 / modulation) ** 2)) == pytest.approx(cost, abs=0.002)


LEAKS = ((CODES[0], 0.003, 0.001), (CODES[1], 0.0012, 0.0003))


@pytest.mark.parametrize(("code", "most", "rms"), LEAKS, ids=["contrast", "contrast2"])
def test_a_code_hardly_leaks_into_the_mean_of_a_channel(code, most, rms):
    """The balance window, a Gaussian, sees each channel's share of the mean to 0.1 %, of the second code to 0.03 %."""
    period, along = 16, int(code.repeats_px)
    pattern = Pattern(period_px=period, code=code.name, cell_px=code.cell_px)
    codes = make_pattern((along, 100 * period), pattern).astype(np.float64)
    for axis, sigma in ((0, SIGMA_ACROSS), (1, SIGMA_ALONG)):
        reach = np.arange(-6 * period, 6 * period + 1)
        taps = np.exp(-0.5 * (reach / (sigma * period)) ** 2)
        around = codes if axis == 0 else codes.take(np.arange(-6 * period, along + 6 * period) % along, axis=1)
        codes = np.apply_along_axis(np.convolve, axis, around, taps / taps.sum(), "valid")
    leak = codes / codes.mean(axis=-1, keepdims=True) - 1
    assert np.abs(leak).max() < most and np.sqrt(np.mean(leak**2)) < rms


def shown(code, gamma, along_px):
    """Return the logarithm of each cycle's contrast in the projected light at places along the stripe, all together."""
    within = (np.arange(64) + 0.5) / 64 - 0.5
    place = np.arange(1, CYCLES - 1)[:, None, None] + within[:, None]
    modulation = code.modulation(place, along_px)[..., None]
    waves = np.cos(2 * np.pi * (place[..., None] + np.array([-1, 0, 1]) / 3))
    light = (1 - modulation * (1 - waves)) ** gamma
    weight = (1 - (2 * within[:, None]) ** 2) ** 2
    part = (2 / 3 * (light * waves).sum(axis=-1) * weight).sum(axis=(1, 2))
    return np.log(part / (light.mean(axis=-1) * weight).sum(axis=(1, 2)))


@each_code
@pytest.mark.parametrize("gamma", [1.0, 2.0])
@pytest.mark.parametrize("width_px", [0.0, 5.5, 9.5])
def test_levels_are_what_a_cycle_of_the_light_shows(code, gamma, width_px):
    """Under a response, at a place or averaged over a block of some px about it, an odd number of tabled places."""
    levels = code.levels(width_px)[GAMMAS.index(gamma), 1:-1]
    for place in range(0, levels.shape[1], 35):
        middle = (place + 0.5) / levels.shape[1] * code.repeats_px
        along = middle + ((np.arange(19) - 9) / 19 * width_px if width_px else np.zeros(1))
        seen = shown(code, gamma, along)
        np.testing.assert_allclose(levels[:, place], seen, atol=0.002)
