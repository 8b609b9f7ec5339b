"""Where the projector is out of focus is read off the frame, and the phase is none the worse for it."""

import numpy as np
import pytest
import reference

import tikernels
from pipeline.simulation import TYPICAL_CROSSTALK
from tikernels import runtime
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.channel_template import flat_template
from tikernels.phase.color_balance import Gains
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import correction_table
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.fringe_sharpness import FringeSharpness
from tikernels.phase.phase_fit import fit_phase

MATRIX = np.array(TYPICAL_CROSSTALK)
DELAYS = np.array([-1, 0, 1]) * 2 * np.pi / 3
COLOR = np.array([0.75, 0.52, 0.42])
SHAPE, PERIOD_PX = (240, 320), 12.3
LEVELS = FrameLevels(white=255.0, read_noise=1.0, noise_gain=0.0, noise=1.0, intensity=3.0, modulation=3.0)
#: Harmonics 0 to 2 of light at gamma 2, and of a pattern that is compensated for it.
PLAIN, COMPENSATED = (3 / 8, 1 / 2, 1 / 8), (1 / 2, 1 / 2, 0)


def photograph(blurs: np.ndarray, spectrum: tuple[float, float, float] = PLAIN) -> tuple[np.ndarray, np.ndarray]:
    """Return a frame of a plane whose columns are blurred by q each, and its phase."""
    phase = reference.ramp(*SHAPE, PERIOD_PX, tilt=0.02)
    each = phase[..., None] + DELAYS
    light = sum(part * blurs[:, None] ** n**2 * np.cos(n * each) for n, part in enumerate(spectrum))
    noise = LEVELS.read_noise * np.random.default_rng(1).standard_normal((*SHAPE, 3))
    return (230 * COLOR * (light @ MATRIX.T) + 4 + noise).astype(np.float32), phase


def decode(image: np.ndarray) -> tuple[ChannelModel, np.ndarray]:
    crosstalk, gains = Crosstalk.of(MATRIX), Gains(*SHAPE, PERIOD_PX)
    model = ChannelModel(gains)
    gains.measure(image, crosstalk, LEVELS)
    correction = correction_table(model.recover(crosstalk, LEVELS), 9)
    model.fit(crosstalk, correction, flat_template(), 0.02)
    return model, runtime.to_host(fit_phase(image, model, crosstalk, LEVELS, correction, 0.02).phase)


def third_harmonic(phase: np.ndarray, truth: np.ndarray, columns: slice) -> float:
    inside = (slice(20, -20), columns)
    return float(2 * abs((reference.wrapped_difference(phase, truth) * np.exp(-3j * truth))[inside].mean()))


def test_a_half_that_is_out_of_focus(arch):
    """A blur that takes a quarter of the fringe bends both halves by 0.08 rad if the mean is taken for both."""
    blurs = np.where(np.arange(SHAPE[1]) < SHAPE[1] // 2, 1.0, 0.75)
    image, truth = photograph(blurs)
    model, phase = decode(image)
    values = model.sharpness.values
    sharp, blurred = (float(np.median(part)) for part in (values[:, 4:20], values[:, -20:-4]))
    assert sharp - blurred == pytest.approx(-np.log(0.75), rel=0.25)
    # What equalises the arctangent is the mean over the frame.
    assert np.exp(3 * values).mean() == pytest.approx(1, abs=0.05)
    for columns in (slice(20, 120), slice(200, 300)):
        assert third_harmonic(phase, truth, columns) < 0.02


def test_an_even_focus_stays_even(cpu):
    image, truth = photograph(np.full(SHAPE[1], 0.9))
    model, phase = decode(image)
    assert np.abs(model.sharpness.values).max() < 0.008
    assert third_harmonic(phase, truth, slice(20, 300)) < 0.005


def test_light_without_harmonics_tells_no_focus(cpu):
    """Of a compensated pattern; the blur is there."""
    image, truth = photograph(np.linspace(1.0, 0.7, SHAPE[1]), COMPENSATED)
    model, phase = decode(image)
    assert np.abs(model.sharpness.values).max() < 0.2
    assert third_harmonic(phase, truth, slice(20, 300)) < 0.005


def test_without_samples_nothing_is_told(cpu):
    model, _ = decode(np.zeros((*SHAPE, 3), np.float32))
    assert (model.sharpness.values == 0).all()


def test_other_shapes_are_refused(cpu):
    sharpness = FringeSharpness((10, 12), (5, 12), (4.0, 5.0))
    samples, phases = np.zeros((40, 12, 3), np.float32), np.zeros((40, 12), np.float32)
    tables = (np.zeros(65, np.float32), flat_template())
    with pytest.raises(tikernels.ShapeError, match="samples has shape"):
        sharpness.refine(samples[:, :-1], phases, *tables, np.zeros((5, 12, 6), np.float32), 4, 0.01)
    with pytest.raises(tikernels.ShapeError, match="phases has shape"):
        sharpness.refine(samples, phases[:-1], *tables, np.zeros((5, 12, 6), np.float32), 4, 0.01)
    with pytest.raises(tikernels.ShapeError, match="nodes has shape"):
        sharpness.refine(samples, phases, *tables, np.zeros((5, 11, 6), np.float32), 4, 0.01)
