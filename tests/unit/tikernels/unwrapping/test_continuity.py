"""What two pixels say of each other, against the equations."""

import numpy as np
import pytest

from tikernels._taichi import F32Array1, F32Array2, I32Array2, ti
from tikernels.phase.smoothing import MAX_DEPARTURE
from tikernels.unwrapping.continuity import (
    cycles_and_departure,
    surely_across,
    surely_along,
    vote_weight,
)


@ti.kernel
def judge_kernel(
    difference: F32Array1,  # rad
    quality: F32Array2,  # (2, N)
    rate: ti.f32,
    mean_quality: ti.f32,
    out_departs: F32Array1,
    out_words: I32Array2,  # (4, N) cycles, sure along, sure across, weight
):
    for i in range(difference.shape[0]):
        cycles, departs = cycles_and_departure(difference[i], rate)
        out_departs[i] = departs
        out_words[0, i] = cycles
        out_words[1, i] = ti.cast(surely_along(departs, quality[0, i], quality[1, i]), ti.i32)
        out_words[2, i] = ti.cast(surely_across(departs, quality[0, i], quality[1, i]), ti.i32)
        out_words[3, i] = vote_weight(departs, quality[0, i], quality[1, i], mean_quality)


def judged(difference, quality, rate=0.0, mean_quality=1.0):
    count = len(difference)
    departs, words = np.zeros(count, np.float32), np.zeros((4, count), np.int32)
    arrays = (np.asarray(difference, np.float32), np.asarray(quality, np.float32))
    judge_kernel(*arrays, rate, mean_quality, departs, words)
    return departs, words


@pytest.mark.parametrize("rate", [0.0, 0.52, -0.9])
def test_cycles_bring_a_difference_nearest_to_the_rate(arch, rate):
    true = rate + np.linspace(-3.1, 3.1, 63)
    wrapped = true - 2 * np.pi * np.rint(true / (2 * np.pi))
    departs, words = judged(wrapped, np.ones((2, 63)), rate)
    np.testing.assert_array_equal(words[0], np.rint((true - wrapped) / (2 * np.pi)))
    np.testing.assert_allclose(departs, np.abs(true - rate), atol=1e-5)  # float32 of a cycle


def test_a_pixel_is_sure_of_what_departs_little_and_is_as_bright(arch):
    """0.25 rad and three quarters of the modulation along the stripe, 0.5 rad and half of it across."""
    difference = [0.2, 0.3, 0.45, 0.55, 0.0, 0.0, 0.0]
    quality = np.array([[1, 1, 1, 1, 1, 1, 1], [1, 1, 1, 1, 0.8, 0.6, 0.4]])
    _, words = judged(difference, quality)
    np.testing.assert_array_equal(words[1], [1, 0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(words[2], [1, 1, 1, 0, 1, 1, 0])
    _, words = judged(np.zeros(2), np.array([[np.nan, 0], [np.nan, 0]]))
    np.testing.assert_array_equal(words[1:3], [[1, 1], [0, 0]])  # along, the phase alone will do


def test_votes_weigh_by_the_equation(arch):
    """1 + 63 (1 - d / 0.8)^2 (low / high)^2 min(4 low / mean, 1), cut to an integer."""
    rng = np.random.default_rng(1)
    difference, quality = rng.uniform(-MAX_DEPARTURE, MAX_DEPARTURE, 200), rng.uniform(0.01, 2, (2, 200))
    _, words = judged(difference, quality, mean_quality=1.3)
    low, high = quality.min(axis=0), quality.max(axis=0)
    going_on = 1 - np.abs(difference) / MAX_DEPARTURE
    expected = 1 + 63 * going_on**2 * (low / high) ** 2 * np.minimum(4 * low / 1.3, 1)
    # Float32 may fall to the other side of an integer.
    assert (np.abs(words[3] - (expected - 0.5)) < 0.501).all()
