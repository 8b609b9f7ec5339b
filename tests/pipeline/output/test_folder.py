"""The folder that decoding fills: whole or not at all, and nothing of the user's is lost."""

import numpy as np
import pytest

from pipeline.errors import OutputError
from pipeline.output.folder import output_folder


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def test_what_is_written_appears_together_at_the_end(tmp_path):
    out = tmp_path / "new" / "out"
    with output_folder(out) as work:
        (work / "mesh.ply").write_text("mesh")
        (work / "result.zarr").mkdir()
        assert not out.exists()
    assert names(out) == ["mesh.ply", "result.zarr"] and names(tmp_path / "new") == ["out"]


def test_an_error_leaves_what_was_there(tmp_path):
    (tmp_path / "mesh.ply").write_text("old")
    with pytest.raises(RuntimeError), output_folder(tmp_path) as work:
        (work / "mesh.ply").write_text("half")
        raise RuntimeError
    assert (tmp_path / "mesh.ply").read_text() == "old"
    assert names(tmp_path) == ["mesh.ply"]


def test_an_earlier_result_is_replaced_and_the_rest_of_it_stays(tmp_path):
    (tmp_path / "result.zarr").mkdir()
    (tmp_path / "result.zarr" / "zarr.json").write_text('{"attributes": {}}')
    (tmp_path / "report.json").write_text("old")
    with output_folder(tmp_path) as work:
        (work / "result.zarr").mkdir()
        (work / "result.zarr" / "new").write_text("")
    assert names(tmp_path / "result.zarr") == ["new"] and (tmp_path / "report.json").read_text() == "old"


def test_something_else_stays_unless_that_is_wanted(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(OutputError, match=r"holds something else \(thesis\.tex\): choose another folder, or add"):
        with output_folder(tmp_path):
            pass
    with output_folder(tmp_path, force=True) as work:
        (work / "mesh.ply").write_text("mesh")
    assert names(tmp_path) == ["mesh.ply", "thesis.tex"]


def test_places_that_are_no_folders(tmp_path):
    (tmp_path / "file").write_bytes(np.zeros(3).tobytes())
    for place, message in (
        (tmp_path / "file", "is a file: choose a folder"),
        (tmp_path / "file" / "out", "its folder is a file"),
        ("s3://bucket/out", "is not a folder here"),
    ):
        with pytest.raises(OutputError, match=message):
            with output_folder(place):
                pass
    assert names(tmp_path) == ["file"]
