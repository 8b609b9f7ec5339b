"""Chunks behind an array's end, which a commit moves."""

from fractions import Fraction

import numpy as np
import pytest
import zarr
from support.numbered_frames import RGB8, frame_of

from pipeline.footage.recording_tags import RecordingTags
from pipeline.recording.zarr_writer import ZarrWriter

TAGS = RecordingTags(Fraction(30), "srgb", None, 8)


@pytest.fixture
def writer(tmp_path):
    return ZarrWriter(tmp_path / "a.zarr", (34, 22), RGB8, TAGS)


def keys(path):
    return sorted(entry.name for entry in (path / "frames").glob("c.*"))


def test_what_was_not_committed_is_not_there(writer, tmp_path):
    for number in range(3):
        writer.write(number, frame_of(number))
    writer.commit(2)
    frames = zarr.open_group(tmp_path / "a.zarr", mode="r")["frames"]
    assert frames.shape == (2, 22, 34, 3)
    for number in range(2):
        np.testing.assert_array_equal(frames[number], frame_of(number))
    assert len(keys(tmp_path / "a.zarr")) == 3
    writer.close()
    writer.close()
    assert keys(tmp_path / "a.zarr") == ["c.0.0.0.0", "c.1.0.0.0"]


def test_it_says_how_many_bytes_a_frame_took(writer, tmp_path):
    n_bytes = writer.write(0, np.zeros((22, 34, 3), np.uint8))
    assert (tmp_path / "a.zarr" / "frames" / "c.0.0.0.0").stat().st_size == n_bytes > 4  # of a black frame, too
    with pytest.raises(FileExistsError):
        writer.write(0, frame_of(0))


def test_what_the_group_says_of_its_frames(writer, tmp_path):
    about = zarr.open_group(tmp_path / "a.zarr", mode="r").attrs["colorphase_recording"]
    assert about == {
        "version": "1", "layout": "rgb", "bits": 8, "bayer": None, "transfer": "srgb", "rate_hz": "30"
    }  # fmt: skip


def test_a_recording_is_never_overwritten(writer, tmp_path):
    with pytest.raises(FileExistsError):
        ZarrWriter(tmp_path / "a.zarr", (34, 22), RGB8, TAGS)
