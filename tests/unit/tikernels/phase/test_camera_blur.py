"""Blur turns the phase beside edges of paint, and is undone."""

import cv2
import numpy as np
import pytest
import reference

import tikernels
from tikernels import runtime
from tikernels.phase.camera_blur import undo_camera_blur
from tikernels.phase.wrapped_phase import NO_PHASE

SHAPE, PERIOD_PX, FINE = (96, 120), 12.0, 8
INSIDE = (slice(6, -6), slice(6, -6))


def photograph(tilt: float, paint: float = 0.4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blur a painted plane by a lens of half a pixel and the pixel's area; return phase, brightness and true phase.

    Spots of paint send back this share of what the rest does.
    """
    y, x = (np.mgrid[: SHAPE[0] * FINE, : SHAPE[1] * FINE] + 0.5) / FINE - 0.5
    phase = 2 * np.pi * y / PERIOD_PX + tilt * x
    spots = np.hypot((y + 4) % 21 - 10, (x + 3) % 17 - 8) < 5
    light = np.where(spots, paint, 1.0)[..., None] * np.stack([np.ones(y.shape), np.cos(phase), np.sin(phase)], axis=-1)
    seen = cv2.resize(cv2.GaussianBlur(light, (0, 0), 0.5 * FINE), SHAPE[::-1], interpolation=cv2.INTER_AREA)
    true = 2 * np.pi * np.arange(SHAPE[0])[:, None] / PERIOD_PX + tilt * np.arange(SHAPE[1])
    return np.arctan2(seen[..., 2], seen[..., 1]).astype(np.float32), seen[..., 0].astype(np.float32), true


def undone(phase: np.ndarray, brightness: np.ndarray, misfit: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the phase turned back, and the misfit; of phases that are known to 0.01 rad."""
    out = (np.empty(SHAPE, np.float32), np.full(SHAPE, misfit, np.float32))
    undo_camera_blur(phase, brightness, np.full(SHAPE, 1e4, np.float32), out)
    return runtime.to_host(out[0]), runtime.to_host(out[1])


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_what_blur_turned_is_turned_back(arch, tilt):
    """0.06 rad at the worst; a third of it is left by the second order of it, and what is left is covered."""
    phase, brightness, true = photograph(tilt)
    found, misfit = undone(phase, brightness)
    before, after = (reference.wrapped_difference(values, true)[INSIDE] for values in (phase, found))
    assert before.std() > 0.01
    assert after.std() < 0.35 * before.std()
    assert (misfit[INSIDE] > 2).any()
    assert np.mean(np.abs(after) < 0.02 * np.sqrt(misfit[INSIDE])) > 0.98


def test_even_paint_and_steps_are_left_alone(arch):
    phase, _, true = photograph(0.0, paint=1.0)
    even, misfit = undone(phase, np.full(SHAPE, 50, np.float32))
    np.testing.assert_array_equal(even, phase)
    assert (misfit == 1).all()
    stepped = reference.wrapped(true + 2.0 * (np.arange(SHAPE[0]) >= 40)[:, None])
    brightness = np.where(np.arange(SHAPE[0]) < 40, 50, 10).astype(np.float32)[:, None].repeat(SHAPE[1], axis=1)
    found, _ = undone(stepped, brightness)
    np.testing.assert_array_equal(found[39:41], stepped[39:41])


def test_without_a_phase_nothing_changes(arch):
    phase, brightness, _ = photograph(0.1)
    phase[20:30, 40:60] = NO_PHASE
    found, _ = undone(phase, brightness)
    assert (found[20:30, 40:60] == NO_PHASE).all()


def test_what_blur_is_unsure_of_is_no_more_than_three_standard_deviations(arch):
    """Beyond, the fit itself has said so: it divides the precision by a larger misfit of its own."""
    phase, brightness, _ = photograph(0.2, paint=0.1)
    assert undone(phase, brightness)[1].max() == 9
    assert (undone(phase, brightness, misfit=30.0)[1] == 30).all()


def test_other_shapes_are_refused(arch):
    phase, brightness, _ = photograph(0.0)
    precision, out = np.ones(SHAPE, np.float32), (np.empty(SHAPE, np.float32), np.ones(SHAPE, np.float32))
    with pytest.raises(tikernels.ShapeError, match="brightness has shape"):
        undo_camera_blur(phase, brightness[1:], precision, out)
    with pytest.raises(tikernels.ShapeError, match="precision has shape"):
        undo_camera_blur(phase, brightness, precision[1:], out)
    with pytest.raises(tikernels.ShapeError, match="misfit has shape"):
        undo_camera_blur(phase, brightness, precision, (out[0], out[1][1:]))
