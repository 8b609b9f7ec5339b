"""A store's frames as files: made once, made again where they must be, and nothing of the user's is lost."""

import json
import shutil

import cv2
import numpy as np
import pytest
from PIL import Image
from support.stored_planes import LENS, plane, store

from pipeline.errors import FootageError, OutputError, SettingsError
from pipeline.locking import locked
from pipeline.output import frame_export
from pipeline.output.folder import file_mark
from pipeline.output.formats.table import FORMATS
from pipeline.output.frame_export import export_frames
from pipeline.output.mesh_files import read_mesh
from pipeline.output.store import in_bytes
from pipeline.output.stored_result import StoredResult
from pipeline.output.surface_mesh import MeshOptions

pytestmark = pytest.mark.usefixtures("cpu")


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def contents(folder):
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()}


@pytest.fixture
def result(tmp_path):
    return store(tmp_path / "r.zarr", [400.0, None, 402.0, 403.0])


@pytest.mark.parametrize("in_mm", [True, False])
def test_every_frame_with_a_surface_is_a_mesh(tmp_path, in_mm):
    path = store(tmp_path / "r.zarr", [400.0, None, 402.0, 403.0], missing=(3,), in_mm=in_mm)
    done = export_frames(path, tmp_path / "out", "ply")
    assert (sorted(done.written), done.before, done.empty) == ([0, 1, 2], [], [1])
    assert names(tmp_path / "out") == ["exported.json", "frame_000000.ply", "frame_000002.ply"]
    mesh = read_mesh(tmp_path / "out" / "frame_000002.ply")
    assert len(mesh.vertices) == plane(402.0)[1].sum()
    assert np.all(mesh.vertices[:, 2] == np.float32(402.0 if in_mm else 4.0200195))
    assert mesh.unit == ("mm" if in_mm else "rad")
    assert mesh.properties.keys() == {"modulation", "sigma_rad"} | ({"sigma_mm"} if in_mm else set())
    export_frames(path, tmp_path / "glb", "glb")
    assert (tmp_path / "glb" / "frame_000000.glb").read_bytes()[:4] == b"glTF"


@pytest.mark.parametrize("kind", ["ply", "glb"])
def test_a_second_export_writes_nothing(result, tmp_path, kind):
    export_frames(result, tmp_path / "out", kind)
    before, told = contents(tmp_path / "out"), []
    done = export_frames(result, tmp_path / "out", kind, lambda *progress: told.append(progress))
    assert (done.written, done.before, done.empty) == ([], [0, 1, 2, 3], [1])
    assert contents(tmp_path / "out") == before and told == [(4, 4)]
    done = export_frames(result, tmp_path / "out", kind, force=True)
    assert sorted(done.written) == [0, 1, 2, 3]
    assert {name: content for name, (content, _) in contents(tmp_path / "out").items()} == {
        name: content for name, (content, _) in before.items()
    }


def test_all_kinds_share_a_folder(result, tmp_path):
    for kind, form in FORMATS.items():
        done = export_frames(result, tmp_path / "out", kind)
        # A bag has a message of every frame, also of one that is NaN all over.
        assert done.empty == ([] if form.holds_all_frames else [1]), kind
    for kind in FORMATS:
        assert export_frames(result, tmp_path / "out", kind).written == [], kind
    kinds = {name.partition(".")[2] for name in names(tmp_path / "out")}
    assert kinds == {"json", *FORMATS} - {"mcap"} | {""}
    assert names(tmp_path / "out" / "bag") == ["bag.mcap", "metadata.yaml"]


def test_a_name_with_controls_is_a_line_of_text_in_every_kind(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0], footage="m\u202cller\r\u2028.mkv", lens=LENS)
    for kind in FORMATS:
        export_frames(path, tmp_path / "out", kind)
        whole = [file.read_bytes() for file in (tmp_path / "out").rglob("*") if file.is_file()]
        if kind == "npz":  # text of four bytes a letter, compressed
            whole = [str(np.load(tmp_path / "out" / "frame_000000.npz")["source"]).encode()]
        # An STL's 80 bytes end before it, and points as text are numbers alone.
        assert any(b"mller  .mkv" in content for content in whole) or kind in ("stl", "xyz", "csv"), kind
        shutil.rmtree(tmp_path / "out")


def test_how_large_all_will_be_is_told_by_the_first(result, tmp_path, monkeypatch):
    remarks = []
    export_frames(result, tmp_path / "small", "ply", remark=remarks.append)
    assert remarks == []
    monkeypatch.setattr(frame_export, "WORTH_SAYING", 1000)
    export_frames(result, tmp_path / "out", "ply", remark=remarks.append)
    size = (tmp_path / "out" / "frame_000000.ply").stat().st_size
    assert remarks == [f"{tmp_path / 'out'} will grow by about {in_bytes(4 * size)}, by its first file"]


def test_depths_of_a_film_have_one_step(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0, 900.0])
    export_frames(path, tmp_path / "out", "png")
    for number, distance_mm in ((0, 400.0), (1, 900.0)):
        file = str(tmp_path / "out" / f"frame_00000{number}.png")
        with Image.open(file) as picture:
            assert picture.text["depth_step_mm"] == "0.02" and picture.text["frame"] == str(number)
        assert cv2.imread(file, cv2.IMREAD_UNCHANGED)[0, 0] * 0.02 == distance_mm


def test_a_bag_that_was_stopped_is_made_anew(result, tmp_path):
    export_frames(result, tmp_path / "out", "mcap")
    (tmp_path / "out" / "bag" / "metadata.yaml").unlink()
    assert export_frames(result, tmp_path / "out", "mcap").written == [0, 1, 2, 3]
    (tmp_path / "out" / "bag" / "bag.mcap").write_bytes(b"cut by hand")
    with pytest.raises(OutputError, match=r"bag/bag\.mcap has been changed since we wrote it"):
        export_frames(result, tmp_path / "out", "mcap")


@pytest.mark.parametrize("kind", ["pcd", "png", "tiff", "mcap"])
def test_grids_are_in_mm(tmp_path, kind):
    path = store(tmp_path / "r.zarr", [400.0], in_mm=False)
    with pytest.raises(FootageError, match="is in rad, not in mm: decode with a --calibration that holds the geometry"):
        export_frames(path, tmp_path / "out", kind)
    whole = store(tmp_path / "whole.zarr", [400.0])
    with pytest.raises(SettingsError, match=f"{kind} keeps every measured pixel: cropping and the like are for"):
        export_frames(whole, tmp_path / "out", kind, options=MeshOptions(max_triangles=3))
    assert not (tmp_path / "out").exists()


def test_other_options_make_other_meshes(result, tmp_path):
    export_frames(result, tmp_path / "out", "ply")
    few = MeshOptions(max_triangles=40)
    assert len(export_frames(result, tmp_path / "out", "ply", options=few).written) == 4
    assert len(read_mesh(tmp_path / "out" / "frame_000000.ply").faces) <= 40
    counts = json.loads((tmp_path / "out" / "exported.json").read_text())["items"]["frame_000000.ply"]["counts"]
    assert counts["triangles"] <= 40 and counts["filled"] == 0 and counts["cropped"] == 0
    assert export_frames(result, tmp_path / "out", "ply", options=few).written == []


@pytest.mark.parametrize("kind", ["ply", "obj", "pcd", "png"])
def test_what_is_whole_is_exported(tmp_path, kind):
    path = store(tmp_path / "r.zarr", [400.0, 401.0, 402.0])
    next((path / "points").glob("c.1.*")).write_bytes(b"nothing")
    done = export_frames(path, tmp_path / "out", kind)
    assert done.written == [0, 2] and done.damaged.keys() == {1}
    assert "frame 1: points is damaged" in done.damaged[1] and "decode again as before" in done.damaged[1]
    assert export_frames(path, tmp_path / "out", kind).before == [0, 2]


def test_what_is_missing_or_decoded_anew_is_written(result, tmp_path):
    export_frames(result, tmp_path / "out", "ply")
    (tmp_path / "out" / "frame_000000.ply").unlink()
    assert export_frames(result, tmp_path / "out", "ply").written == [0]
    anew = store(tmp_path / "anew.zarr", [400.0, 401.0, None, 403.0, 404.0])
    done = export_frames(anew, tmp_path / "out", "ply")
    assert sorted(done.written) == [1, 2, 4] and done.empty == [2]
    assert names(tmp_path / "out") == ["exported.json", *(f"frame_00000{number}.ply" for number in (0, 1, 3, 4))]


class Stop(Exception):
    """Something unforeseen."""


@pytest.mark.parametrize("error", [KeyboardInterrupt, Stop])
def test_an_export_that_was_stopped_goes_on(result, tmp_path, error):
    def stop(done, of):
        if done == 2:
            raise error

    with pytest.raises(error) as stopped:
        export_frames(result, tmp_path / "out", "ply", stop)
    if error is KeyboardInterrupt:
        assert str(stopped.value) == "stopped: 2 of 4 frames are exported; the same command goes on from there"
    assert names(tmp_path / "out") == ["exported.json", "frame_000000.ply"]
    done = export_frames(result, tmp_path / "out", "ply")
    assert (done.before, done.written) == ([0, 1], [2, 3])


def test_an_export_that_was_killed_goes_on(result, tmp_path):
    """It has written down nothing, and left its work."""
    export_frames(result, tmp_path / "out", "ply")
    (tmp_path / "out" / "exported.json").unlink()
    (tmp_path / "out" / "frame_000003.ply").unlink()
    (tmp_path / "out" / ".export.killed").mkdir()
    (tmp_path / "out" / ".export.killed" / "frame_000003.ply").write_bytes(b"half")
    assert sorted(export_frames(result, tmp_path / "out", "ply").written) == [0, 1, 2, 3]
    assert names(tmp_path / "out") == ["exported.json", *(f"frame_00000{number}.ply" for number in (0, 2, 3))]


@pytest.mark.parametrize(
    ("name", "exported", "why"),
    [
        ("frame_000002.ply", True, r"frame_000002\.ply has been changed since we wrote it"),
        ("frame_000002.ply", False, r"frame_000002\.ply is not ours"),
        ("exported.json", False, r"exported\.json is not ours"),
    ],
)
def test_a_file_of_the_users_stays(result, tmp_path, name, exported, why):
    out = tmp_path / "out"
    out.mkdir()
    if exported:
        export_frames(result, out, "ply")
    (out / name).write_bytes(b"cleaned by hand")
    before = names(out)
    with pytest.raises(OutputError, match=rf"holds something else \({why}\): choose another folder, or add --force"):
        export_frames(result, out, "ply")
    assert (out / name).read_bytes() == b"cleaned by hand" and set(names(out)) <= {*before, "exported.json"}
    assert 2 in export_frames(result, out, "ply", force=True).written
    assert (out / name).read_bytes() != b"cleaned by hand"


def test_other_files_stay(result, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("mine")
    export_frames(result, tmp_path / "out", "ply")
    assert "thesis.tex" in names(tmp_path / "out")


@pytest.mark.parametrize(
    ("lost", "message"),
    [
        ("done/c.*", "holds no frame that is done: decode first"),
        ("mask", "array is missing"),
        ("points/c.*", "frame 0: points is missing"),
    ],
)
def test_an_export_of_nothing_leaves_no_folder(tmp_path, lost, message):
    path = store(tmp_path / "r.zarr", [400.0, 401.0])
    for place in path.glob(lost):
        place.rename(tmp_path / place.name)
    with pytest.raises(FootageError, match=message):
        export_frames(path, tmp_path / "meshes", "ply")
    assert not (tmp_path / "meshes").exists()


def test_two_exports_do_not_write_to_one_folder(result, tmp_path):
    (tmp_path / "out").mkdir()
    with locked(tmp_path / "out" / "exported.json"):
        with pytest.raises(OutputError, match="is being written by another run"):
            export_frames(result, tmp_path / "out", "ply")


def test_another_version_exports_anew(result, tmp_path, monkeypatch):
    export_frames(result, tmp_path / "out", "ply")
    monkeypatch.setattr(frame_export, "version", lambda package: "0.0")
    assert len(export_frames(result, tmp_path / "out", "ply").written) == len(StoredResult(result).done)
    assert json.loads((tmp_path / "out" / "exported.json").read_text())["items"].keys() == {
        f"frame_00000{number}.ply" for number in range(4)
    }


def test_a_place_that_is_no_folder(result, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="cannot write"):
        export_frames(result, tmp_path / "file", "ply")


@pytest.mark.parametrize("name", ["../mine", "/mine", "bag/../../mine", "..", "deep/er/mine", "bag/mcap/x"])
def test_a_record_does_not_choose_what_is_removed(result, tmp_path, name):
    """The file has the digest that is recorded of it, and no frame needs it any more."""
    out = tmp_path / "out"
    export_frames(result, out, "ply")
    (tmp_path / "mine").write_text("mine")
    record = json.loads((out / "exported.json").read_text())
    item = record["items"]["frame_000000.ply"]
    item["made_of"] = "other"
    item["files"][name] = file_mark(tmp_path / "mine")
    (out / "exported.json").write_text(json.dumps(record))
    with pytest.raises(OutputError, match=r"holds something else \(exported.json is not ours\)"):
        export_frames(result, out, "ply")
    export_frames(result, out, "ply", force=True)
    assert (tmp_path / "mine").read_text() == "mine"
