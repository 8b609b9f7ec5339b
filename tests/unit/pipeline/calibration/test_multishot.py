"""Projector coordinates from captures of many pictures, and captures that cannot be decoded."""

import numpy as np
import pytest
from support.posed_boards import CAMERA_PX, PROJECTOR_PX, SEQUENCE

from pipeline.calibration.multishot import BLACK, WHITE, decode_multishot, multishot_codes, multishot_sequence
from pipeline.errors import CalibrationError


@pytest.mark.parametrize("gamma", [1.0, 2.0, 2.4])
@pytest.mark.parametrize("size_px", [(1024, 96), (1920, 80), (3840, 64)])
def test_a_camera_that_is_the_projector(size_px, gamma):
    """Every pixel's column and row are found to .05 px RMS in 8 bits, for any response, without knowing it."""
    names = multishot_sequence(size_px).names
    assert len(names) == 12
    codes = {name: np.rint(255 * multishot_codes(name, size_px)) / 255 for name in names}
    captures = {name: np.rint(5 + 240 * codes[name] ** gamma).astype(np.uint8) for name in names}
    found = decode_multishot(captures, size_px)
    true = np.stack(np.meshgrid(np.arange(size_px[0]), np.arange(size_px[1])), axis=-1)
    known = np.isfinite(found.position_px).all(axis=-1)
    assert known.mean() > 0.99
    assert np.abs(found.position_px - true)[known].max() < 0.15
    assert np.sqrt(np.mean((found.position_px - true)[known] ** 2)) < 0.05
    assert np.abs(found.channel_shift_px[:, known]).max() < 0.1


@pytest.mark.parametrize("gamma", [1.0, 2.5])
@pytest.mark.parametrize(("stray", "power"), [(0.1, 1.0), (0.05, 1 / 2.2)])
def test_stray_light_and_an_encoding_camera(gamma, stray, power):
    """A tenth of each picture's light spreads over all of it, or the camera encodes light: no cycle is mistaken."""
    size_px, captures = (1024, 96), {}
    for name in multishot_sequence(size_px).names:
        light = multishot_codes(name, size_px) ** gamma
        light = 0.02 + 0.9 * (light + stray * light.mean()) / (1 + stray)
        captures[name] = np.rint(255 * light**power).astype(np.uint8)
    found = decode_multishot(captures, size_px).position_px
    error = found - np.stack(np.meshgrid(np.arange(1024), np.arange(96)), axis=-1)
    known = np.isfinite(error).all(axis=-1)
    assert known.mean() > 0.99
    assert np.abs(error[known]).max() < 0.5


def test_captures_in_the_wrong_order(of_charuco):
    captures = dict(of_charuco)
    names = [name for name in SEQUENCE.names if "column-fringe" in name]
    digits = [name for name in SEQUENCE.names if "column-digit" in name]
    for a, b in ((WHITE, BLACK), (names[0], digits[1]), (names[0], names[2]), (BLACK, names[1]), digits):
        swapped = {**captures, a: captures[b], b: captures[a]}
        with pytest.raises(CalibrationError, match=r"order|contradict"):
            decode_multishot(swapped, PROJECTOR_PX)
    # Steps turned round in a circle are fringes, too, of another place: the digits contradict them.
    turned = {a: captures[b] for a, b in zip(names, names[1:] + names[:1], strict=True)}
    with pytest.raises(CalibrationError, match="contradict"):
        decode_multishot({**captures, **turned}, PROJECTOR_PX)


def test_a_projector_of_another_size(of_charuco):
    captures = dict(of_charuco)
    with pytest.raises(CalibrationError, match="800x600 is not the projector's size"):
        decode_multishot(captures, (800, 600))
    for larger in ((1280, 720), (1280, 768), (1280, 800), (1366, 768), (1280, 1024), (1400, 1050), (1920, 1080)):
        with pytest.raises(CalibrationError, match="is not the projector's size"):
            decode_multishot(captures, larger)
    with pytest.raises(CalibrationError, match=r"640x480 is .* but the camera's: camera and projector are swapped"):
        decode_multishot(captures, CAMERA_PX)


def test_sixteen_bit_files_of_a_twelve_bit_camera(of_charuco):
    captures = {name: 16 * picture.astype(np.uint16) for name, picture in of_charuco.items()}
    known = decode_multishot(captures, PROJECTOR_PX, white_level=4095)
    assert np.isfinite(known.position_px).all(axis=-1).mean() > 0.2
    captures[WHITE][:2] = 4095
    with pytest.raises(CalibrationError, match="end at 4095"):
        decode_multishot(captures, PROJECTOR_PX)
    with pytest.raises(CalibrationError, match="white_level is -1"):
        decode_multishot(captures, PROJECTOR_PX, white_level=-1)
