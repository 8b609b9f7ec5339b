"""Frames of a store, read one at a time, and their meshes."""

import numpy as np
import pytest
import zarr
from support.stored_planes import plane, store

from pipeline.errors import FootageError
from pipeline.output.mesh_files import read_mesh
from pipeline.output.stored_result import StoredResult, export_frames

pytestmark = pytest.mark.usefixtures("cpu")


def test_what_is_no_store(tmp_path):
    (tmp_path / "other").mkdir()
    zarr.open_group(tmp_path / "group.zarr", mode="w").create_array("a", shape=(3,), dtype="f4")
    zarr.open_group(tmp_path / "old.zarr", mode="w", zarr_format=2, attributes={"settings": {}})
    for name, reason in (
        ("none", "not a result.zarr that can be read"),
        ("other", "not a result.zarr that can be read"),
        ("group.zarr", "not a result.zarr that can be read"),
        ("old.zarr", "not a result.zarr that can be read"),  # codecs of that format may unpickle
    ):
        with pytest.raises(FootageError, match=f"{name} is {reason}"):
            StoredResult(tmp_path / name)


def test_a_mark_that_was_cut_off_is_none(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0, 401.0])
    (path / "done" / "c.0.0").write_bytes(b"{}")
    assert StoredResult(path).done == (1,)


def test_a_damaged_chunk_is_named(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0, 401.0])
    chunk = next(p for p in (path / "points").rglob("*") if p.is_file() and p.name != "zarr.json")
    chunk.write_bytes(b"nothing")
    with pytest.raises(FootageError, match=r"frame \d: points is damaged"):
        export_frames(path, tmp_path / "out", "ply")


@pytest.mark.parametrize("in_mm", [True, False])
def test_export(tmp_path, in_mm):
    path = store(tmp_path / "r.zarr", [400.0, None, 402.0, 403.0], missing=(3,), in_mm=in_mm)
    assert export_frames(path, tmp_path / "out", "ply") == (2, (1,))
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["frame_000000.ply", "frame_000002.ply"]
    mesh = read_mesh(tmp_path / "out" / "frame_000002.ply")
    assert len(mesh.vertices) == plane(402.0)[1].sum()
    assert np.all(mesh.vertices[:, 2] == np.float32(402.0 if in_mm else 4.0200195))
    assert mesh.unit == ("mm" if in_mm else "rad")
    assert mesh.properties.keys() == {"modulation", "sigma_rad"} | ({"sigma_mm"} if in_mm else set())
    assert export_frames(path, tmp_path / "glb", "glb")[0] == 2
    assert (tmp_path / "glb" / "frame_000000.glb").read_bytes()[:4] == b"glTF"


def test_ranges_in_mm_make_no_mesh_without_points(tmp_path):
    """Depths in mm over columns and rows in px would be no shape at all."""
    path = store(tmp_path / "r.zarr", [400.0], leave_out=("points",))
    with pytest.raises(FootageError, match="holds no points: decode with that field"):
        export_frames(path, tmp_path / "out", "ply")


@pytest.mark.parametrize(
    "lost, message", [("done/c.*", "holds no frame that is done: decode first"), ("mask", "array is missing")]
)
def test_an_export_of_nothing_leaves_no_folder(tmp_path, lost, message):
    path = store(tmp_path / "r.zarr", [400.0, 401.0])
    for place in path.glob(lost):
        place.rename(tmp_path / place.name)
    with pytest.raises(FootageError, match=message):
        export_frames(path, tmp_path / "meshes", "ply")
    assert not (tmp_path / "meshes").exists()
