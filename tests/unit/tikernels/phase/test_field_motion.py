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
from tikernels.phase.color_fields import ColorFields
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import correction_table
from tikernels.phase.field_motion import FieldMotion, doubt_motion, hold_still, measure_motion, measure_rows
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_fit import fit_phase
from tikernels.phase.surfaces import Surfaces
from tikernels.phase.wrapped_phase import NO_PHASE

MATRIX = np.array(TYPICAL_CROSSTALK)
DELAYS = np.array([-1, 0, 1]) * 2 * np.pi / 3
SHAPE, PERIOD_PX = (180, 240), 12.3
LEVELS = FrameLevels(255.0, 1.0, 0.0, 1.0, 5.0, 5.0)
THIRDS = np.array([[0, 1], [1, 2], [2, 3]]) / 3
FIELDS = ColorFields(0.9, shown=THIRDS, start=0.0)
ROLLING = ColorFields(0.9, 1.0 / SHAPE[0], THIRDS, start=0.0)


def photograph(moved: float, fields: ColorFields = FIELDS) -> tuple[np.ndarray, np.ndarray]:
    """Return a frame of a plane whose left half moves by this phase a frame, and the phase when green is shown."""
    phase = reference.ramp(*SHAPE, PERIOD_PX, tilt=0.02)
    speed = np.where(np.arange(SHAPE[1]) < SHAPE[1] // 2, moved, 0.0)
    each = phase[..., None] + speed[:, None] * fields.times(SHAPE[0])[0][:, None] + DELAYS
    light = 0.5 + 0.5 * np.cos(each)
    return (180 * light @ MATRIX.T + 10).astype(np.float32), phase


def decode(image: np.ndarray, crosstalk: Crosstalk):
    gains = Gains(*SHAPE, PERIOD_PX)
    model = ChannelModel(gains)
    gains.measure(image, crosstalk, LEVELS)
    correction = correction_table(model.recover(crosstalk, LEVELS), 9)
    model.fit(crosstalk, correction, flat_template(), 0.02)
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


def held_still(image: np.ndarray, truth: np.ndarray, crosstalk: Crosstalk, moved: float, fields: ColorFields = FIELDS):
    """Return what was measured, the phase before and after, and the image after."""
    model, fit = decode(image, crosstalk)
    first = runtime.to_host(fit.phase).copy()
    motion = measure_motion(fit.phase, before_of(truth, moved), fields, None, PERIOD_PX)
    still = hold_still(image, fit, motion, model, crosstalk, motion.lags(fit.modulation))
    return motion, [first, runtime.to_host(decode(still, crosstalk)[1].phase)], runtime.to_host(still)


@pytest.mark.parametrize("mixed", [False, True])
def test_what_moves_between_the_colours_leaves_no_second_harmonic(arch, mixed):
    """0.4 rad a frame; the template has half of it in it, so both halves are off, and neither is any more."""
    crosstalk = Crosstalk.of(np.eye(3), surfaces=Surfaces.of(MATRIX)) if mixed else Crosstalk.of(MATRIX)
    image, truth = photograph(0.4)
    motion, phases, still = held_still(image, truth, crosstalk, 0.4)
    assert np.nanmedian(motion.change[:, :100]) == pytest.approx(0.4, abs=0.01)
    assert motion.too_fast < 0.05
    before, after = (second_harmonics(phase, truth) for phase in phases)
    assert min(before) > 0.012
    assert max(after) < 0.4 * min(before)
    # All but the border between the halves, over which the change is averaged, is as if nothing had moved.
    error = (still - photograph(0.0)[0])[20:-20, 10:-10]
    assert np.sqrt((np.delete(error, np.s_[90:130], axis=1) ** 2).mean()) < 1.5


def test_rows_that_are_exposed_one_after_another_have_their_own_times(cpu):
    """All rows together see all of a cycle, so that the template has no motion in it."""
    image, truth = photograph(0.4, ROLLING)
    _, (before, after), still = held_still(image, truth, Crosstalk.of(MATRIX), 0.4, ROLLING)
    moving = slice(20, -20), slice(10, 100)
    first, left = (reference.wrapped_difference(phase, truth)[moving].std() for phase in (before, after))
    assert first > 0.03
    assert left < 0.3 * first
    error = (still - photograph(0.0)[0])[moving]
    assert np.sqrt((error**2).mean()) < 1.5


def test_what_holds_still_stays(cpu):
    crosstalk = Crosstalk.of(MATRIX)
    image, truth = photograph(0.0)
    _, _, still = held_still(image, truth, crosstalk, 0.0)
    np.testing.assert_allclose(still, image, atol=0.5)


def test_without_a_phase_or_a_change_nothing_is_added(cpu):
    crosstalk = Crosstalk.of(MATRIX)
    image, truth = photograph(0.4)
    image[40:60] = 0
    model, fit = decode(image, crosstalk)
    motion = measure_motion(fit.phase, before_of(truth, 0.4), FIELDS, None, PERIOD_PX)
    motion.change[:, :30] = np.nan
    still = runtime.to_host(hold_still(image, fit, motion, model, crosstalk))
    np.testing.assert_array_equal(still[40:60], image[40:60])
    np.testing.assert_array_equal(still[:, :30], image[:, :30])
    assert np.abs(still - image).max() > 5


def seen_phase(
    fields: ColorFields, moved: float, hypothesis: int, *, rows_last: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return the phase of a plane whose left half moves, as a first fit sees it, and that of the frame before."""
    height, width = 360, 360
    phase = reference.ramp(height, width, PERIOD_PX, tilt=0.02)
    speed = np.where(np.arange(width) < width // 2, moved, 0.0)
    turned = np.cos(2 * phase[..., None] + 2 * DELAYS)
    times = np.expand_dims(fields.times(360)[hypothesis], 0 if rows_last else 1)
    error = -speed / 3 * (turned * times).sum(axis=-1)
    noise = np.random.default_rng(5).normal(0, 0.05, phase.shape)
    return reference.wrapped(phase + error + noise).astype(np.float32), (phase - speed).astype(np.float32)


@pytest.mark.parametrize("rows_last", [False, True])
@pytest.mark.parametrize("start", [3, 20, 41, 62])
def test_the_start_of_an_exposure_is_found_and_its_rows(cpu, start, rows_last):
    """A rolling shutter's rows see all of a cycle; 0.5 rad per frame, noise 0.05 rad."""
    fields = ColorFields(0.5, row=1.2 / 360, shown=THIRDS)
    seen = seen_phase(fields, 0.5, start, rows_last=rows_last)
    motion = measure_motion(*seen, fields, None, PERIOD_PX, rows_last=rows_last)
    found = np.angle((motion.shares * np.exp(2j * np.pi * np.arange(64) / 64)).sum()) / (2 * np.pi)
    assert abs((found - start / 64 + 0.5) % 1 - 0.5) < 0.03
    assert motion.times.shape == ((1, 360, 3) if rows_last else (360, 1, 3))
    assert np.abs(motion.times.reshape(360, 3) - fields.times(360)[start]).max() < 0.05
    assert motion.unknown == 0
    # What a frame has shown holds for the next one, a whole number of cycles later.
    seen = seen_phase(fields, 0.0, start, rows_last=rows_last)
    still = measure_motion(*seen, fields, motion.shares, PERIOD_PX, rows_last=rows_last)
    np.testing.assert_allclose(still.times, motion.times, atol=0.02)


@pytest.mark.parametrize("order", ["RGB", "RBG"])
def test_an_unknown_order_is_shown_by_the_rows(cpu, order):
    fields, shares = ColorFields(0.5, row=1.2 / 360), None
    seen = seen_phase(fields, 1.0, 20 + 64 * (order == "RBG"))
    for _ in range(3):
        shares = measure_motion(*seen, fields, shares, PERIOD_PX).shares
    assert fields.found_order(shares, 360) == order


def test_of_what_holds_still_nothing_is_known_and_nothing_is_missing(cpu):
    fields = ColorFields(0.5, row=1.2 / 360)
    motion = measure_motion(*seen_phase(fields, 0.0, 0), fields, None, PERIOD_PX)
    assert motion.shares.max() < 1.1 / 128
    assert motion.unknown == 0
    assert fields.found_order(motion.shares, 360) is None
    # The same times, while half of the surface moves: they are missed.
    moving = measure_motion(*seen_phase(fields, 0.0, 0)[:1], seen_phase(fields, 0.5, 0)[1], fields, None, PERIOD_PX)
    assert 0.3 < moving.unknown < 0.6


def test_a_fifth_of_what_is_undone_is_in_doubt(arch):
    """And all that is unsure of the times; no more than three standard deviations, beyond which the fit speaks."""
    change = np.array([[0.0, 0.4, 3.0, np.nan, 0.4]], np.float32)
    times, unsure = np.array([[[-0.3, 0.0, 0.3]]], np.float32), np.array([[0.1]], np.float32)
    motion = FieldMotion(change, times, unsure, np.ones(1), 0.0)
    misfit = np.array([[1.0, 1.0, 1.0, 1.0, 20.0]], np.float32)
    doubt_motion(motion, np.full((1, 5), 1e3, np.float32), misfit)
    expected = 1 + ((0.2 * np.std(times)) ** 2 + 0.1**2) * 0.4**2 * 1e3
    np.testing.assert_allclose(misfit, [[1.0, expected, 9.0, 1.0, 20.0]], rtol=1e-5)


def test_what_is_too_fast_or_new_is_not_known(cpu):
    now = reference.wrapped(reference.ramp(*SHAPE, PERIOD_PX)).astype(np.float32)
    then = (now - 0.2).astype(np.float32)
    then[:, :60] -= np.float32(2.5)  # more than a third of a cycle
    then[:, 180:] = np.nan  # nothing was seen there
    now[:, 120:140] = NO_PHASE
    motion = measure_motion(now, then, FIELDS, None, PERIOD_PX)
    assert np.isnan(motion.change[:, :40]).all()
    assert np.isnan(motion.change[:, 215:]).all()
    np.testing.assert_allclose(motion.change[:, 100:112], 0.2, atol=0.02)
    assert 0.25 < motion.too_fast < 0.5


@pytest.mark.parametrize("rows_last", [False, True])
def test_rows_change_by_the_time_from_the_middle_one_to_their_own(cpu, rows_last):
    """The phase grows by 0.4 rad a frame, and 0.004 more from column to column; a third of the frame is new."""
    now = reference.ramp(*SHAPE, PERIOD_PX)
    change = 0.4 + 0.004 * np.arange(SHAPE[1])
    then = now - change + 2 * np.pi  # of another order
    then[:60] = np.nan
    now, then = (phase.astype(np.float32) for phase in ((now.T, then.T) if rows_last else (now, then)))
    motion = measure_rows(now, then, 0.003, PERIOD_PX, rows_last=rows_last)
    moved = motion.since_middle.T if rows_last else motion.since_middle
    expected = change * 0.003 * (np.arange(SHAPE[0]) - (SHAPE[0] - 1) / 2)[:, None]
    np.testing.assert_allclose(moved[60:, 10:-10], expected[60:, 10:-10], atol=1e-3)
    assert not moved[:40].any()
    assert motion.too_fast == 0
    misfit = np.zeros(now.shape, np.float32)
    doubt_motion(motion, np.full(now.shape, 100, np.float32), misfit)
    doubt = misfit.T if rows_last else misfit
    np.testing.assert_allclose(doubt[60:, 10:-10], 100 * (0.2 * expected[60:, 10:-10]) ** 2, atol=2e-3)
    later = measure_rows(now, then, 0.003, PERIOD_PX, elapsed=3.0, rows_last=rows_last)  # a frame of three
    np.testing.assert_allclose(later.times, motion.times / 3, rtol=1e-5)
    assert later.doubt == pytest.approx(0.6) and later.guessed > 0.3 and motion.guessed == 0
    then -= np.float32(2.0)  # 2.4 rad a frame and more
    fast = measure_rows(now, then, 0.003, PERIOD_PX, rows_last=rows_last)
    assert fast.too_fast > 0.95
    assert not fast.since_middle.any()


def test_other_shapes_are_refused(cpu):
    crosstalk = Crosstalk.of(MATRIX)
    image, _ = photograph(0.0)
    model, fit = decode(image, crosstalk)
    with pytest.raises(tikernels.ShapeError, match="before has shape"):
        measure_motion(fit.phase, np.zeros((4, 4), np.float32), FIELDS, None, PERIOD_PX)
    motion = measure_motion(fit.phase, runtime.to_host(fit.phase), FIELDS, None, PERIOD_PX)
    with pytest.raises(tikernels.ShapeError, match="before has shape"):
        measure_rows(fit.phase, np.zeros((4, 4), np.float32), 0.1, PERIOD_PX)
    with pytest.raises(tikernels.ShapeError, match="image has shape"):
        hold_still(image[:-1], fit, motion, model, crosstalk)
    with pytest.raises(tikernels.ShapeError, match="misfit has shape"):
        doubt_motion(motion, fit.precision, np.zeros((4, 4), np.float32))
