"""What of a brightness follows the fringe: found where it was put, and not where there is only a picture."""

import cv2
import numpy as np
import pytest
import reference

from tikernels.phase.brightness_ripple import RIPPLE_TERMS, contrast_slope, measure_ripple

PERIOD_PX, SHAPE = 12.0, (120, 160)
RIPPLE = np.array([0.01, -0.02, 0.005, 0.01, 0.03, -0.01])


def fringe(shape=SHAPE):
    """Return a phase that rises by a cycle every 12 px, the stripes a little tilted."""
    y, x = np.indices(shape)
    return (2 * np.pi * (y / PERIOD_PX + 0.003 * x) - 40).astype(np.float32)


def shading(shape=SHAPE):
    """Return a brightness that changes slowly, with noise of a per cent, levels."""
    y, x = np.indices(shape)
    noise = np.random.default_rng(1).standard_normal(shape)
    return 90 * np.exp(0.3 * np.sin(x / 40) + 0.004 * y + 0.01 * noise)


def case(shape=SHAPE, ripple=RIPPLE):
    light = shading(shape) * np.exp(reference.ripple(ripple, fringe(shape)))
    mask = (np.random.default_rng(2).random(shape) > 0.02).astype(np.uint8)
    return {"brightness": light.astype(np.float32), "phase": fringe(shape), "mask": mask}


@pytest.mark.parametrize("shape", [SHAPE, (41, 67), (8, 16)])
def test_as_the_twin(arch, shape):
    inputs = case(shape)
    found = measure_ripple(**inputs, period_px=PERIOD_PX)
    np.testing.assert_allclose(found, reference.measure_ripple(**inputs, period_px=PERIOD_PX), atol=2e-5)


def test_a_ripple_is_found_to_a_tenth_of_it(arch):
    """Of 4,000 samples with noise of a per cent: 0.001 by that, and what the prior takes."""
    np.testing.assert_allclose(measure_ripple(**case(), period_px=PERIOD_PX), RIPPLE, atol=0.001, rtol=0.1)


def test_print_is_no_ripple(arch):
    """Letters that are a third as bright as their paper."""
    paper = np.full(SHAPE, 200, np.uint8)
    for row in range(20, SHAPE[0], 25):
        cv2.putText(paper, "phase 0123", (2, row), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 70, 2)
    everywhere = np.ones(SHAPE, np.uint8)
    found = measure_ripple((shading() * paper / 200).astype(np.float32), fringe(), everywhere, PERIOD_PX)
    assert np.abs(found).max() < 0.012  # of a contrast of three


def test_nothing_tells_nothing(arch):
    inputs = case()
    inputs["mask"][:] = 0
    assert (measure_ripple(**inputs, period_px=PERIOD_PX) == 0).all()
    assert contrast_slope(inputs["brightness"], inputs["phase"], inputs["mask"], PERIOD_PX) == (0, 0)
    low = {name: array[:5] for name, array in case().items()}
    assert measure_ripple(**low, period_px=PERIOD_PX).shape == (RIPPLE_TERMS,)


@pytest.mark.parametrize("slope", [-0.4, 0.0, 1.5])
def test_what_follows_the_contrast_of_a_code(arch, slope):
    """Levels a sixth apart, from the middle of one cycle to that of the next."""
    levels = np.log([0.72, 1.0, 0.86, 0.72, 1.0, 1.0, 0.86, 0.72, 0.86, 1.0, 0.72, 1.0])
    cycles = np.arange(SHAPE[0]) / PERIOD_PX
    contrast = np.repeat(np.interp(cycles, np.arange(len(levels)), levels)[:, None], SHAPE[1], axis=1)
    light = shading() * np.exp(slope * contrast)
    everywhere = np.ones(SHAPE, np.uint8)
    seen = (light.astype(np.float32), contrast.astype(np.float32), everywhere)
    found, mean = contrast_slope(*seen, PERIOD_PX)
    assert found == pytest.approx(slope, abs=0.1)
    np.testing.assert_allclose((found, mean), reference.contrast_slope(*seen, PERIOD_PX), rtol=1e-3, atol=1e-4)


def test_menu(menu):
    menu(lambda **inputs: measure_ripple(**inputs, period_px=PERIOD_PX), **case((41, 67)))
    inputs = {"brightness": case((41, 67))["brightness"], "contrast": fringe((41, 67)), "mask": case((41, 67))["mask"]}
    menu(lambda **given: np.array(contrast_slope(**given, period_px=PERIOD_PX)), **inputs)
