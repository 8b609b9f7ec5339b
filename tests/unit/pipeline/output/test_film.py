"""The parts of a film that an earlier run has left, and which frames a film shows."""

import os

import pytest
from support.stored_planes import store

from pipeline.errors import FootageError
from pipeline.output.film import _wanted, _whole
from pipeline.output.pictures.drawing_process import FilmPart, PartRecord
from pipeline.output.stored_result import StoredResult

pytestmark = pytest.mark.usefixtures("cpu")


@pytest.fixture
def part(tmp_path):
    part = FilmPart(first=0, stop=2, path=str(tmp_path / "part.mp4"))
    (tmp_path / "part.mp4").write_bytes(b"film")
    record = PartRecord(held=(1,), broken={}, codec="mpeg4", bytes=4)
    part.record_file.write_text(record.model_dump_json())
    assert part.record() == record
    return part


def test_a_part_that_is_whole_is_not_drawn_again(part):
    assert _whole(part)
    part.record_file.write_text(PartRecord(held=(1,), broken={1: "damaged"}, codec="mpeg4", bytes=4).model_dump_json())
    assert not _whole(part)


@pytest.mark.parametrize("said", ["", "[]", "null", '{"bytes": 4}', '{"bytes": 4, "held": 1, "broken": 0, "codec": 3}'])
def test_a_record_that_nobody_has_written_counts_for_nothing(part, said):
    part.record_file.write_text(said)
    assert not _whole(part)


@pytest.mark.skipif(os.name == "nt", reason="this system has no pipes among its files")
@pytest.mark.parametrize("name", ["part.mp4", "part.json"])
def test_a_pipe_in_a_parts_place_is_not_waited_for(part, tmp_path, name):
    (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    assert not _whole(part)


def test_a_film_of_frames_nearly_all_of_which_are_missing_is_refused(tmp_path):
    path = store(tmp_path / "result.zarr", [400.0, None, 402.0])
    assert _wanted(StoredResult(path)) == (0, 1, 2)
    result = StoredResult(store(tmp_path / "long.zarr", [400.0] * 10_400, missing=range(1, 10_399)))
    with pytest.raises(FootageError, match="says that it holds 10400 frames, but 2 are there"):
        _wanted(result)
