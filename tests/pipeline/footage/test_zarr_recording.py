"""Recordings in Zarr, read again: what is damaged, missing, or not such a recording."""

import shutil

import numpy as np
import pytest
import zarr
from support.numbered_frames import record

from pipeline.errors import FootageError
from pipeline.footage.opening import open_source
from pipeline.footage.source import BadFrame


def test_one_wrong_bit_is_found_in_zarr(tmp_path):
    record(tmp_path / "a.zarr")
    chunk = tmp_path / "a.zarr" / "frames" / "c.5.0.0.0"
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 4
    chunk.write_bytes(data)
    (tmp_path / "a.zarr" / "frames" / "c.7.0.0.0").unlink()
    frames = list(open_source(tmp_path / "a.zarr").frames())
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
            open_source(tmp_path / name)


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
            open_source(path)


def test_an_older_zarr_is_no_recording(tmp_path):
    """Its arrays may name codecs that unpickle."""
    record(tmp_path / "a.zarr")
    about = zarr.open_group(tmp_path / "a.zarr").attrs.asdict()
    group = zarr.open_group(tmp_path / "old.zarr", mode="w", zarr_format=2, attributes=about)
    group.create_array("frames", shape=(9, 22, 34, 3), chunks=(1, 22, 34, 3), dtype="u1")
    with pytest.raises(FootageError, match=r"old\.zarr is not a recording"):
        open_source(tmp_path / "old.zarr")


def test_a_recording_may_be_copied(tmp_path):
    frames = record(tmp_path / "a.zarr")
    shutil.move(tmp_path / "a.zarr", tmp_path / "renamed folder")
    (frame,) = open_source(tmp_path / "renamed folder").frames(3, 4)
    np.testing.assert_array_equal(frame.planes[0], frames[3])
