"""Marks of frames, and what they say of the frames' chunks."""

import shutil

import pytest
from support.stored_planes import store

from pipeline.errors import FootageError
from pipeline.output.store_files import OtherFrame, StoreFiles, identity_digest, marked_frames, read_mark
from pipeline.output.stored_result import StoredResult

pytestmark = pytest.mark.usefixtures("cpu")


@pytest.fixture
def path(tmp_path):
    return store(tmp_path / "result.zarr", [400.0, 401.0, 402.0])


def test_a_mark_says_how_its_frame_was_decoded(path):
    files = StoreFiles(path)
    assert marked_frames(files) == {0, 1, 2}
    attributes = StoredResult(path).attributes
    mark = read_mark(files, 1, identity_digest(attributes))
    assert (mark.period_px, mark.noise_levels, mark.constant_known, mark.warnings) == (12.0, 1.0, True, [])
    assert mark.chunks.keys() == set(attributes["fields"])
    with pytest.raises(OtherFrame, match="decoded otherwise than its store says"):
        read_mark(files, 1, identity_digest({**attributes, "step": 2}))


def test_what_the_footage_tells_again_is_no_part_of_how_a_frame_was_decoded():
    assert identity_digest({"step": 1, "light": None}) == identity_digest({"step": 1, "rims": {}})


def test_a_chunk_of_another_frame(path):
    (path / "mask" / "c.0.0.0").unlink()
    shutil.copy(path / "modulation" / "c.0.0.0", path / "mask" / "c.0.0.0")
    with pytest.raises(FootageError, match="frame 0: mask is another frame's, or of another run"):
        StoredResult(path).read("mask", 0)


def test_a_mark_of_another_frame(path):
    shutil.copy(path / "done" / "c.0.0", path / "done" / "c.9.0")
    with pytest.raises(FootageError, match="frame 9: mask is missing"):
        StoredResult(path).read("mask", 9)


def test_a_frame_that_is_not_done(path):
    with pytest.raises(FootageError, match="frame 7: it has no mark, and so is not whole"):
        StoredResult(path).read("mask", 7)


def test_faults_are_named_by_frame(path):
    (path / "points" / "c.1.0.0.0").unlink()
    (path / "mask" / "c.2.0.0").write_bytes(b"something else")
    result = StoredResult(path)
    assert [result.fault(number) is None for number in range(3)] == [True, False, False]
    assert result.fault(1) == "points is missing"
    assert result.fault(2).startswith("mask is damaged: ")
