"""Recordings in Zarr, read again: what is damaged, missing, or not such a recording."""

import json
import shutil
from fractions import Fraction

import numpy as np
import pytest
import zarr
from support.numbered_frames import record

from pipeline.errors import FootageError
from pipeline.footage.footage import BadFrame
from pipeline.footage.opening import open_footage
from pipeline.footage.zarr_recording import RecordingTags, rate_of
from tikernels import ShapeError


def test_one_wrong_bit_is_found_in_zarr(tmp_path):
    record(tmp_path / "a.zarr")
    chunk = tmp_path / "a.zarr" / "frames" / "c.5.0.0.0"
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 4
    chunk.write_bytes(data)
    (tmp_path / "a.zarr" / "frames" / "c.7.0.0.0").unlink()
    frames = list(open_footage(tmp_path / "a.zarr").frames())
    reasons = {frame.number: frame.reason for frame in frames if isinstance(frame, BadFrame)}
    assert list(reasons) == [5, 7]
    assert "damaged" in reasons[5]
    assert "missing" in reasons[7]


def test_what_is_no_recording(tmp_path):
    zarr.open_group(tmp_path / "other.zarr", mode="w")
    (tmp_path / "empty.zarr").mkdir()
    zarr.create_array(tmp_path / "array.zarr", shape=(3, 3), dtype="u1")
    for name in ("other.zarr", "empty.zarr", "array.zarr"):
        with pytest.raises(FootageError, match=rf"{name} is not a recording of frames"):
            open_footage(tmp_path / name)


def test_frames_of_another_shape(tmp_path):
    for name, shape in (("line", (3,)), ("none", None)):
        path = tmp_path / f"{name}.zarr"
        record(path)
        group = zarr.open_group(path)
        del group["frames"]
        if shape is None:
            group.create_group("frames")
        else:
            group.create_array("frames", shape=shape, dtype="u1")
        with pytest.raises(FootageError, match=rf"{name}\.zarr is damaged"):
            open_footage(path)


def claimed(path, **claims):
    """Record frames, and let the head of their array say something else."""
    record(path)
    head = path / "frames" / "zarr.json"
    head.write_text(json.dumps({**json.loads(head.read_text()), **claims}))
    return path


@pytest.mark.parametrize(
    ("claims", "message"),
    [
        ({"shape": [10**12, 22, 34, 3]}, "says that it holds 1000000000000 frames, but 9 are there: copy it again"),
        ({"shape": [9, 10**6, 10**6, 3]}, "has 1000000x1000000 px, and 67108864 pixels are read at most"),
        ({"shape": [9, 0, 34, 3]}, "says that it has 34x0 px"),
        ({"note": "x" * 2**20}, "is not a recording of frames"),
    ],
)
def test_heads_that_claim_more_than_there_is(tmp_path, claims, message):
    with pytest.raises(FootageError, match=message):
        open_footage(claimed(tmp_path / "a.zarr", **claims))


def test_a_head_nested_without_an_end(tmp_path):
    record(tmp_path / "a.zarr")
    for head in (tmp_path / "a.zarr" / "frames" / "zarr.json", tmp_path / "a.zarr" / "zarr.json"):
        head.write_text("[" * 100_000)
        with pytest.raises(FootageError, match="is not a recording of frames"):
            open_footage(tmp_path / "a.zarr")


@pytest.mark.parametrize("bits", [float("inf"), 10**400, "many", [8], None])
def test_bits_that_are_none(tmp_path, bits):
    record(tmp_path / "a.zarr")
    head = tmp_path / "a.zarr" / "zarr.json"
    about = json.loads(head.read_text())
    about["attributes"]["colorphase_recording"]["bits"] = bits
    head.write_text(json.dumps(about))
    with pytest.raises(FootageError, match=r"is damaged|is not a recording"):
        open_footage(tmp_path / "a.zarr")


def test_a_chunk_longer_than_a_frame_is_not_read(tmp_path):
    record(tmp_path / "a.zarr")
    with (tmp_path / "a.zarr" / "frames" / "c.2.0.0.0").open("ab") as file:
        file.truncate(2**40)
    (frame,) = open_footage(tmp_path / "a.zarr").frames(2, 3)
    assert frame == BadFrame(2, "it is damaged: it is larger than 2,308 bytes")


def test_an_older_zarr_is_no_recording(tmp_path):
    """Its arrays may name codecs that unpickle."""
    record(tmp_path / "a.zarr")
    about = zarr.open_group(tmp_path / "a.zarr").attrs.asdict()
    group = zarr.open_group(tmp_path / "old.zarr", mode="w", zarr_format=2, attributes=about)
    group.create_array("frames", shape=(9, 22, 34, 3), chunks=(1, 22, 34, 3), dtype="u1")
    with pytest.raises(FootageError, match=r"old\.zarr is not a recording"):
        open_footage(tmp_path / "old.zarr")


def test_a_part_of_the_sensor_that_is_none(tmp_path):
    record(tmp_path / "a.zarr")
    group = zarr.open_group(tmp_path / "a.zarr")
    said = {"sensor_px": [99, 80], "offset_px": [-1, 0], "binning": [1, 1]}
    group.attrs["colorphase_recording"] = group.attrs["colorphase_recording"] | {"sensor": said}
    with pytest.raises(FootageError, match=r"a\.zarr is damaged: sensor: offset_px\.0: must be .*, got -1"):
        open_footage(tmp_path / "a.zarr")


def test_a_recording_may_be_copied(tmp_path):
    frames = record(tmp_path / "a.zarr")
    shutil.move(tmp_path / "a.zarr", tmp_path / "renamed folder")
    (frame,) = open_footage(tmp_path / "renamed folder").frames(3, 4)
    np.testing.assert_array_equal(frame.planes[0], frames[3])


@pytest.mark.parametrize("text", ["1e999999999", "-1", "1/0", "0x10", "", "1/2/3"])
def test_a_rate_is_a_fraction_of_two_plain_numbers(text):
    with pytest.raises(ValueError, match="no fraction"):
        rate_of(text)


def test_rates_that_milliseconds_cannot_count():
    for rate_hz in (0, 501):
        with pytest.raises(ShapeError, match="give one above 0 and up to 500"):
            RecordingTags(Fraction(rate_hz), None, None, 8)
