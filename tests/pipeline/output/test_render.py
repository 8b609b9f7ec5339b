"""Pictures of meshes: what they show where the machine can draw, and what is said where it cannot."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.missing import skip_but_fail_in_ci

from pipeline.errors import OutputError, RenderError
from pipeline.output import render
from pipeline.output.mesh import Mesh
from pipeline.output.render import render_mesh

SIZE = (240, 180)


def dome(unit: Any = "mm", colors: bool = True) -> Mesh:
    """Return a half ball of 50 mm that bulges towards the camera: red on the left, blue on the right, green below."""
    polar, around = np.meshgrid(np.linspace(0.01, np.pi / 2, 40), np.linspace(0, 2 * np.pi, 80))
    x, y = 50 * np.sin(polar) * np.cos(around), 50 * np.sin(polar) * np.sin(around)
    vertices = np.stack([x, y, 400 - 50 * np.cos(polar)], axis=-1).reshape(-1, 3).astype(np.float32)
    first = np.arange(80 * 40).reshape(80, 40)[:-1, :-1].reshape(-1, 1)
    faces = (first + np.array([[[0, 40, 1]], [[1, 40, 41]]], np.int32)).reshape(-1, 3).astype(np.int32)
    painted = np.stack([vertices[:, 0] < 0, vertices[:, 1] > 0, vertices[:, 0] > 0], axis=1) * np.uint8(255)
    return Mesh(vertices, faces, painted if colors else None, unit=unit)


def white(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces, np.full(mesh.vertices.shape, 230, np.uint8))


def draw(mesh: Mesh, folder: Path, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture, (H, W, 3) RGB, and which pixels differ from the background at the left edge."""
    render_mesh(mesh, folder / "Büste.png", size_px=SIZE, **options)
    assert [path.name for path in folder.iterdir()] == ["Büste.png"]
    picture = cv2.imdecode(np.fromfile(folder / "Büste.png", np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    return picture, abs(picture - picture[:, :1]).max(axis=-1) > 8


@pytest.fixture(scope="module")
def can_draw(tmp_path_factory: pytest.TempPathFactory) -> None:
    try:
        render_mesh(dome(), tmp_path_factory.mktemp("probe") / "probe.png", size_px=SIZE)
    except RenderError as error:
        skip_but_fail_in_ci(f"no usable OpenGL: {error}")


@pytest.mark.usefixtures("can_draw")
def test_a_dome_fills_the_picture_and_is_lit_from_the_upper_left(tmp_path: Path) -> None:
    picture, shown = draw(white(dome()), tmp_path, view="front")
    assert picture.shape == (SIZE[1], SIZE[0], 3)
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert 0.85 * SIZE[1] < height < SIZE[1]
    assert abs(width - height) <= 3
    assert shown.sum() == pytest.approx(np.pi / 4 * height * width, rel=0.05)
    (y, x), reach = (SIZE[1] // 2, SIZE[0] // 2), height // 3
    brightness = picture.sum(axis=-1)
    assert brightness[y - reach // 2, x - reach // 2] > brightness[y, x] > brightness[y + reach, x + reach]


@pytest.mark.usefixtures("can_draw")
def test_the_view_is_the_cameras(tmp_path: Path) -> None:
    picture, _ = draw(dome(), tmp_path, view="front")
    (y, x), reach = (SIZE[1] // 2, SIZE[0] // 2), SIZE[1] // 4
    left, right, below = picture[y - reach, x - reach], picture[y - reach, x + reach], picture[y + reach, x]
    assert left[0] > left[2] + 80, "red on the left"
    assert right[2] > right[0] + 80, "blue on the right"
    assert below[1] > picture[y - reach, x, 1] + 80, "green below"


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize("unit", ["mm", pytest.param("rad", marks=pytest.mark.long)])
def test_without_colors_depth_is_colored(tmp_path: Path, unit: Any) -> None:
    picture, shown = draw(dome(unit, colors=False), tmp_path)
    colors = picture[shown]
    assert 0.25 < shown.mean() < 0.9
    assert np.ptp(colors[:, 0] - colors[:, 2]) > 100, "from blue to red"


@pytest.mark.long
@pytest.mark.usefixtures("can_draw")
def test_a_dead_screen_does_not_matter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", "203.0.113.1:7")  # an address that never answers
    _, shown = draw(dome(), tmp_path)
    assert shown.any()


@pytest.mark.long
@pytest.mark.usefixtures("can_draw")
def test_a_namesake_in_the_current_folder_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pipeline.py").write_text("raise SystemExit('the wrong one')")
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    draw(dome(), tmp_path / "out")


@pytest.mark.parametrize(
    ("program", "said"),
    [
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri",
        ),
        ("raise SystemExit('libGL.so.1: cannot open shared object file')", "libosmesa6"),
        ("raise SystemExit(0)", "OpenGL"),
        ("raise ValueError('the moon is in the way')", "^cannot draw: ValueError: the moon is in the way$"),
    ],
)
def test_a_child_that_dies_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, said: str
) -> None:
    monkeypatch.setattr(render, "_COMMAND", [sys.executable, "-c", program])
    with pytest.raises(RenderError, match=said) as caught:
        render_mesh(dome(), tmp_path / "picture.png")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_child_that_hangs_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "_COMMAND", [sys.executable, "-c", "import time; time.sleep(60)"])
    with pytest.raises(RenderError, match=r"more than 0\.5 s: .*libosmesa6"):
        render_mesh(dome(), tmp_path / "picture.png", timeout_s=0.5)


def test_an_empty_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RenderError, match="mesh is empty"):
        render_mesh(Mesh(dome().vertices, np.empty((0, 3), np.int32)), tmp_path / "picture.png")


def test_an_unknown_view_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'above', expected one of three-quarter, front"):
        render_mesh(dome(), tmp_path / "picture.png", view="above")  # type: ignore[arg-type]


def test_a_missing_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "_COMMAND", [sys.executable, "-c", "open('picture.png', 'x')"])
    with pytest.raises(OutputError, match="create the folder first"):
        render_mesh(dome(), tmp_path / "none" / "picture.png")


def test_importing_does_not_load_the_drawing_library() -> None:
    check = (
        "import sys, pipeline.output.render; raise SystemExit('pyvista' in sys.modules or 'vtkmodules' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", check], check=True)
