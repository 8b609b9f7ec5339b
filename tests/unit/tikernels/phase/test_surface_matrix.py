"""A surface's own matrix: predicted from its colour, and fitted to its pixels."""

import numpy as np
import pytest
from support.colored_boards import MATRIX, PAINTS, light, surface_matrix

from tikernels.phase.surface_matrix import (
    BETWEEN,
    BROAD,
    NARROW,
    FittedMatrices,
    LightDoubt,
    PredictedMatrices,
    band_weights,
    fit_matrices,
    predict_matrices,
    waves,
)
from tikernels.phase.surface_samples import SurfaceSamples

pytestmark = pytest.mark.usefixtures("cpu")

DOUBT = LightDoubt(leak=0.004, contrast=0.2, harmonic=0.0005)
COLORED = ("orange", "blue", "skin")
HARMONICS = np.fft.fft(light(np.linspace(0, 2 * np.pi, 64, endpoint=False)), axis=0)[1:5].T / 64
LIGHT = 2 * HARMONICS / light(np.linspace(0, 2 * np.pi, 64, endpoint=False)).mean(axis=0)[:, None]


def normalized(matrix: np.ndarray) -> np.ndarray:
    return 3 * matrix / matrix.sum()


def pixels(
    *paints: str,
    noise: float = 0.5,
    different: int = 1200,
    off: float = 0.05,
    broad: float = 0.25,
    lost: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> SurfaceSamples:
    """Return 1200 pixels of each paint in ambient light of 6 levels, their phases a little off.

    Of so many different ones. The primaries have lost so much of their contrast on skin.
    """
    rng, count = np.random.default_rng(7), 1200
    phase, brightness = rng.uniform(-np.pi, np.pi, count), rng.uniform(60, 140, count)
    of_paints = []
    for paint in paints:
        sent = waves(LIGHT * (1 - (paint == "skin") * np.array(lost)[:, None]), phase)[0]
        clean = brightness * (normalized(surface_matrix(PAINTS[paint], broad)) @ sent) + 6
        of_paints.append(clean + noise * rng.standard_normal((count, 3)).T)
    which = np.arange(count) * different // count
    seen = np.stack(of_paints)[..., which]
    begin = (phase + off * rng.standard_normal(count))[which]
    shape, share = (len(paints), count), np.full(len(paints), different / count)
    variance, around = np.full(seen.shape, noise**2), np.full(shape, 100.0)
    places = (seen, variance, np.tile(begin, (len(paints), 1)), around, np.ones(shape))
    return SurfaceSamples(*(np.ascontiguousarray(part, np.float32) for part in places), share, 0.0)


@pytest.mark.parametrize(("bands", "broad"), [(BROAD, 1.0), (NARROW, 0.0), (BETWEEN, 0.15)])
def test_a_colour_predicts_its_matrix(bands, broad):
    """Three reflectances from three numbers, exactly where the weights are those of the paint."""
    matrices = np.stack([normalized(surface_matrix(PAINTS[paint], broad)) for paint in COLORED])
    np.testing.assert_allclose(predict_matrices(matrices.sum(axis=2), MATRIX, bands), matrices, rtol=0.02, atol=2e-3)


def test_weights_of_known_wavelengths():
    """A third of the way from green's to red's, and beyond both: the logarithm is linear between, and flat outside."""
    weights = band_weights([[620, 560, 470], [590, 530, 440], [650, 500, 450]])
    np.testing.assert_allclose(weights[0], [[1, 0, 0], [1 / 3, 2 / 3, 0], [0, 0.25, 0.75]])
    np.testing.assert_allclose(weights[1], [[2 / 3, 1 / 3, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(weights[2], [[1, 0, 0], [0, 0.625, 0.375], [0, 0, 1]])
    np.testing.assert_allclose(band_weights(np.tile([620, 530, 450], (3, 1))), NARROW)


def test_white_keeps_its_matrix():
    white = MATRIX.sum(axis=1)
    for brightness in (0.1, 1.0, 30.0):
        predicted = predict_matrices([brightness * white], MATRIX, BETWEEN)
        np.testing.assert_allclose(predicted[0], normalized(MATRIX), rtol=1e-4)


def test_waves_are_the_light_and_its_slope():
    phase = np.linspace(-3, 3, 40)
    value, slope = waves(LIGHT, phase)
    sent = light(phase).T
    np.testing.assert_allclose(value, sent * (value / sent).mean(axis=1, keepdims=True), rtol=0.1)
    step = (waves(LIGHT, phase + 1e-5)[0] - waves(LIGHT, phase - 1e-5)[0]) / 2e-5
    np.testing.assert_allclose(slope, step, atol=1e-6)


def fitted(
    samples: SurfaceSamples, light_off=1.0, bands=BETWEEN, colors=None, before=None, *, fit_light=True, steps=4
) -> FittedMatrices:
    colors = samples.light.mean(axis=2) - 6 if colors is None else colors
    prediction = PredictedMatrices.of(colors, MATRIX, bands)
    ambient = np.full((len(samples.light), 3), 5.0)
    given = (samples, prediction, ambient, ambient, LIGHT * light_off, DOUBT)
    for _ in range(steps):
        before = fit_matrices(*given, before, fit_light=fit_light)
    return before


def test_pixels_tell_the_matrix_better_than_the_colour_does():
    """By the phase that pixels would get: its constant and its ripple, both within 0.01 rad, as is said of them."""
    samples = pixels(*COLORED)
    result = fitted(samples, before=fitted(samples), fit_light=False)
    for paint, matrix, ambient, sigma in zip(
        COLORED, result.matrices, result.ambient, result.constant_sigma, strict=True
    ):
        truth = pixels(paint, noise=1e-3, off=0.0)
        beside = np.ones((len(truth.phase), 1)) * ambient
        model = fit_phases(truth, matrix, beside, result.light)
        error = model - truth.phase[0]
        assert abs(error.mean()) < 0.01
        assert error.std() < 0.012
        assert abs(error.mean()) < 3 * sigma < 0.1
    assert (result.misfit < 0.005).all()


def fit_phases(samples: SurfaceSamples, matrix: np.ndarray, ambient: np.ndarray, harmonics: np.ndarray) -> np.ndarray:
    """Find the phases by brute force: Gauss and Newton on brightness and phase."""
    phase = samples.phase[0].copy()
    brightness = np.full(len(phase), 100.0)
    for _ in range(12):
        value, slope = (matrix @ part for part in waves(harmonics, phase))
        rest = samples.light[0] - ambient.T - brightness * value
        columns = np.stack([value, brightness * slope], axis=1).T
        step = np.stack(
            [np.linalg.lstsq(c, r, rcond=None)[0] for c, r in zip(columns.swapaxes(1, 2), rest.T, strict=True)]
        )
        brightness, phase = brightness + step[:, 0], phase + step[:, 1]
    return phase


def test_the_light_is_told_too():
    """Contrast lost to blur is common to all surfaces."""
    result = fitted(pixels(*COLORED), light_off=1.15)
    np.testing.assert_allclose(np.abs(result.light[:, 0]) / np.abs(LIGHT[:, 0]), 1, atol=0.05)
    kept = fitted(pixels(*COLORED), light_off=1.15, fit_light=False)
    np.testing.assert_allclose(kept.light, 1.15 * LIGHT, rtol=1e-6)
    assert kept.cost > 2 * result.cost


def test_what_acts_otherwise_costs_more():
    samples = pixels(*COLORED)
    assert fitted(samples).cost < 0.5 * fitted(samples, bands=BROAD).cost


@pytest.mark.parametrize("lost", [0.0, 0.2, 0.4])
def test_light_that_scatters_takes_contrast_from_red(lost):
    """By the phase that pixels would get: with paint alone 0.026 and 0.120 rad, at a loss of 0.4."""
    scattered = (lost, lost / 4, lost / 16)
    result = fitted(pixels(*COLORED, lost=scattered), steps=5)
    truth = pixels("skin", noise=1e-3, off=0.0, lost=scattered)
    error = fit_phases(truth, result.matrices[2], np.ones((1200, 1)) * result.ambient[2], result.light) - truth.phase[0]
    assert abs(error.mean()) < 0.005
    assert error.std() < 0.006


def test_a_fit_goes_on_where_the_last_one_ended():
    """One step more changes nothing, and a new surface joins those that are known."""
    samples = pixels(*COLORED)
    first = fitted(samples)
    again = fitted(samples, before=first, steps=1)
    np.testing.assert_allclose(again.matrices, first.matrices, atol=4e-3)
    joined = fitted(samples, before=first.only([0, 1]))
    np.testing.assert_allclose(joined.matrices, first.matrices, atol=4e-3)


def test_how_unsure_predictions_are():
    """By the range of log reflectance."""
    matrices = np.stack([normalized(surface_matrix(PAINTS[paint])) for paint in COLORED])
    prediction = PredictedMatrices.of(matrices.sum(axis=2), MATRIX, BETWEEN)
    white = PredictedMatrices.of([MATRIX.sum(axis=1)], MATRIX, BETWEEN)
    assert white.spread == pytest.approx(0, abs=1e-3) and (prediction.spread > 0.3).all()


def test_frames_of_a_video_are_averaged():
    """Those of a surface that was seen before; a new one stays as it is."""
    first, then = fitted(pixels(*COLORED[:2])), fitted(pixels(*COLORED, noise=2.0))
    second = then.after(first)
    np.testing.assert_allclose(second.matrices[:2], (first.matrices + then.matrices[:2]) / 2)
    np.testing.assert_array_equal(second.matrices[2], then.matrices[2])
    third = then.after(second)
    np.testing.assert_allclose(third.ambient[0], (first.ambient[0] + 2 * then.ambient[0]) / 3)
    np.testing.assert_array_equal(third.frames, [3, 3, 2])


def test_a_part_of_the_surfaces():
    result = fitted(pixels(*COLORED))
    part = result.only([2, 0])
    np.testing.assert_array_equal(part.matrices, result.matrices[[2, 0]])
    np.testing.assert_array_equal(part.constant_sigma, result.constant_sigma[[2, 0]])
    assert part.light is result.light
