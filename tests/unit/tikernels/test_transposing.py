"""Rows for columns."""

import numpy as np
import pytest
from support.array_forms import every_second, on_device, read_only

from tikernels import ShapeError, runtime
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


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3)])
def test_arrays_in_every_form(arch, shape):
    image = np.random.default_rng(4).random(shape, np.float32)
    for form in (every_second, read_only, on_device):
        np.testing.assert_array_equal(runtime.to_host(transpose(form(image))), np.swapaxes(image, 0, 1))


def test_what_is_refused(arch):
    image = np.zeros((5, 7), np.float32)
    for bad in (image.tolist(), image.astype(np.complex64), np.zeros((5, 7, 2), np.float32), np.zeros((1, 5, 7, 3))):
        with pytest.raises(ShapeError, match=r"image (is|has)"):
            transpose(bad)
    for bad in (np.empty((5, 7), np.float32), np.empty((7, 5), np.uint8), read_only(image.T.copy())):
        with pytest.raises(ShapeError, match=r"out (is|has)"):
            transpose(image, bad)
