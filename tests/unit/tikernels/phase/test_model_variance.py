"""What the channels' model is wrong by: as NumPy computes it, and in places where it is known."""

import numpy as np
import pytest

from tikernels import runtime
from tikernels.phase.model_variance import _window_error, model_variance

PERIOD_PX, PRECISION = 12.0, 2500.0


def case(shape: tuple[int, int], seed: int = 1) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "precision": (1e3 + 4e3 * rng.random(shape)).astype(np.float32),
        "misfit": (4 * rng.standard_normal(shape) ** 2).astype(np.float32),
        "mask": (rng.random(shape) > 0.2).astype(np.uint8),
    }


def found(inputs: dict[str, np.ndarray]) -> np.ndarray:
    return runtime.to_host(model_variance(**inputs, period_px=PERIOD_PX))


def box_sums(values: np.ndarray) -> np.ndarray:
    """Return the sums over 5x5 pixels, in float64."""
    framed = np.pad(values.astype(np.float64), 2)
    height, width = values.shape
    return sum(framed[y : y + height, x : x + width] for y in range(5) for x in range(5))


@pytest.mark.parametrize("shape", [(41, 67), (40, 64), (7, 16), (1, 5)])
def test_misfits_of_a_few_pixels_as_the_twin(arch, shape):
    """Rows of whole vectors and others; what the window adds is taken off."""
    inputs = case(shape)
    sure = np.maximum(inputs["misfit"] / 9.0, 1) * inputs["precision"]
    misfit = np.minimum(inputs["misfit"], 9)
    inside = inputs["mask"].astype(np.float64)
    share = np.maximum(box_sums(inside) / 25, 1e-4)
    mean = box_sums(misfit * inside) / 25 / share
    beyond = np.where(mean > 1 + 2 * np.sqrt(2 / 25 / share), mean - 1, 0)
    expected = beyond / sure
    window = _window_error(*inputs.values(), PERIOD_PX)
    # A mean within rounding of the threshold may count or not.
    clear = np.abs(mean - 1 - 2 * np.sqrt(2 / 25 / share)) > 1e-4
    np.testing.assert_allclose((found(inputs) - window)[clear], expected[clear], rtol=1e-4, atol=1e-8)


def test_a_model_that_is_right_adds_nothing(arch):
    shape = (96, 128)
    ones = np.ones(shape, np.float32)
    assert (found({"precision": PRECISION * ones, "misfit": ones, "mask": ones.astype(np.uint8)}) == 0).all()


def test_one_that_is_wrong_all_over_is_so_in_both_sums(arch):
    """Misfits of three: two variances too many, over a few pixels and over the window."""
    ones = np.ones((96, 128), np.float32)
    variance = found({"precision": PRECISION * ones, "misfit": 3 * ones, "mask": ones.astype(np.uint8)})
    np.testing.assert_allclose(variance[8:-8, 8:-8], 4 / PRECISION, rtol=1e-3)


def test_the_window_averages_over_what_is_on_the_mask(arch):
    """The part of a surface that fits badly does not show beyond the window, some two cycles along the stripes."""
    shape = (96, 192)
    misfit = np.ones(shape, np.float32)
    misfit[:, 96:] = 2.0
    mask = np.ones(shape, np.uint8)
    mask[40:60, 120:140] = 0
    error = _window_error(np.full(shape, PRECISION, np.float32), misfit, mask, PERIOD_PX)
    np.testing.assert_allclose(error[:, :20], 0, atol=0.02 / PRECISION)
    np.testing.assert_allclose(error[:, -20:], 1 / PRECISION, rtol=0.02)


def test_menu(menu):
    shape = (41, 67)

    def measure(out=None, **inputs):
        result = model_variance(**inputs, period_px=PERIOD_PX, out=out)
        return runtime.to_host(result) if out is None else result

    menu(measure, np.empty(shape, np.float32), **case(shape))
