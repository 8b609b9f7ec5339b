"""What is wrong with a JPEG file is told, and does not spoil the next one."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.errors import FootageError
from pipeline.footage.jpeg_decoder import JpegDecoder
from pipeline.limits import MAX_PIXELS

DATA = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))[1].tobytes()


def test_a_damaged_picture_is_told_and_the_next_one_is_whole():
    decoder = JpegDecoder()
    first = decoder.decode(DATA).to_ndarray()
    with pytest.raises(FootageError, match=r"^it is damaged \("):
        decoder.decode(DATA[:1500] + bytes(300) + DATA[1800:])
    with pytest.raises(FootageError, match="does not say how large it is"):
        decoder.decode(DATA[:20])
    np.testing.assert_array_equal(decoder.decode(DATA).to_ndarray(), first)


def test_larger_pictures_than_cameras_take_are_refused(monkeypatch):
    monkeypatch.setenv(MAX_PIXELS, "3000")
    with pytest.raises(FootageError, match=r"^it has 64x48 px, and 3000 pixels are read at most: set COLORPHASE_MAX"):
        JpegDecoder().decode(DATA)


def test_the_colours_of_a_printer_are_named():
    file = io.BytesIO()
    Image.fromarray(np.full((48, 64, 3), 90, np.uint8)).convert("CMYK").save(file, "JPEG")
    with pytest.raises(FootageError, match="it is in CMYK, the colours of a printer: save it in RGB"):
        JpegDecoder().decode(file.getvalue())
