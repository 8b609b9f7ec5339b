"""The binary message of a frame, and the maps that a page offers."""

import json

import numpy as np
import pytest

from pipeline.errors import SettingsError
from pipeline.view.message import ViewedFrame, describe_maps, maps_of
from pipeline.view.subjects import as_bytes


def unpacked(message):
    length = int.from_bytes(message[:4], "little")
    head = json.loads(message[4 : 4 + length])
    arrays = {}
    for name, place in head["arrays"].items():
        start = 4 + length + place["offset"]
        assert start % 8 == 0
        count = int(np.prod(place["shape"]))
        arrays[name] = np.frombuffer(message, place["type"], count, start).reshape(place["shape"])
    return head, arrays


def test_arrays_and_texts_arrive_as_they_were():
    random = np.random.default_rng(0)
    values = {
        "points": random.normal(size=(5, 7, 3)).astype(np.float32),
        "mask": random.random((5, 7)) < 0.5,
        "order": random.integers(-9, 9, (5, 7), np.int32),
        "texture": random.integers(0, 255, (5, 7, 3), np.uint8),
    }
    values["points"][0, 0] = np.nan
    frame = ViewedFrame(values, 3, 0.5, False, ("Müller's </script>",), {"status": "fine"})
    for step in (1, 2, 10):
        head, arrays = unpacked(frame.pack(step))
        assert arrays.keys() == values.keys()
        for name, array in arrays.items():
            np.testing.assert_array_equal(array, values[name][::step, ::step])
        assert (head["height"], head["width"], head["step"]) == (*arrays["mask"].shape, step)
        assert head["warnings"] == ["Müller's </script>"]
        assert (head["number"], head["time_s"], head["status"]) == (3, 0.5, "fine")


def test_a_mesh_is_kept_whole():
    frame = ViewedFrame({"points": np.eye(3, dtype=np.float32), "faces": np.array([[0, 1, 2]], np.uint32)})
    head, arrays = unpacked(frame.pack(5))
    assert arrays["points"].shape == (3, 3)
    assert arrays["faces"].dtype == np.uint32
    assert head["width"] == 0


def test_a_frame_without_any_of_the_maps_is_a_message_too():
    head, arrays = unpacked(ViewedFrame({}, 1).pack())
    assert arrays == {} and head["width"] == 0


def test_a_step_below_one_is_refused():
    with pytest.raises(SettingsError, match="step is 0: give 1 or more"):
        ViewedFrame({}).pack(0)


def test_maps_are_those_that_are_stored():
    stored = ("mask", "points", "phase_sigma")
    assert maps_of(stored, in_mm=True) == {"depth": "points", "sigma": "phase_sigma", "mask": "mask"}
    assert maps_of((*stored, "point_sigma"), in_mm=True)["sigma"] == "point_sigma"
    assert "depth" not in maps_of(stored, in_mm=False)
    units = {name: about["unit"] for name, about in describe_maps(("range_image", "texture"), in_mm=False).items()}
    assert units == {"depth": "rad", "texture": ""}
    assert describe_maps(("texture",), in_mm=True)["texture"]["kind"] == "color"


def test_pictures_have_eight_bits_and_clipped_pixels_stay_white():
    assert as_bytes(np.array([0, 7, 255], np.uint8), linear=False).tolist() == [0, 7, 255]
    assert as_bytes(np.array([0, 4095, 65535], np.uint16), linear=False).tolist() == [0, 16, 255]
    assert as_bytes(np.array([0, 0.5, 2], np.float32), linear=False).tolist() == [0, 128, 255]
    half = round(255 * 0.5 ** (1 / 2.2))
    assert as_bytes(np.array([0, 0.5, 1], np.float32), linear=True).tolist() == [0, half, 255]
    assert abs(int(as_bytes(np.array([128], np.uint8), linear=True)[0]) - half) <= 1
