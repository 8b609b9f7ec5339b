"""Every format, read back by other projects' programs: nothing lies on its head, is too large, or faces away."""

import io
import re
import shutil
import subprocess
from pathlib import Path

import meshio
import numpy as np
import pytest
import pyvista
import trimesh
from support.missing import import_but_fail_in_ci, skip_but_fail_in_ci
from support.tilted_sheets import BLUE, HEIGHT, RED, WIDTH, tilted_grid, tilted_mesh
from vtkmodules.util import numpy_support
from vtkmodules.vtkIOImport import vtkVRMLImporter

from pipeline.output.formats.table import FORMATS, MESH_FORMATS, encode_as
from pipeline.output.mesh_files import read_mesh, write_mesh

pytestmark = pytest.mark.usefixtures("cpu")

#: By the users of each format: which coordinate goes up, which one points to the camera, and the unit in mm.
UPRIGHT = {"ply": "+y +z 1", "obj": "+y +z 1", "stl": "+z -y 1", "glb": "+y +z 1000"}
UPRIGHT["wrl"] = "+y +z 1000"


def check(kind, points, faces, colors=None):
    """Assert that triangles are the sheet: red above and nearer to the camera, seen from their front."""
    points = np.asarray(points, float)
    up, near, unit = UPRIGHT[kind].split()
    points = points * float(unit)

    def along(way):
        return points[:, "xyz".index(way[1])] * (1 if way[0] == "+" else -1)

    np.testing.assert_allclose([along(up).min(), along(up).max()], [-26, 20], atol=0.01)
    np.testing.assert_allclose([along(near).min(), along(near).max()], [-546, -500], atol=0.01)
    np.testing.assert_allclose([points[:, 0].min(), points[:, 0].max()], [-8, 54], atol=0.01)
    assert np.corrcoef(along(up), along(near))[0, 1] > 0.9  # what is above is nearer
    corners = points[np.asarray(faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, "xyz".index(near[1])] * (1 if near[0] == "+" else -1) > 0).all()
    if colors is not None:
        red = np.abs(np.asarray(colors)[:, :3].astype(int) - RED).max(axis=1) <= 1
        blue = np.abs(np.asarray(colors)[:, :3].astype(int) - BLUE).max(axis=1) <= 1
        assert red.sum() == WIDTH * HEIGHT / 2 and (red | blue).mean() == 1
        assert along(up)[red].min() > along(up)[blue].max()


@pytest.fixture
def written(tmp_path):
    """Write the sheet in a format, and return the file."""

    def write(kind):
        write_mesh(tilted_mesh(), tmp_path / f"sheet of paper.{kind}")
        return tmp_path / f"sheet of paper.{kind}"

    return write


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "glb"])
def test_trimesh_sees_it_upright(written, kind):
    solid = trimesh.load_scene(written(kind), process=False).to_mesh()
    if kind == "stl":
        check(kind, solid.vertices, solid.faces)
        return
    visual = solid.visual.to_color() if solid.visual.kind == "texture" else solid.visual
    assert solid.visual.kind == ("vertex" if kind == "ply" else "texture")
    check(kind, solid.vertices, solid.faces, visual.vertex_colors)


@pytest.mark.parametrize("kind", ["ply", "obj", "stl"])
def test_meshio_sees_it_upright(written, kind):
    read = meshio.read(written(kind))
    check(kind, read.points, read.cells_dict["triangle"])
    if kind == "ply":
        assert {"nx", "red", "flags", "sigma_mm", "confidence"} <= read.point_data.keys()


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "glb"])
def test_pyvista_sees_it_upright(written, kind):
    read = pyvista.read(written(kind))
    surface = read.combine().extract_surface(algorithm="dataset_surface") if kind == "glb" else read
    check(kind, surface.points, surface.regular_faces)
    if kind == "obj":
        picture = pyvista.read(written(kind).with_suffix(".png"))
        assert picture.dimensions[:2] == (WIDTH, HEIGHT)
        # pyvista's v goes up: what is above lies in the upper half of the picture.
        v = surface.active_texture_coordinates[:, 1]
        assert np.corrcoef(v, surface.points[:, 1])[0, 1] > 0.99


def test_vtk_sees_vrml_upright(written):
    importer = vtkVRMLImporter()
    importer.SetFileName(str(written("wrl")))
    importer.Update()
    actors = importer.GetRenderer().GetActors()
    assert actors.GetNumberOfItems() == 1
    shape = actors.GetLastActor().GetMapper().GetInput()
    points = numpy_support.vtk_to_numpy(shape.GetPoints().GetData())
    faces = numpy_support.vtk_to_numpy(shape.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    check("wrl", points, faces)


def test_a_grid_of_points_becomes_the_sheet_again(tmp_path):
    (tmp_path / "grid.pcd").write_bytes(encode_as(FORMATS["pcd"], tilted_grid(), "grid")[".pcd"])
    read = read_mesh(tmp_path / "grid.pcd")
    assert len(read.vertices) > 0.9 * WIDTH * HEIGHT and {"sigma_mm"} <= read.properties.keys()
    write_mesh(read, tmp_path / "grid.ply")
    there = trimesh.load_scene(tmp_path / "grid.ply", process=False).to_mesh()
    np.testing.assert_allclose(there.vertices[:, 1].max(), 20, atol=0.5)
    np.testing.assert_allclose(there.vertices[:, 2].max(), -500, atol=0.5)


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "glb"])
def test_open3d_sees_it_upright(written, kind):
    open3d = import_but_fail_in_ci("open3d")
    read = open3d.io.read_triangle_mesh(str(written(kind)), enable_post_processing=True)
    colors = np.asarray(read.vertex_colors) * 255 if kind == "ply" else None
    check(kind, np.asarray(read.vertices), np.asarray(read.triangles), None if colors is None else colors.round())
    if kind in ("obj", "glb"):
        assert np.asarray(read.textures[-1]).shape[:2] == (HEIGHT, WIDTH)


def test_open3d_reads_points(tmp_path):
    open3d = import_but_fail_in_ci("open3d")
    grid = tilted_grid()
    (tmp_path / "grid.pcd").write_bytes(encode_as(FORMATS["pcd"], grid, "grid")[".pcd"])
    cloud = open3d.io.read_point_cloud(str(tmp_path / "grid.pcd"), remove_nan_points=False)
    np.testing.assert_allclose(np.asarray(cloud.points), grid.points.reshape(-1, 3) / 1000, rtol=1e-5)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255, grid.texture.reshape(-1, 3), atol=0.6)


def test_pcls_own_tools_read_points(tmp_path):
    tool = shutil.which("pcl_convert_pcd_ascii_binary")
    if tool is None:
        skip_but_fail_in_ci("pcl_convert_pcd_ascii_binary is not there: apt install pcl-tools")
    grid = tilted_grid()
    (tmp_path / "grid.pcd").write_bytes(encode_as(FORMATS["pcd"], grid, "grid")[".pcd"])
    command = [tool, "grid.pcd", "text.pcd", "0"]
    subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=60, check=True)
    head, _, rows = (tmp_path / "text.pcd").read_text().partition("DATA ascii\n")
    assert f"WIDTH {WIDTH}\nHEIGHT {HEIGHT}\n" in head and "FIELDS x y z rgb sigma_mm\n" in head
    values = np.loadtxt(rows.splitlines(), dtype=np.float64).reshape(HEIGHT, WIDTH, -1)
    np.testing.assert_allclose(values[..., :3], grid.points / 1000, rtol=1e-5)  # NaN where it is NaN
    np.testing.assert_allclose(values[..., 4], grid.properties["sigma_mm"], rtol=1e-5)


def whole(content):
    """Return what a file holds."""
    if not callable(content):
        return bytes(content)
    file = io.BytesIO()
    content(file)
    return file.getvalue()


@pytest.mark.parametrize("kind", ["ply", "obj", "glb", "wrl", "pcd", "png", "tiff"])
def test_each_says_how_it_was_made(kind):
    form = FORMATS[kind]
    shape = tilted_mesh() if form.encode_mesh is not None else tilted_grid()
    content = whole(encode_as(form, shape, "name", 546)[f".{kind}"])
    for value in ("colorphase 1.2.3", "ab" * 32, "x right, y", "0.250000", "stripes"):
        assert value.encode() in content, value
    assert re.search(b"unit.{1,5}" + form.unit.encode(), content)


def test_an_stl_says_what_80_bytes_hold():
    content = bytes(encode_as(FORMATS["stl"], tilted_mesh(), "name")[".stl"])
    assert content[:80] == b"binary STL; unit mm; axes x right, y away from the camera, z up; software colorp"


def test_ranges_in_rad_are_never_called_metres(mesh):
    for suffix, form in MESH_FORMATS.items():
        content = whole(encode_as(form, type(mesh)(mesh.vertices, mesh.faces, unit="rad"), "name")[suffix])
        assert re.search(b"unit.{1,5}rad", content) and not re.search(b'unit.{1,5}mm?[" ;\n]', content)
        if suffix != ".stl":
            assert b"not metric" in content


def test_the_docs_hold_the_table():
    page = Path(__file__).resolve().parents[5] / "docs" / "formats.md"
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \| (.*?) \| (.*?) \|$", page.read_text(), re.MULTILINE)
    assert rows == [(kind, form.meaning, form.holds, form.unit, form.axes.directions) for kind, form in FORMATS.items()]
