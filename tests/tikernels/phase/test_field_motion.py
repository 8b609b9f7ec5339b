"""Motion between the colours of a frame, undone by the frame before."""

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
from tikernels.phase.field_motion import measure_motion, undo_field_motion
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_fit import count_phases, fit_phase
from tikernels.phase.surfaces import Surfaces
from tikernels.phase.wrapped_phase import NO_PHASE

MATRIX = np.array(TYPICAL_CROSSTALK)
DELAYS = np.array([-1, 0, 1]) * 2 * np.pi / 3
SHAPE, PERIOD_PX = (180, 240), 12.3
LEVELS = FrameLevels(255.0, 1.0, 0.0, 1.0, 5.0, 5.0)
TIMES = np.array([0.1, 0.4, 0.7])


def photograph(moved: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a frame of a plane whose left half moves by this phase a frame, and the phase when green is shown."""
    phase = reference.ramp(*SHAPE, PERIOD_PX, tilt=0.02)
    speed = np.where(np.arange(SHAPE[1]) < SHAPE[1] // 2, moved, 0.0)
    each = phase[..., None] + speed[:, None] * (TIMES - TIMES[1]) + DELAYS
    light = 0.5 + 0.5 * np.cos(each)
    return (180 * light @ MATRIX.T + 10).astype(np.float32), phase


def decode(image: np.ndarray, crosstalk: Crosstalk):
    gains = Gains(*SHAPE, PERIOD_PX)
    model = ChannelModel(gains)
    gains.measure(image, crosstalk, LEVELS)
    correction = correction_table(count_phases(image, gains, crosstalk, LEVELS), 9)
    model.fit(crosstalk, LEVELS, correction, flat_template())
    return model, fit_phase(image, model, crosstalk, LEVELS, correction, 0.02)


def second_harmonics(phase: np.ndarray, truth: np.ndarray) -> list[float]:
    """Return that of the error of the half that moves, and of the other."""
    error, inside = reference.wrapped_difference(phase, truth), (slice(20, -20), slice(10, 100))
    halves = [(part[:, :120][inside], truth[:, :120][inside]) for part in (error,)]
    halves += [(error[:, 120:][inside], truth[:, 120:][inside])]
    return [float(2 * abs((part * np.exp(-2j * true)).mean())) for part, true in halves]


def before_of(truth: np.ndarray, moved: float) -> np.ndarray:
    then = truth.copy()
    then[:, : SHAPE[1] // 2] -= moved
    return then.astype(np.float32)


@pytest.mark.parametrize("mixed", [False, True])
def test_what_moves_between_the_colours_leaves_no_second_harmonic(arch, mixed):
    """0.4 rad a frame; the template has half of it in it, so both halves are off, and neither is any more."""
    crosstalk = Crosstalk.of(np.eye(3), surfaces=Surfaces.of(MATRIX)) if mixed else Crosstalk.of(MATRIX)
    image, truth = photograph(0.4)
    model, (phase, modulation, precision, _, _) = decode(image, crosstalk)
    before, sure = second_harmonics(runtime.to_host(phase), truth), runtime.to_host(precision).copy()
    motion = measure_motion(phase, before_of(truth, 0.4), TIMES, PERIOD_PX)
    assert np.nanmedian(motion.change[:, :100]) == pytest.approx(0.4, abs=0.01)
    assert motion.too_fast < 0.05
    own = motion.beyond_mean(modulation)
    undo_field_motion(image, own, model, crosstalk, LEVELS, 0.02, out=(phase, precision))
    after = second_harmonics(runtime.to_host(phase), truth)
    assert min(before) > 0.02
    assert max(after) < 0.45 * min(before)
    assert (runtime.to_host(precision) <= sure).all()
    assert runtime.to_host(precision).mean() < 0.95 * sure.mean()


def test_what_holds_still_stays(cpu):
    crosstalk = Crosstalk.of(MATRIX)
    image, _ = photograph(0.0)
    model, (phase, _, precision, _, _) = decode(image, crosstalk)
    kept = runtime.to_host(phase).copy()
    motion = measure_motion(phase, kept, TIMES, PERIOD_PX)
    undo_field_motion(image, motion, model, crosstalk, LEVELS, 0.02, out=(phase, precision))
    np.testing.assert_allclose(runtime.to_host(phase), kept, atol=1e-3)


def test_the_frame_has_its_middle_colours_time(cpu):
    motion = measure_motion(
        np.zeros((40, 40), np.float32), np.zeros((40, 40), np.float32), np.array([0.7, 0.1, 0.4]), 12.0
    )
    np.testing.assert_allclose(motion.times, [0.3, -0.3, 0.0])
    offsets = motion._replace(change=np.full((40, 40), 0.2, np.float32)).offsets(np.array([3]), np.array([5]))
    np.testing.assert_allclose(offsets, [[0.06, -0.06, 0.0]], atol=1e-6)


def test_what_is_too_fast_or_new_is_not_known(cpu):
    now = reference.wrapped(reference.ramp(*SHAPE, PERIOD_PX)).astype(np.float32)
    then = (now - 0.2).astype(np.float32)
    then[:, :60] -= np.float32(2.5)  # more than a third of a cycle
    then[:, 180:] = np.nan  # nothing was seen there
    now[:, 120:140] = NO_PHASE
    motion = measure_motion(now, then, TIMES, PERIOD_PX)
    assert np.isnan(motion.change[:, :40]).all()
    assert np.isnan(motion.change[:, 215:]).all()
    np.testing.assert_allclose(motion.change[:, 100:112], 0.2, atol=0.02)
    assert 0.25 < motion.too_fast < 0.5


def test_other_shapes_are_refused(cpu):
    crosstalk = Crosstalk.of(MATRIX)
    image, _ = photograph(0.0)
    model, out = decode(image, crosstalk)
    with pytest.raises(tikernels.ShapeError, match="before has shape"):
        measure_motion(out[0], np.zeros((4, 4), np.float32), TIMES, PERIOD_PX)
    motion = measure_motion(out[0], runtime.to_host(out[0]), TIMES, PERIOD_PX)
    with pytest.raises(tikernels.ShapeError, match="image has shape"):
        undo_field_motion(image[:-1], motion, model, crosstalk, LEVELS, 0.02, out=(out[0], out[2]))
