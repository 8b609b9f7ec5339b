"""Projector coordinates from captures of many pictures, and captures that cannot be decoded."""

import numpy as np
import pytest
from support.posed_boards import CAMERA_PX, PROJECTOR_PX, SEQUENCE

from pipeline.calibration.multishot import BLACK, WHITE, decode_multishot
from pipeline.errors import CalibrationError


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
