"""What every host function refuses, and how it takes arrays."""

import numpy as np
import pytest
from support.array_forms import every_second, on_device, read_only

from tikernels import ShapeError, checks, runtime

IMAGE = np.arange(12, dtype=np.float32).reshape(3, 4)


def test_an_array_in_order_is_itself(arch):
    assert checks.read_array("image", IMAGE, (3, None), np.float32) is IMAGE
    device = on_device(IMAGE)
    assert checks.read_array("image", device, (None, 4), np.uint8, np.float32) is device


def test_what_kernels_cannot_take_is_copied(arch):
    taken = checks.read_array("image", every_second(IMAGE), (3, 4), np.float32)
    assert taken.flags.c_contiguous
    np.testing.assert_array_equal(taken, IMAGE)
    # A launch on a GPU writes arguments back.
    assert arch == "cpu" or checks.read_array("image", read_only(IMAGE), (3, 4), np.float32).flags.writeable


@pytest.mark.parametrize("form", [np.array, on_device])
def test_messages_name_what_was_got_and_what_is_expected(arch, form):
    image = form(IMAGE)
    with pytest.raises(ShapeError, match=r"image has shape \(3, 4\), expected \(any, 5\)"):
        checks.read_array("image", image, (None, 5), np.float32)
    with pytest.raises(ShapeError, match=r"image has shape \(3, 4\), expected \(3, 4, 3\)"):
        checks.read_array("image", image, (3, 4, 3), np.float32)
    with pytest.raises(ShapeError, match=r"image is float32, expected uint8 or uint16: convert it with .astype\(\)"):
        checks.read_array("image", image, (3, 4), np.uint8, np.uint16)


def test_what_is_no_array(arch):
    with pytest.raises(ShapeError, match="image is a list: pass a NumPy array or a Taichi ndarray"):
        checks.read_array("image", IMAGE.tolist(), (3, 4), np.float32)
    with pytest.raises(ShapeError, match=r"image is empty: its shape is \(0, 4\)"):
        checks.read_array("image", IMAGE[:0], (None, 4), np.float32)


def test_the_other_order_of_bytes_is_another_type(arch):
    """Kernels would read it as garbage."""
    with pytest.raises(ShapeError, match="image is float32"):
        checks.read_array("image", IMAGE.astype(IMAGE.dtype.newbyteorder()), (3, 4), np.float32)


def test_a_mask_is_seen_as_bytes(arch):
    mask = IMAGE > 5
    np.testing.assert_array_equal(checks.read_mask("mask", mask, (3, 4)), mask.astype(np.uint8))
    with pytest.raises(ShapeError, match="mask is float32, expected uint8"):
        checks.read_mask("mask", IMAGE, (3, 4))


def test_outputs(arch):
    assert checks.out_array("out", None, (3, 4), np.float32).shape == (3, 4)
    assert checks.out_array("out", IMAGE, (3, 4), np.float32) is IMAGE
    assert isinstance(checks.out_array("out", None, (3, 4), np.float32), np.ndarray)
    assert isinstance(checks.out_buffer("out", None, (3, 4), np.float32), np.ndarray) == (arch == "cpu")
    for bad in (read_only(IMAGE), every_second(IMAGE)):
        with pytest.raises(ShapeError, match="out is read-only or not contiguous"):
            checks.out_buffer("out", bad, (3, 4), np.float32)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.float32])
def test_element_types(arch, dtype):
    values = np.ones((2, 3), dtype)
    for array in (values, on_device(values)):
        assert checks.element_type(array) is dtype
        assert runtime.dtype_name(array) == np.dtype(dtype).name
