"""Rows for columns."""

import numpy as np
import pytest

from tikernels import runtime
from tikernels.transposing import transpose


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int32", "float32"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (5, 9), (65, 33), (5, 9, 3), (1, 4, 3)])
def test_as_the_twin(arch, shape, dtype):
    image = np.random.default_rng(1).integers(0, 250, shape).astype(dtype)
    found = runtime.to_host(transpose(image))
    np.testing.assert_array_equal(found, np.swapaxes(image, 0, 1))
    assert found.dtype == image.dtype


def test_twice_is_nothing(arch):
    image = np.random.default_rng(2).random((17, 29), np.float32)
    np.testing.assert_array_equal(runtime.to_host(transpose(transpose(image))), image)


def test_into_a_buffer(arch):
    image = np.random.default_rng(3).random((6, 4), np.float32)
    out = np.empty((4, 6), np.float32)
    assert transpose(image, out) is out
    np.testing.assert_array_equal(out, image.T)


def test_missing_values_move_too(arch):
    image = np.full((3, 4), np.nan, np.float32)
    image[1, 2] = 1
    np.testing.assert_array_equal(runtime.to_host(transpose(image)), image.T)
