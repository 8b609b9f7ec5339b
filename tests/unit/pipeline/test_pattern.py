"""The pattern that is projected, and its code."""

import json

import numpy as np
import pytest

from pipeline.calibration import Pattern
from pipeline.errors import OutputError, SettingsError
from pipeline.footage.image_file import read_image
from pipeline.pattern import (
    CONTRASTS,
    CYCLES,
    contrast_levels,
    contrast_steps,
    cycle_contrasts,
    make_pattern,
    modulation_at,
    write_pattern,
)
from tikernels.phase.balance_window import SIGMA_ACROSS


def distances(length: int) -> np.ndarray:
    """Return the squared distance of every two stretches of `length` cycles by their steps, in distances of symbols."""
    symbols = np.searchsorted(CONTRASTS, cycle_contrasts())
    steps = np.lib.stride_tricks.sliding_window_view(np.diff(symbols), length - 1)
    apart = ((steps[:, None] - steps[None]) ** 2).sum(axis=-1)
    return apart[np.triu_indices(len(steps), 1)]


@pytest.mark.parametrize(("length", "least"), [(5, 1), (6, 1), (7, 2), (8, 2), (10, 3), (12, 5)])
def test_no_two_stretches_change_alike(length, least):
    """Six cycles and more name their place, whatever gain the contrast has."""
    assert distances(length).min() >= least


def test_a_pattern_holds_a_sinusoid_that_is_as_bright_as_can_be():
    pattern = Pattern(period_px=768 / 44, code="contrast")
    codes = make_pattern((4, 768), pattern)[:, 0].astype(np.float64)
    cycles = np.arange(768) / pattern.period_px
    np.testing.assert_allclose(codes.mean(axis=1), 1 - modulation_at(cycles), atol=1e-6)
    middles = np.arange(CYCLES)
    np.testing.assert_allclose(modulation_at(middles) / (1 - modulation_at(middles)), cycle_contrasts(), atol=1e-12)
    vector = codes @ np.exp(-1j * np.array([-1, 0, 1]) * 2 * np.pi / 3) * 2 / 3
    np.testing.assert_allclose(np.abs(vector), modulation_at(cycles), atol=1e-6)
    np.testing.assert_allclose(np.angle(vector * np.exp(-2j * np.pi * cycles)), 0, atol=1e-5)
    assert codes.min() >= 0 and codes.max() <= 1
    assert 0.5 / np.sqrt(CONTRASTS[0] / (1 + CONTRASTS[0]) * 0.5) < 1.1, "what the code costs on average"


def test_the_code_hardly_leaks_into_the_mean_of_a_channel():
    """The balance window, a Gaussian, sees each channel's mean to 0.4 %: 0.003 rad."""
    period = 16
    codes = make_pattern((1, 100 * period), Pattern(period_px=period, code="contrast"))[:, 0].astype(np.float64)
    reach = np.arange(-6 * period, 6 * period + 1)
    taps = np.exp(-0.5 * (reach / (SIGMA_ACROSS * period)) ** 2)
    means = np.stack([np.convolve(channel, taps / taps.sum(), "valid") for channel in codes.T])
    assert np.abs(means / means.mean(axis=0) - 1).max() < 0.012
    assert np.sqrt(np.mean((means / means.mean(axis=0) - 1) ** 2)) < 0.004


def test_more_cycles_than_the_code_tells_apart():
    assert make_pattern((1, CYCLES * 4), Pattern(period_px=4, code="contrast")).shape == (CYCLES * 4, 1, 3)
    with pytest.raises(SettingsError, match=r"distinguishes 136 cycles.*take a period of 8 px or more"):
        make_pattern((4, 8 * CYCLES), Pattern(period_px=4, code="contrast"))


def test_levels_of_a_strength():
    """In linear light the middles of cycles show the code, softened by their neighbours; less strength bends it."""
    levels, symbols = contrast_levels(), np.searchsorted(CONTRASTS, cycle_contrasts())
    softened = np.convolve(np.pad(np.log(cycle_contrasts()), 1, "edge"), [0.08, 0.84, 0.08], "valid")
    np.testing.assert_allclose(levels, softened, atol=0.01)
    for strength in (0.2, 0.35, 0.6, 1.1):
        assert np.ptp(contrast_levels(strength)) == pytest.approx(strength * np.ptp(levels))
    # Three cycles alike show their symbol: at gamma 2 the logarithms of 1.144, 1.256 and 1.333, the response's means.
    alike = np.flatnonzero((np.diff(symbols)[:-1] == 0) & (np.diff(symbols)[1:] == 0)) + 1
    shown = [contrast_levels(0.4665)[alike[symbols[alike] == symbol]].mean() for symbol in (0, 2)]
    assert shown[1] - shown[0] == pytest.approx(np.log(1.3333 / 1.1438), rel=0.02)


def test_no_strength_no_levels():
    assert not np.any(contrast_levels(0.0)) and not np.any(contrast_steps(0.0))


def test_a_written_pattern_names_its_code(tmp_path):
    write_pattern(tmp_path / "p.png", (64, 64), Pattern(period_px=16, stripes="vertical", code="contrast"))
    described = json.loads((tmp_path / "p.json").read_text())
    assert Pattern(**described) == Pattern(period_px=16, stripes="vertical", code="contrast")


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_the_pattern(tmp_path, stripes):
    pattern = Pattern(period_px=16, stripes=stripes)
    codes = make_pattern((64, 48), pattern)
    assert codes.shape == (48, 64, 3)
    line = codes[:, 5] if stripes == "horizontal" else codes[5]
    assert line[0, 1] == 1  # green brightest at phase 0, the first row's centre
    np.testing.assert_allclose(line.sum(axis=-1), 1.5, atol=1e-6)
    phase = np.arctan2(np.sqrt(3) * (line[:, 0] - line[:, 2]), 2 * line[:, 1] - line[:, 0] - line[:, 2])
    np.testing.assert_allclose(np.unwrap(phase), 2 * np.pi * np.arange(len(line)) / 16, atol=1e-5)
    write_pattern(tmp_path / "P.png", (64, 48), pattern)
    assert np.abs(read_image(tmp_path / "P.png") / 255 - codes).max() <= 0.5 / 255 + 1e-6
    assert json.loads((tmp_path / "P.json").read_text()) == {"period_px": 16.0, "stripes": stripes, "code": None}


def test_patterns_that_cannot_be(tmp_path):
    with pytest.raises(SettingsError, match="cannot hold a cycle"):
        make_pattern((64, 10), Pattern(period_px=16))
    with pytest.raises(OutputError, match=r"\.png"):
        write_pattern(tmp_path / "P.jpg", (64, 48), Pattern(period_px=16))


BRIGHTNESS = 0.85


CODES = np.linspace(0, 1, 256)


RESPONSE = np.stack([CODES**gamma for gamma in (1.8, 2.0, 2.4)])


def light_of(codes):
    """Return the light of codes, with the response above."""
    return np.stack([np.interp(codes[..., j], CODES, RESPONSE[j]) for j in range(3)], axis=-1)


@pytest.mark.parametrize("code", [None, "contrast"])
def test_the_light_is_scaled(code):
    pattern = Pattern(period_px=16, code=code)
    bright = make_pattern((64, 96), pattern, RESPONSE)
    dim = make_pattern((64, 96), pattern, RESPONSE, BRIGHTNESS)
    np.testing.assert_allclose(light_of(dim), BRIGHTNESS * light_of(bright), atol=1e-6)
    assert np.abs(dim - BRIGHTNESS * bright).max() > 0.02  # and so the codes are not
    np.testing.assert_allclose(
        make_pattern((64, 96), pattern, brightness=BRIGHTNESS), BRIGHTNESS * make_pattern((64, 96), pattern), atol=1e-6
    )


def test_files(tmp_path):
    pattern = Pattern(period_px=16)
    for name, brightness in (("bright", 1.0), ("dim", BRIGHTNESS)):
        write_pattern(tmp_path / f"{name}.png", (64, 96), pattern, brightness=brightness)
    write_pattern(tmp_path / "plain.png", (64, 96), pattern)
    for kind in ("png", "json"):
        assert (tmp_path / f"bright.{kind}").read_bytes() == (tmp_path / f"plain.{kind}").read_bytes()
    assert json.loads((tmp_path / "dim.json").read_text()) == json.loads((tmp_path / "plain.json").read_text())
    dim, bright = (read_image(tmp_path / f"{name}.png").astype(float) for name in ("dim", "bright"))
    assert np.abs(dim - BRIGHTNESS * bright).max() <= 1  # each rounded by half a level


@pytest.mark.parametrize("brightness", [0.0, -0.5, 1.001, float("nan"), float("inf")])
def test_brightnesses_that_cannot_be(brightness):
    with pytest.raises(SettingsError, match="more than 0 and at most 1"):
        make_pattern((64, 96), Pattern(period_px=16), brightness=brightness)
