"""The size that a picture's head says is the one that it is decoded to."""

import struct

import cv2
import numpy as np
import pytest

from pipeline.footage.picture_size import picture_size

WIDTH, HEIGHT = 300, 70


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [
        *((suffix, np.uint8) for suffix in (".png", ".jpg", ".tif", ".bmp", ".ppm", ".pgm", ".webp")),
        *((suffix, np.uint16) for suffix in (".png", ".tif", ".ppm")),
        (".tif", np.float32),
    ],
)
def test_heads_say_what_is_decoded(suffix, dtype):
    levels = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH) if suffix == ".pgm" else (HEIGHT, WIDTH, 3))
    data = cv2.imencode(suffix, levels.astype(dtype))[1].tobytes()
    assert picture_size(data) == (WIDTH, HEIGHT)


@pytest.mark.parametrize("quality", [80, 101])
def test_webp_of_both_kinds(quality):
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
    assert picture_size(data) == (WIDTH, HEIGHT)
    extended = b"RIFF\0\0\0\0WEBPVP8X" + struct.pack("<IBxxxHBHB", 10, 0, WIDTH - 1, 0, HEIGHT - 1, 0)
    assert picture_size(extended) == (WIDTH, HEIGHT)


def test_progressive_jpeg_and_what_stands_before_its_frame():
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    filled = data[:2] + b"\xff\xfe\x00\x06note\xff\xff" + data[3:]  # a comment, and a byte that fills up
    assert picture_size(data) == picture_size(filled) == (WIDTH, HEIGHT)


@pytest.mark.parametrize("order", ["<", ">"])
def test_tiff_of_both_byte_orders_and_sizes(order):
    mark = b"II" if order == "<" else b"MM"
    entries = struct.pack(order + "HHIHxxHHII", 256, 3, 1, WIDTH, 257, 4, 1, HEIGHT)
    assert picture_size(mark + struct.pack(order + "HIH", 42, 8, 2) + entries) == (WIDTH, HEIGHT)
    entries = struct.pack(order + "HHQQHHQQ", 256, 16, 1, WIDTH, 257, 16, 1, HEIGHT)
    assert picture_size(mark + struct.pack(order + "HHHQQ", 43, 8, 0, 16, 2) + entries) == (WIDTH, HEIGHT)


def test_bmp_of_os_2_and_from_top_to_bottom():
    head = b"BM" + bytes(12)
    assert picture_size(head + struct.pack("<IHH", 12, WIDTH, HEIGHT)) == (WIDTH, HEIGHT)
    assert picture_size(head + struct.pack("<Iii", 40, WIDTH, -HEIGHT)) == (WIDTH, HEIGHT)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".ppm", ".webp"])
def test_heads_that_are_cut_off(suffix):
    data = cv2.imencode(suffix, np.zeros((HEIGHT, WIDTH, 3), np.uint8))[1].tobytes()
    for length in range(min(len(data), 200)):
        assert picture_size(data[:length]) in (None, (WIDTH, HEIGHT))
    assert picture_size(b"no picture") is None
