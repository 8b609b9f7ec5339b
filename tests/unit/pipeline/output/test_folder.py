"""The folder that decoding fills: whole or not at all, and nothing of the user's is lost."""

import hashlib
import json
import os

import numpy as np
import pytest
import zarr
from support.stored_planes import store

from pipeline.errors import OutputError
from pipeline.output.folder import changed_files, file_mark, output_folder


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
    written(tmp_path, "old")
    with pytest.raises(RuntimeError), output_folder(tmp_path) as work:
        (work / "mesh.ply").write_text("half")
        raise RuntimeError
    assert (tmp_path / "mesh.ply").read_text() == "old"
    assert names(tmp_path) == ["mesh.ply", "report.json", "result.zarr"] and changed_files(tmp_path) == []


def written(folder, mesh="mesh", **options):
    with output_folder(folder, **options) as work:
        (work / "mesh.ply").write_text(mesh)
        (work / "report.json").write_text('{"source": "a.png"}')
        store(work / "result.zarr", [400.0])


def test_an_earlier_result_is_replaced_and_the_rest_of_it_stays(tmp_path):
    written(tmp_path)
    with output_folder(tmp_path) as work:
        (work / "mesh.ply").write_text("another mesh")
        (work / "range.png").write_text("range")
        (work / "report.json").write_text("{}")
    assert names(tmp_path) == ["mesh.ply", "range.png", "report.json", "result.zarr"]
    assert (tmp_path / "mesh.ply").read_text() == "another mesh"
    assert changed_files(tmp_path) == []
    written(tmp_path)
    assert names(tmp_path) == ["mesh.ply", "range.png", "report.json", "result.zarr"]


@pytest.mark.parametrize("name", ["mesh.ply", "report.json", "range.png", "calibration.json", "result.zarr"])
def test_a_file_of_the_same_name_that_is_not_ours_stays(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(
        OutputError, match=rf"holds something else \({name} is not ours\): choose another folder, or add"
    ):
        written(tmp_path)
    assert names(tmp_path) == [name] and (tmp_path / name).read_text() == "mine"
    if name == "result.zarr":
        return
    written(tmp_path, force=True)
    assert {"mesh.ply", "report.json", "result.zarr"} <= set(names(tmp_path))


def test_a_foreign_group_is_not_a_result(tmp_path):
    zarr.open_group(tmp_path / "result.zarr", mode="w", attributes={"mine": True})
    with pytest.raises(OutputError, match=r"result\.zarr is not ours"):
        written(tmp_path)
    assert zarr.open_group(tmp_path / "result.zarr", mode="r").attrs["mine"]


def test_a_mesh_that_its_user_has_edited_stays(tmp_path):
    written(tmp_path)
    (tmp_path / "mesh.ply").write_text("cleaned by hand")
    assert changed_files(tmp_path) == ["mesh.ply"]
    with pytest.raises(OutputError, match=r"mesh\.ply has been changed since we wrote it"):
        written(tmp_path)
    assert (tmp_path / "mesh.ply").read_text() == "cleaned by hand"
    written(tmp_path, force=True)
    assert (tmp_path / "mesh.ply").read_text() == "mesh"


def test_what_comes_while_a_result_is_made_stays(tmp_path):
    with pytest.raises(OutputError, match="is not ours"), output_folder(tmp_path) as work:
        (work / "mesh.ply").write_text("mesh")
        (tmp_path / "mesh.ply").write_text("mine")
    assert names(tmp_path) == ["mesh.ply"] and (tmp_path / "mesh.ply").read_text() == "mine"


def test_the_frames_of_footage_stay(tmp_path):
    store(tmp_path / "result.zarr", [400.0, 401.0])
    about = json.loads((tmp_path / "result.zarr" / "zarr.json").read_text())
    with pytest.raises(OutputError, match="holds the frames of footage: choose another folder"):
        (tmp_path / "result.zarr" / "zarr.json").write_text(json.dumps({**about, "damaged": 1, "attributes": {}}))
        written(tmp_path)


def test_something_else_stays_unless_that_is_wanted(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(OutputError, match=r"holds something else \(thesis\.tex is not ours\): choose another folder"):
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


@pytest.mark.skipif(os.name == "nt", reason="this system has no pipes among its files")
@pytest.mark.parametrize("name", ["/dev/zero", "../secret", "..", "", ".", "pipe", "a/b", "nul\0l", "\ud800", "link"])
def test_a_report_does_not_choose_what_is_read(tmp_path, name):
    """Names of other folders, what has no end, and names that no file can have."""
    out = tmp_path / "out"
    written(out)
    (tmp_path / "secret").write_text("secret")
    os.mkfifo(out / "pipe")
    (out / "link").symlink_to("/dev/zero")
    report = json.loads((out / "report.json").read_text())
    report["files"] |= {name: file_mark(tmp_path / "secret")}
    (out / "report.json").write_text(json.dumps(report))
    assert set(changed_files(out)) <= {name}
    with pytest.raises(OutputError, match=r"holds something else \((link|pipe)"):
        written(out)


def test_a_file_of_another_length_is_not_read(tmp_path, monkeypatch):
    written(tmp_path)
    os.truncate(tmp_path / "mesh.ply", 2**36)

    def digest(file, kind):
        assert os.fstat(file.fileno()).st_size < 2**30
        return hashlib.sha256(file.read())

    monkeypatch.setattr(hashlib, "file_digest", digest)
    assert changed_files(tmp_path) == ["mesh.ply"]
    with pytest.raises(OutputError, match=r"mesh\.ply has been changed since we wrote it"):
        written(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="this system has no pipes among its files")
def test_a_report_that_is_no_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "report.json")
    assert changed_files(tmp_path) == []


def test_a_link_named_like_a_result_file_leads_nowhere(tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "out").mkdir()
    for name in ("mesh.ply", "report.json"):
        (tmp_path / "out" / name).symlink_to(tmp_path / "mine")
    with pytest.raises(OutputError, match="holds something else"):
        written(tmp_path / "out")
    written(tmp_path / "out", force=True)
    assert (tmp_path / "mine").read_text() == "mine" and changed_files(tmp_path / "out") == []
