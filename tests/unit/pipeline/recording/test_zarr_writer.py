"""Chunks behind an array's end, which a commit moves; and what a recorder leaves that was killed."""

import json
import shutil
from fractions import Fraction

import numpy as np
import pytest
import zarr
from support.numbered_frames import RGB8, add, frame_of, held

from pipeline.errors import FootageError, OutputError
from pipeline.footage.zarr_recording import RecordingTags
from pipeline.recording.recorder import Recorder
from pipeline.recording.zarr_writer import ZarrWriter, finish_recording, unfinished

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


@pytest.fixture
def left(tmp_path):
    """Return a recording that was left with five frames committed and two that were not."""
    (tmp_path / "now").mkdir()
    recorder = Recorder(tmp_path / "now" / "a.zarr", RGB8)
    add(recorder, 5)
    recorder.commit()
    add(recorder, 2)
    while recorder._threads.n_added > recorder._threads._n_done:
        pass
    folder = shutil.copytree(tmp_path / "now", tmp_path / "left")
    recorder.close()
    (part,) = unfinished(folder)
    return part


def test_what_was_committed_gets_its_name(left):
    path, n_frames = finish_recording(left)
    assert (path.name, n_frames, held(path)) == ("a.zarr", 5, 5)
    assert list(unfinished(left.parent)) == []
    assert [entry.name for entry in left.parent.iterdir()] == [path.name]


def test_a_new_recording_does_not_replace_it(left):
    with pytest.raises(OutputError, match=r"a\.part\.zarr is there, of a program that was killed: colorphase v"):
        Recorder(left.with_name("a.zarr"), RGB8)
    left.with_name("a.zarr").write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists, move it away"):
        finish_recording(left)
    assert left.with_name("a.zarr").read_bytes() == b"mine"


def test_what_is_damaged_stays(left):
    (left / "frames" / "zarr.json").write_bytes(b"nonsense")
    with pytest.raises(FootageError, match="cannot finish"):
        finish_recording(left)
    assert left.exists()


def test_what_was_only_begun_is_removed(tmp_path):
    """At every moment of its making."""
    with Recorder(tmp_path / "a.zarr", RGB8) as recorder:
        add(recorder, 1)
    part = tmp_path / "b.part.zarr"
    for left in ((), ("zarr.json",), ("zarr.json", "frames")):
        part.mkdir()
        for name in left:
            (part / name).mkdir() if name == "frames" else (part / name).write_bytes(b"{}")
        assert finish_recording(part) == (tmp_path / "b.zarr", 0)
        assert not part.exists()
    shutil.copytree(tmp_path / "a.zarr", part)
    (part / "frames" / "zarr.json").unlink()
    with pytest.raises(FootageError, match="does not say how many frames it holds"):
        finish_recording(part)


@pytest.mark.parametrize("said", [-1, True, 2.5, "3", None, [], 10**30])
def test_a_number_of_frames_that_is_none_removes_nothing(left, said):
    head = left / "frames" / "zarr.json"
    about = json.loads(head.read_text())
    about["shape"][0] = said
    head.write_text(json.dumps(about))
    before = sorted(left.rglob("*"))
    with pytest.raises(FootageError, match="does not say how many frames it holds"):
        finish_recording(left)
    assert sorted(left.rglob("*")) == before
