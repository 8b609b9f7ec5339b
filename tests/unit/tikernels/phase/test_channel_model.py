"""The channels' model of a frame that is made by that very model: template, colour and ambient light come back."""

import numpy as np
import pytest
import reference
from support.array_forms import every_second, on_device, read_only

import tikernels
from pipeline.simulation import TYPICAL_CROSSTALK
from tikernels import runtime
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.channel_template import HARMONICS, flat_template, known_template
from tikernels.phase.color_balance import Gains
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import correction_table
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.projector_response import light_spectrum
from tikernels.phase.wrapped_phase import NO_PHASE

MATRIX = np.array(TYPICAL_CROSSTALK)
MATRIX /= MATRIX.sum(axis=1, keepdims=True)
COLOR = np.array([0.75, 0.52, 0.42])
DELAYS = np.array([-1, 0, 1]) * 2 * np.pi / 3
PERIOD_PX = 12.3
SHAPE = (240, 192)
LEVELS = FrameLevels(white=255.0, read_noise=0.3, noise_gain=0.0, noise=0.3, intensity=3.0, modulation=3.0)


def frame(gamma: float, ambient: float) -> np.ndarray:
    """Return (H, W, 3) levels of a coloured plane whose brightness falls off to the right, in ambient light."""
    phase = reference.ramp(*SHAPE, PERIOD_PX, tilt=0.02)
    light = (0.5 + 0.5 * np.cos(phase[..., None] + DELAYS)) ** gamma @ MATRIX.T
    brightness = 1 - 0.7 * np.arange(SHAPE[1]) / SHAPE[1]
    noise = LEVELS.read_noise * np.random.default_rng(1).standard_normal((*SHAPE, 3))
    return (250 * COLOR * (brightness[:, None] * light + ambient) + noise).astype(np.float32)


def fitted(image: np.ndarray) -> tuple[ChannelModel, Gains]:
    crosstalk = Crosstalk.of(MATRIX)
    gains = Gains(*SHAPE, PERIOD_PX)
    model = ChannelModel(gains)
    gains.measure(image, crosstalk, LEVELS)
    correction = correction_table(model.recover(crosstalk, LEVELS), 9)
    model.fit(crosstalk, correction, flat_template(), 0.02)
    return model, gains


@pytest.mark.parametrize(("gamma", "ambient"), [(1.0, 0.0), (2.0, 0.0), (2.0, 0.05)])
def test_the_template_is_read_off_the_frame(arch, gamma, ambient):
    """To 3 % of the mean, which bends the phase by a hundredth of a radian at most."""
    model, _ = fitted(frame(gamma, ambient))
    waves = model.template[:, 1 : 1 + HARMONICS] - 1j * model.template[:, 1 + HARMONICS :]
    response = np.tile(np.linspace(0, 1, 4096) ** gamma, (3, 1))
    known = known_template(MATRIX, light_spectrum(response))
    expected = known[:, 1 : 1 + HARMONICS] - 1j * known[:, 1 + HARMONICS :]
    assert np.abs(waves - expected).max() < 0.03
    assert model.mismatch < 0.03


def test_a_fourth_harmonic_is_read_off_a_response_that_has_a_third(cpu):
    """At gamma 2.3 the brightness that samples are divided by has a third harmonic, which makes the fourth."""
    model, _ = fitted(frame(2.3, 0.0))
    phase = np.linspace(0, 2 * np.pi, 1024, endpoint=False)
    light = MATRIX @ (0.5 + 0.5 * np.cos(phase + DELAYS[:, None])) ** 2.3
    light /= (np.linalg.inv(MATRIX) @ light).mean(axis=0)
    waves = 2 * np.fft.rfft(light / light.mean(axis=1, keepdims=True), axis=1)[:, 4] / 1024
    found = model.template[:, 4] - 1j * model.template[:, 4 + HARMONICS]
    assert np.abs(waves).min() > 0.01
    assert np.abs(found - waves).max() < 0.003


def test_a_window_that_is_cut_off_is_no_worse(cpu):
    """At the first and the last rows half of the window is empty, and 0.15 of the fringe passes it."""
    model, _ = fitted(frame(2.0, 0.0))
    colors = runtime.to_host(model.nodes)[..., :3]
    colors = colors / colors.mean(axis=-1, keepdims=True)
    edges = colors[[0, -1], 6:-6]
    np.testing.assert_allclose(edges, np.broadcast_to(COLOR / COLOR.mean(), edges.shape), rtol=0.015)


def test_nodes_are_colour_and_ambient_light(arch):
    """A is the surface's colour up to a factor that brightness takes; B the ambient light, to a level of 255."""
    ambient = 0.05
    model, _ = fitted(frame(2.0, ambient))
    nodes = runtime.to_host(model.nodes)[4:-4, 4:-4]
    color = nodes[..., :3] / nodes[..., :3].mean(axis=-1, keepdims=True)
    np.testing.assert_allclose(color, np.broadcast_to(COLOR / COLOR.mean(), color.shape), rtol=0.03)
    np.testing.assert_allclose(nodes[..., 3:].mean(axis=(0, 1)), 250 * ambient * COLOR, atol=1.0)


def test_the_contrast_is_that_of_the_light(arch):
    """Sinusoids of full contrast, three of whose channels mix; ambient light takes its share of it."""
    bare, lit = (fitted(frame(1.0, ambient))[0].contrast for ambient in (0.0, 0.2))
    assert bare == pytest.approx(1.0, abs=0.02)
    assert lit == pytest.approx(0.5 * 0.65 / (0.5 * 0.65 + 0.2), rel=0.05)


def test_dark_and_clipped_samples_say_nothing(arch):
    image = frame(1.0, 0.0)
    image[:60], image[100:140] = 0, 255
    phases = runtime.to_host(fitted(image)[0].phases)
    assert (phases[:60] == NO_PHASE).all()
    assert (phases[100:140] == NO_PHASE).all()
    assert (np.abs(phases[150:230]) <= np.float32(np.pi)).mean() > 0.95


def test_a_dark_frame_keeps_what_is_known(arch):
    model, _ = fitted(np.zeros((*SHAPE, 3), np.float32))
    np.testing.assert_allclose(model.template, flat_template(), atol=1e-6)
    assert np.isnan(model.contrast) and np.isnan(model.mismatch)


def test_what_a_fit_takes_and_refuses(arch):
    """Every form of an array gives the same; and whatever was fitted before, a frame gives what it gives."""
    image, crosstalk = frame(2.0, 0.05), Crosstalk.of(MATRIX)
    model, _ = fitted(image)
    first = model.template.copy(), runtime.to_host(model.nodes).copy()
    correction, known = correction_table(model.recover(crosstalk, LEVELS), 9), flat_template()
    for form in (np.copy, every_second, read_only, on_device):
        model.recover(crosstalk, LEVELS)
        model.fit(crosstalk, form(correction), form(known), 0.02)
        np.testing.assert_array_equal(model.template, first[0])
        np.testing.assert_array_equal(runtime.to_host(model.nodes), first[1])
    for bad in (correction.astype(np.float64), correction[None], correction[:0], correction.tolist()):
        with pytest.raises(tikernels.ShapeError, match=r"correction (has shape|is)"):
            model.recover(crosstalk, LEVELS)
            model.fit(crosstalk, bad, known, 0.02)
    for bad in (known.astype(np.float64), known[None], known[:, :-1], known[:2], known.tolist()):
        with pytest.raises(tikernels.ShapeError, match=r"known (has shape|is)"):
            model.recover(crosstalk, LEVELS)
            model.fit(crosstalk, correction, bad, 0.02)


def test_a_fringe_that_shows_twelve_phases_tells_the_template(cpu):
    """It runs along the rows with exactly 12 px a cycle; rows must not be left out, or three phases would be left."""
    phase = np.broadcast_to(2 * np.pi / 12 * np.arange(SHAPE[0])[:, None], SHAPE)
    light = 0.5 + 0.3 * np.cos(phase[..., None] + DELAYS)
    noise = np.random.default_rng(3).standard_normal((*SHAPE, 3))
    model, _ = fitted((200 * light @ MATRIX.T + noise).astype(np.float32))
    waves = model.template[:, 1 : 1 + HARMONICS] - 1j * model.template[:, 1 + HARMONICS :]
    first = 0.6 * MATRIX @ np.exp(1j * DELAYS)
    assert np.abs(waves[:, 0] - first * np.exp(1j * np.angle((waves[:, 0] / first).mean()))).max() < 0.02
    assert np.abs(waves[:, 1:]).max() < 0.02
