"""What the model is wrong by shows where it is wrong, and not where only noise is left."""

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
from tikernels.phase.model_error import ModelError
from tikernels.phase.phase_fit import count_phases, fit_phase
from tikernels.phase.surfaces import Surfaces

MATRIX = np.array(TYPICAL_CROSSTALK)
DELAYS = np.array([-1, 0, 1]) * 2 * np.pi / 3
SHAPE, PERIOD_PX, NOISE = (240, 320), 12.3, 1.5
LEVELS = FrameLevels(255.0, NOISE, 0.0, NOISE, 5.0, 5.0)


def measured(colored: tuple[float, float, float], *, mixed: bool = False):
    """Return model error, phase and truth of a white plane whose right half has narrow-band reflectances."""
    truth = reference.ramp(*SHAPE, PERIOD_PX, tilt=0.02)
    light = 0.5 + 0.5 * np.cos(truth[..., None] + DELAYS)
    light[:, 160:] *= colored
    noise = NOISE * np.random.default_rng(7).standard_normal((*SHAPE, 3))
    image = (200 * light @ MATRIX.T + noise).astype(np.float32)
    crosstalk = Crosstalk.of(np.eye(3), surfaces=Surfaces.of(MATRIX)) if mixed else Crosstalk.of(MATRIX)
    gains = Gains(*SHAPE, PERIOD_PX)
    model = ChannelModel(gains)
    gains.measure(image, crosstalk, LEVELS)
    correction = correction_table(count_phases(image, gains, crosstalk, LEVELS), 9)
    model.fit(crosstalk, LEVELS, correction, flat_template())
    given = (model, crosstalk, LEVELS)
    phase = fit_phase(image, *given, correction, 0.02)[0]
    error = runtime.to_host(ModelError(gains).measure(image, phase, *given, 0.02))
    return error, reference.wrapped_difference(runtime.to_host(phase), truth), (image, phase, given, gains)


def test_noise_alone_leaves_next_to_nothing(arch):
    """Against the noise's own variance, 0.02 rad squared, what chance leaves of some hundred samples."""
    error, difference, _ = measured((1, 1, 1))
    assert np.sqrt(error[3:-3, 3:-3].mean()) < 0.4 * difference.std()


def test_another_colour_widens_its_own_half(cpu):
    """A saturated surface bends the phase by more than the noise; what is said of it is right to a factor of two."""
    error, difference, _ = measured((1.0, 0.35, 0.12))
    colored, white = (np.sqrt(error[5:-5, part].mean()) for part in (slice(26, 36), slice(4, 14)))
    left, right = (difference[40:200, part] for part in (slice(30, 110), slice(210, 290)))
    true = np.sqrt(max((right - right.mean()).var() - NOISE**2 / 100**2, 0))
    assert true > 0.04
    assert 0.5 < colored / true < 2
    assert white < 2 * (left - left.mean()).std()


@pytest.mark.parametrize("mixed", [False, True])
def test_where_the_colour_acts_as_the_model_says_nothing_is_left(cpu, mixed):
    """Reflectances that act on the projector's light are what balancing after the crosstalk takes them for."""
    error, _, _ = measured((1.0, 0.35, 0.12), mixed=mixed)
    colored = np.sqrt(error[5:-5, 26:36].mean())
    assert (colored < 0.012) == mixed


def test_dark_frames_and_other_shapes(cpu):
    _, _, (image, phase, given, gains) = measured((1, 1, 1))
    nothing = np.full(SHAPE, 1e9, np.float32)
    error = ModelError(gains).measure(image, nothing, *given, 0.02)
    assert not runtime.to_host(error).any()
    for bad_image, bad_phase in ((image[:-1], phase), (image, runtime.to_host(phase)[:-1])):
        with pytest.raises(tikernels.ShapeError, match="has shape"):
            ModelError(gains).measure(bad_image, bad_phase, *given, 0.02)
