"""Grey levels to linear light."""

import numpy as np
import pytest
import reference

import tikernels
from tikernels.raw.linearization import TRANSFERS

WHITE = {"uint8": 255, "uint16": 65535, "float32": 1}


@pytest.mark.parametrize("transfer", TRANSFERS)
@pytest.mark.parametrize("dtype", WHITE)
def test_as_the_twin(arch, transfer, dtype):
    levels = (np.random.default_rng(1).random((7, 13, 3)) * WHITE[dtype]).astype(dtype)
    light = tikernels.linearize(levels, transfer)
    # A hundredth of a grey level of an 8-bit camera.
    np.testing.assert_allclose(light, reference.linearize(levels, transfer, WHITE[dtype]), atol=4e-5)


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_black_and_white_stay(arch, transfer):
    ends = np.zeros((1, 2, 3), np.float32)
    ends[0, 1] = 1
    np.testing.assert_allclose(tikernels.linearize(ends, transfer), ends, atol=1e-6)


def test_srgb_there_and_back(arch):
    """Each 8-bit level comes back as itself: the error is far below half a level."""
    levels = np.arange(256, dtype=np.uint8).repeat(3).reshape(1, 256, 3)
    light = tikernels.linearize(levels, "srgb").astype(np.float64)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(255 * encoded, levels, atol=0.02)


def test_the_white_level_is_full_scale(arch):
    twelve_bits = np.full((2, 3, 3), 4095, np.uint16)
    np.testing.assert_allclose(tikernels.linearize(twelve_bits, "linear", 4095), 1, atol=1e-6)


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_missing_values_stay_missing(arch, transfer):
    levels = np.full((2, 3, 3), 0.5, np.float32)
    levels[1, 1] = np.nan
    light = tikernels.linearize(levels, transfer)
    np.testing.assert_array_equal(np.isnan(light), np.isnan(levels))


def test_menu(menu):
    levels = np.random.default_rng(2).random((5, 7, 3), np.float32)
    menu(lambda image, out=None: tikernels.linearize(image, "srgb", out=out), np.empty_like(levels), image=levels)


def test_unknown_transfer(arch):
    with pytest.raises(tikernels.ShapeError, match=r"transfer is 'gamma': choose linear, srgb, bt709"):
        tikernels.linearize(np.zeros((2, 2, 3), np.uint8), "gamma")
