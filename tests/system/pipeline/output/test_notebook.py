"""What frames, results, meshes and calibrations show: the numbers that are there, and a picture of them."""

import subprocess
import sys

import numpy as np
import pytest
from support.shown_html import Shown
from support.stored_planes import HEIGHT, WIDTH, store

from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.calibration import Uncertainty
from pipeline.output.mesh import Mesh
from pipeline.output.notebook import mesh_surface
from pipeline.output.stored_result import StoredResult
from pipeline.output.surface_mesh import frame_mesh
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

#: Grey level of what was not measured.
HIDDEN = 48


@pytest.fixture(scope="module")
def rig(cpu):
    return simulated_rig((640, 480))


@pytest.fixture(scope="module")
def image(rig):
    return simulate_frame(rig, SimulationSettings(seed=1)).image


@pytest.fixture(scope="module")
def frame(rig, image):
    return Decoder(DecodeSettings(), rig, arch="cpu").decode(image)


def test_a_frame_tells_its_figures(frame):
    shown = Shown(frame._repr_html_())
    figures, depth = shown.figures, frame.range_image[frame.mask]
    assert figures["size"] == "640 x 480 px"
    assert figures["period"] == f"{frame.period_px:.2f} px"
    assert figures["coverage"] == f"{100 * frame.mask.mean():.1f} %"
    low, middle, high = np.percentile(depth, (1, 50, 99))
    assert figures["range, 1 to 99 %"] == f"{low:.4g} to {high:.4g} mm, median {middle:.4g} mm"
    assert 800 < middle < 1000
    assert figures["regions"] == str(frame.region.max())
    assert figures["absolute"] == f"{100 * frame.absolute[frame.mask].mean():.1f} %"
    assert figures["phase sigma, median"] == f"{np.nanmedian(frame.phase_sigma):.3g} rad"
    assert figures["point sigma, median"] == f"{np.nanmedian(frame.point_sigma):.3g} mm"
    assert shown.warnings == []


def test_a_frames_picture_has_all_its_pixels_and_shows_its_holes(frame):
    picture = Shown(frame._repr_html_()).picture
    assert picture.shape == (480, 640, 3)
    hidden = (picture == HIDDEN).all(axis=-1)
    assert (hidden == ~frame.mask).mean() > 0.99
    assert picture[~hidden].std() > 10


def test_a_frame_in_rad_says_what_to_know_of_it(image):
    decoder = Decoder(DecodeSettings(), arch="cpu")
    frame = decoder.decode(image)
    frame.warnings = ("the <b>lamp</b> & the sun",)
    block = frame._repr_html_()
    assert "<b>lamp" not in block
    shown = Shown(block)
    assert shown.warnings == ["the <b>lamp</b> & the sun"]
    assert " rad, median " in shown.figures["range, 1 to 99 %"]
    assert "point sigma, median" not in shown.figures


def test_a_frame_without_fringes(rig):
    with pytest.warns(match="fringe"):
        frame = Decoder(DecodeSettings(), rig, arch="cpu").decode(np.full((480, 640, 3), 90, np.uint8))
    shown = Shown(frame._repr_html_())
    assert shown.figures["period"] == "no fringe was found"
    assert shown.figures["coverage"] == "0.0 %"
    assert shown.figures["absolute"] == "nothing is measured"
    assert shown.warnings == list(frame.warnings) != []
    assert (shown.picture == HIDDEN).all()
    assert frame.to_pyvista().n_points == 0


def test_a_result_shows_its_first_frame(tmp_path):
    result = StoredResult(store(tmp_path / "result.zarr", [400.0, 410.0, None, 420.0], missing=(0, 2)))
    shown = Shown(result._repr_html_())
    assert shown.figures["frames"] == "2 of 3 done"
    assert shown.figures["size"] == f"{WIDTH} x {HEIGHT} px"
    assert "point_sigma" in shown.figures["fields"]
    assert shown.figures["frame 1, range, 1 to 99 %"] == "410 to 410 mm, median 410 mm"
    assert shown.figures["frame 1, coverage"] == f"{100 * (1 - 15 * 20 / (HEIGHT * WIDTH)):.1f} %"
    assert shown.picture.shape == (HEIGHT, WIDTH, 3)
    assert (shown.picture[-1, -1] == HIDDEN).all() and (shown.picture[0, 0] > HIDDEN).all()
    assert shown.warnings == []


def test_a_result_in_rad(tmp_path):
    shown = Shown(StoredResult(store(tmp_path / "result.zarr", [400.0], in_mm=False))._repr_html_())
    assert shown.figures["frame 0, range, 1 to 99 %"] == "4 to 4 rad, median 4 rad"


def test_a_result_that_is_damaged_or_empty_says_so(tmp_path):
    path = store(tmp_path / "result.zarr", [400.0])
    (path / "points" / "c.0.0.0.0").unlink()
    assert any("points is missing" in text for text in Shown(StoredResult(path)._repr_html_()).warnings)
    (path / "done" / "c.0.0").write_bytes(b"{}")
    assert Shown(StoredResult(path)._repr_html_()).warnings == ["no frame is done"]


def test_a_mesh(frame):
    mesh = frame_mesh(frame)
    shown = Shown(mesh._repr_html_())
    assert shown.figures["vertices"] == f"{len(mesh.vertices):,}"
    assert shown.figures["triangles"] == f"{len(mesh.faces):,}"
    low, high = mesh.vertices[:, 2].min(), mesh.vertices[:, 2].max()
    assert shown.figures["z"] == f"{low:.4g} to {high:.4g} mm"
    assert "sigma_mm" in shown.figures["of each vertex"]
    picture = shown.picture
    assert 300 < picture.shape[1] <= 320
    assert picture.shape[0] / picture.shape[1] == pytest.approx(0.76, abs=0.05)
    assert (picture != HIDDEN).any(axis=-1).mean() > 0.9


def test_the_nearest_surface_hides_those_behind_it():
    """A small square that is tilted stands before a large one that is not, whichever was listed first."""
    y, x = (part.ravel().astype(np.float32) for part in np.mgrid[:40, :40])
    inside = (abs(x - 20) < 10) & (abs(y - 20) < 10)
    front = np.column_stack([x, y, 500 - 2 * x])[inside], (-0.9, 0.0, -0.44)
    wall = np.column_stack([x, y, np.full_like(x, 900)]), (0.0, 0.0, -1.0)
    corner = np.array([[0, 1, 2]], np.int32)
    pictures = []
    for parts in ((front, wall), (wall, front)):
        vertices = np.concatenate([points for points, _ in parts]).astype(np.float32)
        normals = np.concatenate([np.tile(normal, (len(points), 1)) for points, normal in parts]).astype(np.float32)
        pictures.append(Shown(Mesh(vertices, corner, normals=normals)._repr_html_()).picture)
    np.testing.assert_array_equal(*pictures)
    height, width, _ = pictures[0].shape
    middle, rim = pictures[0][height // 2, width // 2], pictures[0][height // 2, width // 10]
    assert (middle != rim).all()
    assert (rim != HIDDEN).all()


def test_a_mesh_without_triangles_and_one_in_rad():
    empty = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    shown = Shown(empty._repr_html_())
    assert shown.figures["vertices"] == "0" and shown.pictures == []
    corners = np.array([[0, 0, 1], [9, 0, 2], [0, 9, 3]], np.float32)
    shown = Shown(Mesh(corners, np.array([[0, 1, 2]], np.int32), unit="rad")._repr_html_())
    assert shown.warnings == ["not metric: z is relative phase in rad, x and y are px"]
    assert shown.figures["x"] == "0 to 9 px" and shown.figures["z"] == "1 to 3 rad"


def test_a_mesh_on_one_line_has_a_picture():
    corners = np.array([[0, 0, 1], [5, 0, 2], [9, 0, 3]], np.float32)
    assert Shown(Mesh(corners, np.array([[0, 1, 2]], np.int32))._repr_html_()).picture.shape[1] <= 320


def test_a_calibration(rig):
    known = rig.model_copy(
        update={
            "depth_range_mm": (500.0, 900.0),
            "scale_proof": "baseline",
            "uncertainty": Uncertainty(reprojection_px=(0.081, 0.102), depth_bias_mm=0.0512),
        }
    )
    shown = Shown(known._repr_html_())
    fx, fy = rig.camera.matrix[0, 0], rig.camera.matrix[1, 1]
    assert shown.figures["camera"] == f"640 x 480 px, focal lengths {fx:.1f}, {fy:.1f} px"
    assert shown.figures["projector"].startswith("1024 x 768 px")
    assert shown.figures["baseline"] == f"{np.linalg.norm(rig.translation_mm):.1f} mm"
    assert shown.figures["pattern"] == "horizontal, 17.4545 px a cycle, no code"
    assert shown.figures["depth range"] == "500 to 900 mm"
    assert shown.figures["scale"] == "proved by a baseline"
    assert shown.figures["reprojection, RMS"] == "camera 0.081 px, projector 0.102 px"
    assert shown.figures["depth, sigma by the calibration"] == "0.0512 mm"
    assert shown.warnings == []


def test_a_calibration_of_the_light_alone():
    shown = Shown(Calibration(crosstalk_matrix=np.eye(3))._repr_html_())
    assert shown.figures == {"crosstalk": "measured", "response": "not measured"}
    assert shown.warnings == ["no geometry: frames are decoded to phases, in rad"]


def test_a_frame_as_pyvistas_data(frame):
    surface, mesh = frame.to_pyvista(), frame_mesh(frame)
    np.testing.assert_array_equal(surface.points, mesh.vertices)
    np.testing.assert_array_equal(surface.regular_faces, mesh.faces)
    np.testing.assert_array_equal(surface.point_data["sigma_mm"], mesh.properties["sigma_mm"])
    assert set(surface.point_data.keys()) == {*mesh.properties, "colors", "flags", "Normals"}
    np.testing.assert_array_equal(surface.point_data.active_normals, mesh.normals)
    assert list(surface.field_data["unit"]) == ["mm"]


def test_a_bare_mesh_as_pyvistas_data():
    corners = np.array([[0, 0, 1], [9, 0, 2], [0, 9, 3]], np.float32)
    surface = mesh_surface(Mesh(corners, np.array([[0, 1, 2]], np.int32), unit="rad"))
    assert surface.n_cells == 1 and surface.point_data.keys() == []
    assert list(surface.field_data["unit"]) == ["rad"]


def test_showing_starts_no_vtk(tmp_path):
    """It dies where there is no GL; and the methods are there however a user imports the decoder."""
    program = (
        "import sys\n"
        "import numpy as np\n"
        "from pipeline import Decoder\n"
        "from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig\n"
        "rig = simulated_rig((128, 96))\n"
        "frame = Decoder(calibration=rig, arch='cpu').decode(simulate_frame(rig, SimulationSettings()).image)\n"
        "assert frame._repr_html_().startswith('<div') and rig._repr_html_().startswith('<div')\n"
        "assert not {'pyvista', 'vtkmodules', 'xarray', 'matplotlib'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=200)
