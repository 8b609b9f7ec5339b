"""Other programs' meshes, whole and damaged; nothing elsewhere is opened."""

import base64
import json
import struct

import numpy as np
import pytest
import trimesh

from pipeline.errors import FootageError
from pipeline.output.mesh_files import read_mesh, write_mesh


def write(mesh, path):
    """Write a mesh; as .gltf, which other programs write, from the parts of a .glb."""
    if path.suffix != ".gltf":
        return write_mesh(mesh, path)
    write_mesh(mesh, path.with_suffix(".glb"))
    data = path.with_suffix(".glb").read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    scene = json.loads(data[20 : 20 + length])
    scene["buffers"][0]["uri"] = (
        f"data:application/octet-stream;base64,{base64.b64encode(data[28 + length :]).decode()}"
    )
    path.write_text(json.dumps(scene))


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".glb", ".gltf"])
def test_what_is_written_comes_back(tmp_path, mesh, suffix):
    write(mesh, tmp_path / f"mesh{suffix}")
    read = read_mesh(tmp_path / f"mesh{suffix}")
    np.testing.assert_allclose(read.vertices[read.faces], mesh.vertices[mesh.faces], rtol=1e-5, atol=1e-4)
    if suffix == ".stl":
        assert read.colors is None
    else:
        np.testing.assert_allclose(read.colors.astype(int), mesh.colors, atol=2)


def test_other_programs_meshes_are_read(tmp_path):
    box = trimesh.creation.box((10, 20, 30))
    box.apply_translation((0, 5, 0))
    box.export(tmp_path / "box.stl")
    read = read_mesh(tmp_path / "box.stl")
    np.testing.assert_allclose(np.ptp(read.vertices, axis=0), (10, 30, 20))  # a printer's z is up, ours is away
    np.testing.assert_allclose(read.vertices[:, 2].min(), -5)


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".glb", ".gltf"])
def test_damaged_files_are_one_line(tmp_path, mesh, suffix):
    path = tmp_path / f"mesh{suffix}"
    write(mesh, path)
    whole = path.read_bytes()
    rng = np.random.default_rng(5)
    for content in (b"", b"\0" * 100, whole[: len(whole) // 2], rng.bytes(500)):
        path.write_bytes(content)
        try:
            read_mesh(path)
        except FootageError as error:
            assert "\n" not in str(error) and str(error).startswith("cannot read"), error
        else:
            assert suffix == ".obj", "half a text may be a smaller mesh"


def test_only_files_beside_a_mesh_are_opened(tmp_path, mesh):
    (tmp_path / "inside").mkdir()
    (tmp_path / "secret.bin").write_bytes(b"\1" * 4000)
    write(mesh, tmp_path / "inside" / "mesh.gltf")
    scene = json.loads((tmp_path / "inside" / "mesh.gltf").read_text())
    for place in ("../secret.bin", "http://127.0.0.1:9/secret.bin", str(tmp_path / "secret.bin")):
        scene["buffers"][0]["uri"] = place
        (tmp_path / "inside" / "mesh.gltf").write_text(json.dumps(scene))
        with pytest.raises(FootageError, match=r"cannot read .*mesh\.gltf as a surface \(GLTF\)"):
            read_mesh(tmp_path / "inside" / "mesh.gltf")


def test_points_without_triangles_are_no_mesh(tmp_path):
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(FootageError, match=r"cannot read .* as a surface \(OBJ\): it has no triangles"):
        read_mesh(tmp_path / "points.obj")


def test_a_mesh_larger_than_any_camera_is_refused(tmp_path, mesh, monkeypatch):
    write_mesh(mesh, tmp_path / "mesh.stl")
    monkeypatch.setenv("COLORPHASE_MAX_PIXELS", "4")
    with pytest.raises(FootageError, match="set COLORPHASE_MAX_PIXELS to a larger number"):
        read_mesh(tmp_path / "mesh.stl")
