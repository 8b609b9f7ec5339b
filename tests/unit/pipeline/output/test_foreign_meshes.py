"""Meshes that other programs have written: what they hold, and that they are not mistaken for ours."""

import io
import json
import struct
from base64 import b64encode
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.tilted_sheets import tilted_grid

from pipeline.errors import FootageError
from pipeline.output.formats import Content, Heading
from pipeline.output.formats.camera_grids import decode_pcd, encode_pcd
from pipeline.output.formats.table import FORMATS, encode_as
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_mesh, read_placed, write_mesh
from tikernels.raw.linearization import srgb_values

#: Two triangles as MeshLab, CloudCompare 2.11, Blender 5.0, Open3D, PCL, trimesh, meshio and plyfile have written them;
#: and points as PCL has.
FOREIGN = Path(__file__).parents[3] / "support" / "foreign"
CORNERS = np.array([[[0, 0, 0], [1, 0, 0], [1, 2, 0]], [[0, 0, 0], [1, 2, 0], [0, 2, 3]]], np.float32)
# Each of these formats' colours, by the vertex at the place.
COLORS = {(0, 0, 0): (255, 0, 0), (1, 0, 0): (0, 255, 0), (1, 2, 0): (0, 0, 255), (0, 2, 3): (10, 20, 30)}
HEAD = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
FACES = "element face {}\nproperty list int int vertex_index\n"
POINTS = "0 0 0\n1 0 0\n2 1 0\n1 2 0\n0 1 0\n"
FIVE = np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0], [1, 2, 0], [0, 1, 0]], np.float32)


def as_it_is(path: Path) -> Mesh:
    return read_mesh(path, axes="camera", unit="mm")


@pytest.mark.parametrize("path", sorted(FOREIGN.glob("*.[posg][lbt]*")), ids=lambda path: path.name)
def test_other_programs_meshes_are_read(path: Path) -> None:
    mesh = as_it_is(path)
    triangles = mesh.vertices[mesh.faces]
    if path.name == "plyfile_strips.ply":  # 0 1 2 3, and 3 2 1
        corners = mesh.vertices[[[0, 1, 2], [1, 3, 2], [3, 2, 1]]]
    elif path.name == "meshio.ply":  # and a quad
        corners = np.concatenate([CORNERS, CORNERS])
    else:
        corners = CORNERS
    np.testing.assert_array_equal(triangles, corners)
    if path.name.startswith(("meshio", "meshlab.obj", "cloudcompare.obj")) or path.suffix == ".stl":
        return
    cut = int(path.name == "blender.ply")  # its colours are cut to whole levels
    for place, color in zip(mesh.vertices.astype(int).tolist(), mesh.colors, strict=True):
        np.testing.assert_allclose(color, COLORS[tuple(place)], atol=cut, rtol=0)
    if mesh.normals is not None:
        across = np.cross(*np.diff(triangles, axis=1).swapaxes(0, 1)).astype(np.float64)
        turns = np.einsum("fk,fvk->fv", across, mesh.normals[mesh.faces].astype(np.float64))
        assert (turns > 0).all() and np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-3)


def gltf(primitive: dict[str, object], node: dict[str, object], colors: bytes, kind: int, generator: str = "") -> bytes:
    """Return the two triangles as a glTF file, as small as the standard allows, with colours of a type."""
    vertices = np.unique(CORNERS.reshape(-1, 3), axis=0)
    faces = [int(np.flatnonzero((vertices == corner).all(axis=1))[0]) for corner in CORNERS.reshape(-1, 3)]
    blocks = [vertices.tobytes(), np.array(faces, "<u2").tobytes(), colors]
    starts = np.cumsum([0, *map(len, blocks)]).tolist()
    accessors = [(5126, 4, "VEC3", False), (5123, 6, "SCALAR", False), (kind, 4, "VEC4", kind != 5126)]
    attributes = {"POSITION": 0, "COLOR_0": 2}
    said = {
        "asset": {"version": "2.0", "generator": generator},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1, **primitive}]}],
        "materials": [{}],
        "buffers": [{"byteLength": starts[-1], "uri": "data:;base64," + b64encode(b"".join(blocks)).decode()}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": at, "byteLength": len(block)} for at, block in zip(starts, blocks, strict=False)
        ],
        "accessors": [
            {"bufferView": i, "componentType": part, "count": count, "type": form, "normalized": normalized}
            for i, (part, count, form, normalized) in enumerate(accessors)
        ],
    }
    return json.dumps(said).encode()


@pytest.mark.parametrize("kind", [5121, 5123, 5126])
@pytest.mark.parametrize("primitive", [{}, {"material": 0}])
@pytest.mark.parametrize("scale", [1, -1])
def test_a_gltf_files_colours_are_linear_light_and_mirrors_turn_faces(
    tmp_path: Path, kind: int, primitive: dict[str, object], scale: int
) -> None:
    """Of 8 and 16 bits, and floats; next to a material and without one."""
    peak, dtype = {5121: (255, "u1"), 5123: (65535, "<u2"), 5126: (1, "<f4")}[kind]
    light = np.array([[0, 0.25, 1, 1], [1, 0.5, 0, 1], [0.1, 0.2, 0.3, 1], [0, 0, 0, 1]])
    levels = light * peak if peak == 1 else np.rint(light * peak)
    node = {"scale": [scale, 1, 1]}
    (tmp_path / "mesh.gltf").write_bytes(gltf(primitive, node, levels.astype(dtype).tobytes(), kind))
    mesh = as_it_is(tmp_path / "mesh.gltf")
    np.testing.assert_allclose(mesh.colors, 255 * srgb_values(levels[:, :3] / peak), atol=0.51)
    expected = CORNERS * (scale, 1, 1)
    found = mesh.vertices[mesh.faces]
    np.testing.assert_array_equal(found, expected if scale > 0 else expected[:, ::-1])


def test_trimeshs_own_colours_are_srgb(tmp_path: Path) -> None:
    levels = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255], [10, 20, 30, 255]], np.uint8)
    (tmp_path / "mesh.gltf").write_bytes(gltf({}, {}, levels.tobytes(), 5121, "https://github.com/mikedh/trimesh"))
    np.testing.assert_array_equal(as_it_is(tmp_path / "mesh.gltf").colors, levels[:, :3])


@pytest.mark.parametrize("name", ["pcl_ascii.pcd", "pcl_compressed.pcd"])
def test_clouds_that_pcl_has_converted_are_read(name: str) -> None:
    grid = decode_pcd((FOREIGN / name).read_bytes())
    assert grid.points.shape == (3, 4, 3) and np.isnan(grid.points[2, 3]).all()
    np.testing.assert_allclose(grid.points[2, 2], (20, 20, 402), rtol=1e-6)
    assert (grid.texture == (200, 30, 20)).all() and grid.texture.shape == (3, 4, 3)
    np.testing.assert_allclose(grid.properties["sigma_mm"], 0.1, rtol=1e-6)


@pytest.mark.usefixtures("cpu")
def test_a_grid_has_the_cameras_axes_and_may_have_another_unit(tmp_path: Path) -> None:
    path = tmp_path / "grid.pcd"
    path.write_bytes(encode_pcd(tilted_grid(), Heading("g", {}))[".pcd"])
    mesh, known = read_placed(path)
    assert known and mesh.vertices[:, 2].min() == 500
    in_cm = replace(tilted_grid(), points=tilted_grid().points * 100)  # the encoder writes m
    path.write_bytes(encode_pcd(in_cm, Heading("g", {}))[".pcd"])
    np.testing.assert_allclose(read_mesh(path, unit="cm").vertices, mesh.vertices, rtol=1e-6)
    with pytest.raises(FootageError, match="has the camera's axes: leave out others"):
        read_mesh(path, axes="y-up")


@pytest.mark.parametrize(
    ("faces", "expected"),
    [
        (f"{FACES.format(1)}end_header\n{{}}5 0 1 2 3 4\n", [[0, 1, 2], [0, 2, 3], [0, 3, 4]]),
        (f"{FACES.format(3)}end_header\n{{}}4 0 1 2 3\n2 0 1\n3 2 3 4\n", [[0, 1, 2], [0, 2, 3], [2, 3, 4]]),
        (
            f"{FACES.format(1)}property list uchar float texcoord\nproperty int flag\nend_header\n"
            "{}3 0 1 2 6 0 0 1 0 0 1 7\n",
            [[0, 1, 2]],
        ),
        (
            f"{FACES.format(2).replace('face', 'tristrips')}end_header\n{{}}4 0 1 2 3\n4 4 3 2 -1\n",
            [[0, 1, 2], [1, 3, 2], [4, 3, 2]],
        ),
        (
            f"element edge 1\nproperty int a\nproperty int b\n{FACES.format(1)}end_header\n{{}}0 1\n3 0 1 2\n",
            [[0, 1, 2]],
        ),
        ("end_header\n{}", []),
    ],
)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_any_ply_of_polygons_becomes_triangles(
    tmp_path: Path, faces: str, expected: list[list[int]], newline: str
) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes((HEAD + faces.format(POINTS)).replace("\n", newline).encode())
    mesh = as_it_is(path)
    np.testing.assert_array_equal(mesh.vertices, FIVE)
    assert mesh.faces.tolist() == expected


def test_colours_from_0_to_1_are_read(tmp_path: Path) -> None:
    head = HEAD.replace("vertex 5", "vertex 1") + "".join(f"property float {c}\n" for c in ("red", "green", "blue"))
    (tmp_path / "mesh.ply").write_text(f"{head}end_header\n0 0 0 0.2 1 0\n")
    assert as_it_is(tmp_path / "mesh.ply").colors.tolist() == [[51, 255, 0]]


def test_lists_that_reach_beyond_the_file_are_refused(tmp_path: Path) -> None:
    head = HEAD.replace("ascii", "binary_little_endian") + "element face 1\nproperty list uint int vertex_indices\n"
    for count, said in ((3, "truncated"), (2**32 - 1, "entries: it is damaged")):
        body = struct.pack("<15fI", *FIVE.ravel(), count)
        (tmp_path / "mesh.ply").write_bytes(f"{head}end_header\n".encode() + body)
        with pytest.raises(FootageError, match=said):
            read_mesh(tmp_path / "mesh.ply")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("mesh.obj", "v 0 0 0\nv 1 0 0\nv 1e39 1 0\nf 1 2 3\n", "some are not finite"),
        ("mesh.ply", f"{HEAD}end_header\n{POINTS.replace('1', '1e38')}", "some are not finite"),  # in m
        (
            "mesh.wrl",
            "#VRML V2.0 utf8\nIndexedFaceSet { coord Coordinate { point [0 0 0 1 0 0 1 1 0] } "
            "coordIndex [0 1 1e300 -1] }",
            "faces: got corners",
        ),
    ],
)
def test_numbers_beyond_float32_are_refused_without_a_warning(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(FootageError, match=said):
        read_mesh(tmp_path / name, unit="m")


@pytest.mark.usefixtures("cpu")
def test_a_grid_of_any_numbers_is_read_without_a_warning(tmp_path: Path) -> None:
    (tmp_path / "grid.pcd").write_text(
        "FIELDS x y z sigma_mm\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 3\nHEIGHT 2\nDATA ascii\n"
        "1e30 0 1e-9 1e-30\n0 0 1 1e30\n1 1 1 1\n0 1 1 1\n1e30 1e30 1e30 1\n0 0 2 1\n"
    )
    assert np.isfinite(read_mesh(tmp_path / "grid.pcd").vertices).all()


def test_memory_that_is_used_up_is_not_taken_for_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def take_all(*_: object, **__: object) -> None:
        raise MemoryError

    (tmp_path / "mesh.obj").write_text(V)
    monkeypatch.setattr("trimesh.load_scene", take_all)
    with pytest.raises(FootageError, match="stated content does not fit into memory"):
        read_mesh(tmp_path / "mesh.obj")


V = "v 0 0 0\nv 1 0 0\nv 2 1 0\nv 1 2 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f"{V}f 1 2 3 4 5\n", [[0, 1, 2], [0, 2, 3], [0, 3, 4]]),
        ("v 0 0 0\nv 1 0 0\nv 2 1 0\nf -3 -2 -1\nv 1 2 0\nv 0 1 0\nf -3 -2 \\\n -1\n", [[0, 1, 2], [2, 3, 4]]),
        (f"{V}vn 0 0 1\nf 1//1 2//1 3//1\nf -5//-1 -3//-1 -2//-1\n", [[0, 1, 2], [0, 2, 3]]),
        (
            f"{V}vt 0 0\nvt 0 1\nvt 1 1\nvn 0 0 1\nf 1/1/1 2/2/1 3/3/1\nf -5/-3/-1 -3/-2/-1 -2/-1/-1\n",
            [[0, 1, 2], [0, 2, 3]],
        ),
    ],
)
def test_any_obj_of_polygons_becomes_triangles(tmp_path: Path, text: str, expected: list[list[int]]) -> None:
    (tmp_path / "mesh.obj").write_text(text)
    mesh = as_it_is(tmp_path / "mesh.obj")
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], FIVE[expected])


def test_a_binary_stl_may_begin_as_a_text(tmp_path: Path) -> None:
    content = (FOREIGN / "meshlab.stl").read_bytes()
    (tmp_path / "mesh.stl").write_bytes(b"solid from a CAD program".ljust(80) + content[80:])
    mesh = as_it_is(tmp_path / "mesh.stl")
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], CORNERS)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb", ".wrl"])
@pytest.mark.parametrize("unit", ["mm", "rad"])
def test_our_own_say_how_they_lie(tmp_path: Path, mesh: Mesh, suffix: str, unit: str) -> None:
    """Also one whose axes are not those that its format usually has here."""
    ours = replace(mesh, unit=unit, properties={})
    write_mesh(ours, tmp_path / f"mesh{suffix}")
    read, known = read_placed(tmp_path / f"mesh{suffix}")
    assert known and read.unit == unit
    np.testing.assert_allclose(read.vertices[read.faces], mesh.vertices[mesh.faces], rtol=1e-5, atol=1e-4)
    if unit == "mm" and suffix in (".ply", ".obj", ".stl"):
        form = FORMATS[suffix[1:]]
        turned = replace(form, axes=FORMATS["pcd"].axes, unit="m")
        (tmp_path / f"turned{suffix}").write_bytes(_bytes_of(encode_as(turned, ours, "turned")[suffix]))
        read, known = read_placed(tmp_path / f"turned{suffix}")
        assert known
        np.testing.assert_allclose(read.vertices[read.faces], mesh.vertices[mesh.faces], rtol=1e-5, atol=1e-3)


def _bytes_of(content: Content) -> bytes:
    file = io.BytesIO()
    content(file) if callable(content) else file.write(content)
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "known"), [("meshlab.ply", False), ("meshlab.stl", False), ("meshlab.obj", False), ("trimesh.glb", True)]
)
def test_other_programs_do_not_say_it_but_by_a_standard(name: str, known: bool) -> None:
    assert read_placed(FOREIGN / name)[1] is known
    assert read_placed(FOREIGN / name, axes="y-up")[1] is known
    assert read_placed(FOREIGN / name, axes="y-up", unit="mm")[1]


@pytest.mark.parametrize(
    ("axes", "unit", "expected"),
    [
        ("camera", "mm", (0, 2, 3)),
        ("y-up", "m", (0, -2000, -3000)),
        ("z-up", "cm", (0, -30, 20)),
        ("camera", "in", (0, 50.8, 76.2)),
    ],
)
def test_axes_and_unit_are_taken_as_they_are_given(axes: str, unit: str, expected: tuple[float, ...]) -> None:
    for name in ("meshlab.ply", "meshlab.stl", "trimesh.glb"):
        mesh = read_mesh(FOREIGN / name, axes=axes, unit=unit)
        np.testing.assert_allclose(mesh.vertices[mesh.faces][1, 2], expected, rtol=1e-6, err_msg=name)
