"""Surfaces to draw, and whether this machine can."""

import atexit
import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from support.missing import skip_but_fail_in_ci

from pipeline.errors import RenderError
from pipeline.output.mesh import Mesh
from pipeline.output.pictures import drawing_process
from pipeline.output.pictures.drawing_process import PictureOptions
from pipeline.output.render import render_mesh

SIZE = (240, 180)
#: What starts a drawing process of its own.
DRAWING_PROCESS = drawing_process.COMMAND


def dome(unit: Any = "mm", colors: bool = True, at_mm: float = 400.0, sigma_mm: float | None = None) -> Mesh:
    """Return a half ball of 50 mm that bulges towards the camera: red on the left, blue on the right, green below."""
    polar, around = np.meshgrid(np.linspace(1e-4, np.pi / 2, 40), np.linspace(0, 2 * np.pi, 80))
    x, y = 50 * np.sin(polar) * np.cos(around), 50 * np.sin(polar) * np.sin(around)
    vertices = np.stack([x, y, at_mm - 50 * np.cos(polar)], axis=-1).reshape(-1, 3).astype(np.float32)
    first = np.arange(80 * 40).reshape(80, 40)[:-1, :-1].reshape(-1, 1)
    faces = (first + np.array([[[0, 40, 1]], [[1, 40, 41]]], np.int32)).reshape(-1, 3).astype(np.int32)
    painted = np.stack([vertices[:, 0] < 0, vertices[:, 1] > 0, vertices[:, 0] > 0], axis=1) * np.uint8(255)
    known = {} if sigma_mm is None else {"sigma_mm": np.full(len(vertices), sigma_mm, np.float32)}
    return Mesh(vertices, faces, painted if colors else None, known, unit=unit)


def walled(mesh: Mesh, wall_mm: float = 600.0) -> Mesh:
    """Return a mesh with a wall of 300 mm behind it."""
    y, x = np.mgrid[-150:151:2, -150:151:2].astype(np.float32)
    wall = np.stack([x, y, np.full_like(x, wall_mm)], axis=-1).reshape(-1, 3)
    first = len(mesh.vertices) + np.arange(x.size).reshape(x.shape)[:-1, :-1].reshape(-1, 1)
    across = x.shape[1]
    faces = first + np.array([[[0, 1, across]], [[1, across + 1, across]]])
    return Mesh(
        np.concatenate([wall[:0], mesh.vertices, wall]),
        np.concatenate([mesh.faces, faces.reshape(-1, 3).astype(np.int32)]),
    )


@cache
def share_drawing_process() -> None:
    """Let one process, which has the drawing library loaded, fork for all pictures that this process has drawn."""
    folder = Path(tempfile.mkdtemp(prefix="drawing-"))
    program = [sys.executable, str(Path(__file__).with_name("drawing_server.py")), str(folder / "socket")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    server = subprocess.Popen(program, env=environment, stdout=subprocess.PIPE, stdin=subprocess.PIPE)
    atexit.register(shutil.rmtree, folder)
    atexit.register(server.kill)
    assert server.stdout is not None and server.stdout.readline() == b"ready\n"
    drawing_process.COMMAND = ["-I", *program[1:]]


def require_drawing(folder: Path) -> None:
    """Skip the test, but fail in CI, where nothing can be drawn."""
    if hasattr(os, "fork"):
        share_drawing_process()
    try:
        render_mesh(dome(), folder / "probe.png", PictureOptions(size_px=SIZE))
    except RenderError as error:
        skip_but_fail_in_ci(f"no usable OpenGL: {error}")


def read_picture(path: Path) -> np.ndarray:
    """Return a picture, (H, W, 3) RGB, with a sign."""
    return cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def read_film(path: Path) -> tuple[np.ndarray, float]:
    """Return the pictures of a film, (N, H, W, 3) RGB, and how many there are a second."""
    with av.open(str(path)) as container:
        rate = float(container.streams.video[0].average_rate)
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]).astype(int), rate


def shown(picture: np.ndarray) -> np.ndarray:
    """Return which pixels differ from the background at the left edge."""
    return abs(picture - picture[:, :1]).max(axis=-1) > 12
