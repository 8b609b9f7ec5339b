"""The fit of every pixel's phase by the channels' model: against its twin, and against the information limit."""

import numpy as np
import pytest
import reference

import tikernels
from pipeline.simulation import TYPICAL_CROSSTALK
from tikernels import runtime
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.channel_template import HARMONICS, flat_template
from tikernels.phase.color_balance import Gains
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import correction_table, measure_distribution
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_fit import FittedPhase, fit_phase
from tikernels.phase.surfaces import Surfaces
from tikernels.phase.wrapped_phase import NO_PHASE

MATRIX = np.array(TYPICAL_CROSSTALK)
COLOR = np.array([0.75, 0.52, 0.42])
PERIOD_PX = 12.3
NOISE = 1.5
DELAYS = np.array([-1, 0, 1]) * 2 * np.pi / 3


def clean_light(phase: np.ndarray, gamma: float, ambient: float) -> np.ndarray:
    """Return (H, W, 3) levels of a coloured plane whose brightness falls off to the right, in ambient light."""
    light = (0.5 + 0.5 * np.cos(phase[..., None] + DELAYS)) ** gamma
    x = np.arange(phase.shape[1]) / phase.shape[1]
    return 150 * COLOR * ((1 - 0.6 * x)[:, None] * (light @ MATRIX.T) + ambient)


def noisy_frame(gamma: float, ambient: float, shape=(120, 160)) -> tuple[np.ndarray, np.ndarray]:
    phase = reference.ramp(*shape, PERIOD_PX, tilt=0.02)
    noise = NOISE * np.random.default_rng(5).standard_normal((*shape, 3))
    return (clean_light(phase, gamma, ambient) + noise).astype(np.float32), phase


def crosstalk_of(matrix: np.ndarray, *, mixed: bool) -> Crosstalk:
    """Return the crosstalk before which colours act, or behind it: then it is the surfaces' own."""
    return Crosstalk.of(np.eye(3), surfaces=Surfaces.of(matrix)) if mixed else Crosstalk.of(matrix)


def recover(image: np.ndarray, *, mixed=False, doubt=0.02, gain=0.0, fitted=True):
    """Run the stages from levels to phase; return what the fit found, the model, and the correction."""
    height, width = image.shape[:2]
    crosstalk = crosstalk_of(MATRIX, mixed=mixed)
    levels = FrameLevels(255.0, NOISE, gain, NOISE, 5.0, 5.0)
    gains = Gains(height, width, PERIOD_PX)
    model = ChannelModel(gains)
    gains.measure(image, crosstalk, levels)
    correction = correction_table(model.recover(crosstalk, levels), 9)
    model.fit(crosstalk, correction, flat_template(), 0.02)
    if not fitted:
        model.template = flat_template()
    out = fit_phase(image, model, crosstalk, levels, correction, doubt)
    return FittedPhase(*(runtime.to_host(o) for o in out)), model, correction


def limit(phase: np.ndarray, gamma: float, ambient: float) -> np.ndarray:
    step = 1e-4
    slope = (clean_light(phase + step, gamma, ambient) - clean_light(phase - step, gamma, ambient)) / (2 * step)
    return NOISE / np.sqrt((slope**2).sum(axis=-1))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize(("gamma", "ambient"), [(1.0, 0.0), (1.0, 0.1), (2.0, 0.05)])
def test_near_the_information_limit(arch, gamma, ambient):
    """Of the limit that knows everything but the phase: 1.18 at most, where brightness has to be found, too."""
    image, truth = noisy_frame(gamma, ambient)
    phase = recover(image)[0].phase
    error = reference.wrapped_difference(phase, truth)
    assert rms(error - error.mean()) < 1.25 * rms(limit(truth, gamma, ambient))
    assert abs(error.mean()) < 0.005


def test_the_precision_is_that_of_the_errors(arch):
    image, truth = noisy_frame(2.0, 0.05)
    phase, _, precision, _, _ = recover(image)[0]
    error = reference.wrapped_difference(phase, truth)
    z = (error - error.mean()) * np.sqrt(precision)
    assert 0.62 < np.mean(np.abs(z) < 1) < 0.72
    assert 0.92 < np.mean(np.abs(z) < 2) < 0.97


def test_the_misfit_is_that_of_noise_and_the_brightness_has_no_fringe(arch):
    """One on average, as its square is; the brightness is what the light is over a cycle, ambient light apart."""
    image, truth = noisy_frame(2.0, 0.05)
    found = recover(image)[0]
    assert found.misfit[20:-20, 20:-20].mean() == pytest.approx(1, abs=0.1)
    bright = found.brightness[20:-20, 20:-20].astype(float)
    along = bright / bright.mean(axis=0) - 1
    for harmonic in (1, 2, 3):
        wave = 2 * abs((along * np.exp(-1j * harmonic * truth[20:-20, 20:-20])).mean())
        assert wave < 0.02


def test_modulation_in_levels(arch):
    image, truth = noisy_frame(1.0, 0.1)
    modulation = recover(image)[0].modulation
    x = np.arange(truth.shape[1]) / truth.shape[1]
    # Of the balanced channels, whose mean stays.
    expected = 150 * 0.5 * (COLOR * MATRIX.sum(axis=1)).mean() * (1 - 0.6 * x)
    middle = modulation[30:90].mean(axis=0)
    assert np.abs(middle / expected - 1)[20:140].max() < 0.1


@pytest.mark.parametrize(("mixed", "gain"), [(False, 0.0), (True, 0.0), (False, 0.05)])
def test_as_the_twin(arch, mixed, gain):
    image, _ = noisy_frame(2.0, 0.05, (36, 48))
    image[16, 30] += 0.6 * (image[10:23, 30].mean(axis=0) - image[16, 30])  # no such contrast in the model
    found, model, correction = recover(image, mixed=mixed, gain=gain)
    phase, precision = found.phase, found.precision
    assert np.abs(model.sharpness.values).max() < 1e-6
    # Without a template there is no step.
    start = recover(image, mixed=mixed, gain=gain, fitted=False)[0].phase
    nodes = runtime.to_host(model.nodes).astype(np.float64)
    spacing_px = model.gains.spacing_px
    places = [(np.arange(n) + 0.5) / spacing_px - 0.5 for n in (36, 48)]
    y, x = (np.clip(place, 0, m - 1) for place, m in zip(places, nodes.shape[:2], strict=True))
    i, j = np.minimum(y.astype(int), nodes.shape[0] - 2), np.minimum(x.astype(int), nodes.shape[1] - 2)
    fy, fx = (y - i)[:, None, None], (x - j)[None, :, None]
    rows = nodes[i] * (1 - fy) + nodes[i + 1] * fy
    at = rows[:, j] * (1 - fx) + rows[:, j + 1] * fx
    mixing = MATRIX if mixed else None
    template = model.template.astype(np.float64)
    expected, sharp = reference.fit_phase(
        image.astype(float), start.astype(float), template, at[..., :3], at[..., 3:], (NOISE, gain), 0.02, mixing
    )
    close = np.abs(expected - start) < 0.29  # further off the step is cut
    np.testing.assert_allclose(reference.wrapped_difference(phase, expected)[close], 0, atol=2e-3)
    np.testing.assert_allclose(precision[close], sharp[close], rtol=0.02)
    assert template.shape == (3, 1 + 2 * HARMONICS)
    assert len(correction) == 257
    assert precision[16, 30] < 0.3 * precision[16, 28:30].mean()


def test_dark_and_clipped_pixels_have_no_phase(arch):
    image, _ = noisy_frame(1.0, 0.0)
    image[40:50, 60:70] = 0
    image[80:85, 20:30] = 255
    phase = recover(image)[0].phase
    assert (phase[40:50, 60:70] == NO_PHASE).all()
    assert (phase[80:85, 20:30] == NO_PHASE).all()
    assert np.mean(phase == NO_PHASE) < 0.02


def test_hardly_any_sample_leaves_the_arctangent(arch):
    """Three rows of lit pixels teach next to nothing: the template stays nearly flat, and the phase what it was."""
    image, _ = noisy_frame(1.0, 0.0, (24, 24))
    image[3:] = 0
    found, model, _ = recover(image)
    assert np.isfinite(found.phase).all()
    assert np.isfinite(model.template).all()
    assert np.abs(model.template[:, 1:]).max() < 1.0


@pytest.mark.parametrize("mixed", [False, True])
def test_counted_phases_are_those_of_the_public_chain(arch, mixed):
    """With gains of one: crosstalk undone, arctangent, histogram; a phase at a bin's edge may fall to either side."""
    image = np.round(noisy_frame(1.0, 0.1, (60, 96))[0]).clip(0, 255)
    crosstalk = crosstalk_of(MATRIX, mixed=mixed)
    levels = FrameLevels(255.0, NOISE, 0.0, NOISE, 5.0, 5.0)
    gains = Gains(60, 96, PERIOD_PX)
    gains.measure(image, crosstalk, levels)
    gains.gains.fill(1)
    counted = ChannelModel(gains).recover(crosstalk, levels)
    samples = runtime.to_host(gains.samples)
    unmixed = tikernels.correct_crosstalk(samples, crosstalk.matrix.astype(np.float64))
    phase, modulation, _ = tikernels.compute_wrapped_phase(unmixed)
    assert (modulation > levels.modulation).all()  # nothing is dark or clipped
    expected = measure_distribution(phase, counted.shape[1])
    assert counted.sum() == expected.sum() == samples.shape[0] * samples.shape[1]
    assert np.abs(counted.sum(axis=0) - expected).sum() <= 4


def test_what_does_not_fit_is_refused(arch):
    image, _ = noisy_frame(1.0, 0.0, (24, 32))
    crosstalk = Crosstalk.of(MATRIX)
    levels = FrameLevels(255.0, NOISE, 0.0, NOISE, 5.0, 5.0)
    gains = Gains(24, 32, PERIOD_PX)
    model = ChannelModel(gains)
    rest = (model, crosstalk, levels, np.zeros(257, np.float32), 0.02)
    with pytest.raises(tikernels.ShapeError, match=r"image has shape \(24, 31, 3\), expected \(24, 32, 3\)"):
        fit_phase(image[:, :31], *rest)
    with pytest.raises(tikernels.ShapeError, match=r"precision has shape \(2, 2\), expected \(24, 32\)"):
        shapes = [(24, 32), (24, 32), (2, 2), (24, 32), (24, 32)]
        fit_phase(image, *rest, out=FittedPhase(*(np.empty(shape, np.float32) for shape in shapes)))
