"""Frames of a store, read one at a time, and their meshes."""

import numpy as np
import pytest
import zarr
from support.stored_planes import store

from pipeline import Decoder
from pipeline.decoding.frame import FIELDS
from pipeline.errors import DecodeWarning, FootageError
from pipeline.output.mesh_files import read_mesh, write_mesh
from pipeline.output.store import write_store
from pipeline.output.stored_result import StoredResult
from pipeline.output.surface_mesh import counted_mesh, frame_grid, frame_mesh
from pipeline.simulation import TYPICAL_CROSSTALK, simulate_frame, simulated_rig

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
    stored = StoredResult(path)
    with pytest.raises(FootageError, match=r"frame \d: points is damaged"):
        for number in stored.done:
            frame_mesh(stored.frame(number))


def test_a_damaged_mark_is_named(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0])
    mark = path / "done" / "c.0.0"
    mark.write_bytes(bytes(len(mark.read_bytes())))
    with pytest.raises(FootageError, match="frame 0: its mark is damaged"):
        _ = StoredResult(path).frame(0).digest


def test_frames_are_told_apart(tmp_path):
    first = StoredResult(store(tmp_path / "r.zarr", [400.0, 401.0, 401.0]))
    again = StoredResult(store(tmp_path / "again.zarr", [400.0, 401.0]))
    assert [first.frame(number).digest for number in (0, 1)] == [again.frame(number).digest for number in (0, 1)]
    assert first.frame(0).digest != first.frame(1).digest == first.frame(2).digest


def test_ranges_in_mm_make_no_mesh_without_points(tmp_path):
    """Depths in mm over columns and rows in px would be no shape at all."""
    stored = StoredResult(store(tmp_path / "r.zarr", [400.0], leave_out=("points",)))
    for ask in (lambda number: frame_mesh(stored.frame(number)), lambda number: stored.require("points")):
        with pytest.raises(FootageError, match="holds no points: decode with that field"):
            ask(0)


def test_a_texture_colours_the_mesh(tmp_path):
    """As it was decoded, through the store and the file."""
    rig = simulated_rig((128, 96), period_px=2 * 768 / 44)
    known = rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    frame = Decoder(calibration=known, arch="cpu").decode(simulate_frame(rig).image)
    write_store(tmp_path / "r.zarr", frame)
    stored = StoredResult(tmp_path / "r.zarr")
    np.testing.assert_array_equal(stored.frame(0).texture, frame.texture)
    mesh = frame_mesh(stored.frame(0))
    assert mesh.colors.dtype == np.uint8 and mesh.colors.shape == mesh.vertices.shape
    np.testing.assert_array_equal(mesh.colors, frame_mesh(frame).colors)
    write_mesh(mesh, tmp_path / "mesh.ply")
    np.testing.assert_array_equal(read_mesh(tmp_path / "mesh.ply").colors, mesh.colors)
    assert frame_mesh(stored.frame(0), fields=("points",)).colors is None
    # A vertex has the colour of its own pixel.
    matrix = known.camera.matrix
    place = mesh.vertices[:, :2] / mesh.vertices[:, 2:] * np.diag(matrix)[:2] + matrix[:2, 2]
    x, y = np.rint(place).astype(int).T
    measured = frame.mask[y, x]
    np.testing.assert_array_equal(mesh.colors[measured], frame.texture[y, x][measured])


def test_a_grid_holds_what_is_stored_and_the_camera(tmp_path):
    rig = simulated_rig((128, 96), period_px=2 * 768 / 44)
    frame = Decoder(calibration=rig, arch="cpu").decode(simulate_frame(rig).image)
    write_store(tmp_path / "r.zarr", frame)
    stored = StoredResult(tmp_path / "r.zarr")
    grid = frame_grid(stored.frame(0))
    np.testing.assert_array_equal(grid.points, np.where(frame.mask[..., None], frame.points, np.nan))
    np.testing.assert_array_equal(grid.texture, frame.texture)
    assert grid.properties.keys() == {"modulation", "order_error_probability", "sigma_rad", "sigma_mm"}
    assert (np.isnan(grid.properties["modulation"]) == ~frame.mask).all()
    np.testing.assert_array_equal(grid.camera.matrix, rig.camera.matrix)
    assert grid.provenance["calibration_sha256"] == rig.digest() and grid.provenance["frame"] == "0"
    # Through the camera that the store holds, a point lands on its pixel.
    y, x = np.argwhere(frame.mask)[100]
    seen = grid.camera.matrix @ grid.points[y, x] / grid.points[y, x, 2]
    np.testing.assert_allclose(seen[:2], (x, y), atol=1e-3)


def test_surfaces_that_the_decoder_told_apart_stay_apart(tmp_path):
    """A store that holds regions cuts its meshes as a frame does."""
    rig = simulated_rig((128, 96), period_px=2 * 768 / 44)
    frame = Decoder(calibration=rig, arch="cpu").decode(simulate_frame(rig).image)
    write_store(tmp_path / "r.zarr", frame)
    (mesh, counts), (expected, wanted) = counted_mesh(StoredResult(tmp_path / "r.zarr").frame(0)), counted_mesh(frame)
    np.testing.assert_array_equal(mesh.faces, expected.faces)
    assert counts == wanted


def test_without_mm_there_is_no_grid(tmp_path):
    stored = StoredResult(store(tmp_path / "r.zarr", [400.0], in_mm=False))
    assert stored.camera is None
    with pytest.raises(FootageError, match="is in rad, not in mm: decode with a calibration that holds the geometry"):
        frame_grid(stored.frame(0))


def test_a_newer_version_is_read_as_far_as_it_is_known(tmp_path, monkeypatch):
    monkeypatch.setitem(FIELDS, "gloss", FIELDS["modulation"])
    path = store(tmp_path / "r.zarr", [400.0], also=("gloss",))
    assert "gloss" in StoredResult(path).fields
    monkeypatch.delitem(FIELDS, "gloss")
    with pytest.warns(DecodeWarning, match=r"this version leaves out fields that it does not know \(gloss\): update"):
        stored = StoredResult(path)
    assert "gloss" not in stored.fields and stored.fault(0) is None
    assert len(frame_mesh(stored.frame(0)).faces) > 1000
