"""Still pictures: what they show where the machine can draw, and what is refused."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.drawn_surfaces import DRAWING_PROCESS, SIZE, dome, read_picture, require_drawing, shown, walled
from support.stored_planes import store

from pipeline.errors import OutputError, RenderError
from pipeline.output.mesh import Mesh
from pipeline.output.pictures import drawing_process
from pipeline.output.pictures.drawing_process import PictureOptions
from pipeline.output.pictures.viewpoint import FIELD_OF_VIEW_DEG, Viewpoint
from pipeline.output.render import buffer_path, render_frame, render_mesh

EMPTY = Mesh(dome().vertices, np.empty((0, 3), np.int32))


@pytest.fixture(scope="module")
def can_draw(tmp_path_factory: pytest.TempPathFactory) -> None:
    require_drawing(tmp_path_factory.mktemp("probe"))


def draw(mesh: Mesh, folder: Path, **options: Any) -> np.ndarray:
    options = {"size_px": SIZE, **options}
    render_mesh(mesh, folder / "Büste.png", PictureOptions(**options))
    assert [path.name for path in folder.iterdir()] == ["Büste.png"]
    return read_picture(folder / "Büste.png")


@pytest.mark.usefixtures("can_draw")
def test_a_dome_fills_the_picture_and_is_lit_from_the_upper_left(tmp_path: Path) -> None:
    picture = draw(dome(), tmp_path, view="front")
    assert picture.shape == (SIZE[1], SIZE[0], 3)
    inside = shown(picture)
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert 0.85 * SIZE[1] < height < SIZE[1]
    assert abs(width - height) <= 3
    assert inside.sum() == pytest.approx(np.pi / 4 * height * width, rel=0.05)
    (y, x), reach = (SIZE[1] // 2, SIZE[0] // 2), height // 3
    brightness = picture.sum(axis=-1)
    assert brightness[y - reach // 2, x - reach // 2] > brightness[y, x] > brightness[y + reach, x + reach]
    assert np.ptp(picture[y, x]) < 30, "grey clay, whatever colours the mesh has"


@pytest.mark.usefixtures("can_draw")
def test_the_view_is_the_cameras(tmp_path: Path) -> None:
    picture = draw(dome(), tmp_path, view="front", colors="texture")
    (y, x), reach = (SIZE[1] // 2, SIZE[0] // 2), SIZE[1] // 4
    left, right, below = picture[y - reach, x - reach], picture[y - reach, x + reach], picture[y + reach, x]
    assert left[0] > left[2] + 80, "red on the left"
    assert right[2] > right[0] + 80, "blue on the right"
    assert below[1] > picture[y - reach, x, 1] + 80, "green below"


@pytest.mark.usefixtures("can_draw")
def test_depth_has_the_limits_of_the_object_before_a_wall(tmp_path: Path) -> None:
    picture = draw(walled(dome()), tmp_path, view="front", colors="depth")
    y, x = SIZE[1] // 2, SIZE[0] // 2
    assert picture[y, x, 2] > picture[y, x, 0] + 50, "the nearest point is blue"
    wall = picture[y, x - 70]
    assert np.ptp(wall) < 8, "the wall is grey"
    row = picture[y]
    assert (row[:, 0] - row[:, 2]).max() > 60, "the dome's rim is red"


@pytest.mark.usefixtures("can_draw")
def test_buffers_are_of_the_same_view(tmp_path: Path) -> None:
    eye = Viewpoint(position=(0, 0, 0), focal_point=(0, 0, 400))
    options = PictureOptions(camera=eye, size_px=SIZE)
    said = render_mesh(dome(), tmp_path / "dome.png", options, buffers=("depth", "normals"))
    assert said.endswith((", EGL", ", OSMesa", ", GLX"))
    depth = cv2.imread(str(buffer_path(tmp_path / "dome.png", "depth")), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.float32 and depth.shape == SIZE[::-1]
    y, x = SIZE[1] // 2, SIZE[0] // 2
    assert depth[y, x] == pytest.approx(350, abs=0.5)
    assert np.isnan(depth[0, 0])
    radius_px = np.sqrt(np.isfinite(depth).sum() / np.pi)
    # The rim, 50 mm wide at 400 mm; nearer parts of the ball stand out by 1 / sqrt(1 - 1/64).
    expected = 50 / np.sqrt(400**2 - 50**2) / np.tan(np.radians(FIELD_OF_VIEW_DEG / 2)) * SIZE[1] / 2
    assert radius_px == pytest.approx(expected, rel=0.02)
    normals = read_picture(buffer_path(tmp_path / "dome.png", "normals")) / 127.5 - 1
    assert normals[y, x] == pytest.approx([0, 0, 1], abs=0.05)
    assert normals[y, x + 40, 0] > 0.3 and normals[y - 40, x, 1] > 0.3, "to the right, and up"


@pytest.mark.usefixtures("can_draw")
def test_the_deviation_from_another_mesh_has_a_sign(tmp_path: Path) -> None:
    # 1 mm nearer on the left than the other one, 1 mm farther on the right.
    mesh = dome()
    moved = mesh.vertices + np.where(mesh.vertices[:, :1] < 0, [[0, 0, -1]], [[0, 0, 1]]).astype(np.float32)
    options = PictureOptions(view="front", size_px=SIZE)
    render_mesh(Mesh(moved, mesh.faces), tmp_path / "moved.png", options, compared=mesh)
    picture = read_picture(tmp_path / "moved.png")
    left, right = picture[SIZE[1] // 2, SIZE[0] // 2 - 20], picture[SIZE[1] // 2, SIZE[0] // 2 + 20]
    assert left[0] > left[2] + 60, "red is before the other mesh"
    assert right[2] > right[0] + 60, "blue is behind it"
    with pytest.raises(RenderError, match="mesh to compare with has 3200 points and no faces"):
        render_mesh(mesh, tmp_path / "moved.png", options, compared=EMPTY)


@pytest.mark.usefixtures("can_draw")
def test_a_frame_of_a_store(tmp_path: Path) -> None:
    path = store(tmp_path / "r.zarr", [400.0, None])
    options = PictureOptions(view="front", colors="sigma", size_px=(320, 240))
    render_frame(path, 0, tmp_path / "frame.png", options)
    picture = read_picture(tmp_path / "frame.png")
    assert shown(picture).mean() > 0.3
    assert (picture[:, 250:] > 200).all(axis=-1).sum() > 30, "numbers in white beside the colour bar"
    with pytest.raises(RenderError, match="frame 1 shows no surface: choose another --frame"):
        render_frame(path, 1, tmp_path / "frame.png", options)


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize("unit", ["mm", "rad"])
def test_a_dead_screen_does_not_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unit: Any) -> None:
    monkeypatch.setenv("DISPLAY", "203.0.113.1:7")  # an address that never answers
    assert 0.25 < shown(draw(dome(unit), tmp_path, colors="depth")).mean() < 0.9


@pytest.mark.usefixtures("can_draw")
def test_a_namesake_in_the_current_folder_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pipeline.py").write_text("raise SystemExit('the wrong one')")
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(drawing_process, "COMMAND", DRAWING_PROCESS)
    draw(dome(), tmp_path / "out")


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize(
    ("mesh", "options", "said"),
    [
        (dome(), {"colors": "sigma"}, "--colors sigma: the mesh holds no sigma_mm: use --colors clay"),
        (dome(colors=False), {"colors": "texture"}, "the mesh has no colours: use --colors clay"),
        (dome("rad"), {"colors": "sphere"}, "needs a mesh in mm: decode with a calibration"),
        (dome("rad"), {"camera": Viewpoint(position=(0, 0, 0), focal_point=(0, 0, 1))}, "a camera in mm needs"),
    ],
)
def test_what_a_mesh_does_not_have(tmp_path: Path, mesh: Mesh, options: Any, said: str) -> None:
    with pytest.raises(RenderError, match=f"^cannot draw: .*{said}"):
        render_mesh(mesh, tmp_path / "picture.png", PictureOptions(size_px=SIZE, **options))
    assert not list(tmp_path.iterdir())


def test_what_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RenderError, match="mesh has 3200 points and no faces: give one of triangles"):
        render_mesh(EMPTY, tmp_path / "picture.png")
    with pytest.raises(RenderError, match="mesh has no point: give another file"):
        render_mesh(Mesh(EMPTY.vertices[:0], EMPTY.faces), tmp_path / "picture.png")
    with pytest.raises(RenderError, match="points of the mesh all lie in one place"):
        render_mesh(replace(dome(), vertices=np.zeros_like(EMPTY.vertices)), tmp_path / "picture.png")
    far = replace(dome(), vertices=np.float32(1e34) * dome().vertices)
    with pytest.raises(RenderError, match=r"mesh to compare with reaches 4e\+36 mm, and 1e\+07 mm is the most"):
        render_mesh(dome(), tmp_path / "picture.png", compared=far)
    with pytest.raises(OutputError, match=r"a still picture, in which no eye moves: name it \.mp4"):
        render_mesh(dome(), tmp_path / "picture.png", PictureOptions(turn_deg=10))
    with pytest.raises(RenderError, match="not in mm"):
        render_mesh(dome(), tmp_path / "picture.png", compared=dome("rad"))
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = "open('picture.png', 'x'); open('done', 'x')"
    monkeypatch.setattr(drawing_process, "COMMAND", ["-c", program])
    with pytest.raises(OutputError, match="create the folder first"):
        render_mesh(dome(), tmp_path / "none" / "picture.png")


def test_importing_does_not_load_the_drawing_library() -> None:
    check = (
        "import sys, pipeline.output.render, pipeline.output.film;"
        "raise SystemExit('pyvista' in sys.modules or 'vtkmodules' in sys.modules or 'matplotlib' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", check], check=True)
