"""Images of meshes, drawn without a screen.

The drawing library ends the whole process where the machine has no graphics library, so it runs in a child process.
"""

import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from pipeline.errors import RenderError
from pipeline.files import write_atomically
from pipeline.output.mesh import Mesh, vertex_normals
from pipeline.output.mesh_files import read_mesh, write_mesh
from pipeline.output.range_image import depth_colors, write_png

View = Literal["three-quarter", "front"]

# From the object to the eye, camera frame: before it, and for the relief to show also to its upper left.
VIEWS = {"front": (0.0, 0.0, -1.0), "three-quarter": (-0.55, -0.3, -1.0)}
_FIELD_OF_VIEW_DEG = 24.0  # a narrow one, so that faces keep their proportions
_MARGIN = 1.06
# Key, fill and head light: place as seen from the eye (right, up, towards it) and intensity.
_LIGHTS = (((-1.0, 1.2, 1.0), 0.7), ((1.2, 0.2, 1.0), 0.3), ((0.0, 0.0, 1.0), 0.3))
# The child sees the modules that we see, and never those of the folder that we happen to be in.
_COMMAND = [sys.executable, "-P", "-m", "pipeline.output.render"]
_GRAPHICS_CURE = (
    "on Debian or Ubuntu run 'apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri' or 'apt-get install libosmesa6', "
    "elsewhere install a working OpenGL driver"
)
# The last line of a traceback names the error's class before its message.
_OUR_ERRORS = re.compile(r"^(pipeline|tikernels)\.errors\.\w+: ")
_GRAPHICS_WORDS = ("opengl", "libgl", "egl", "glx", "osmesa", "x server", "shared object")


def render_mesh(
    mesh: Mesh,
    path: str | Path,
    *,
    view: View = "three-quarter",
    size_px: tuple[int, int] = (1280, 960),
    timeout_s: float = 120.0,
) -> None:
    """Draw a mesh off screen into a PNG file.

    Parameters
    ----------
    mesh : Mesh
        What to draw, in its colours, or coloured by depth if it has none.
    path : str or Path
        The PNG file.
    view : {"three-quarter", "front"}
        From where: the camera's side, upright, from its upper left or straight on.
    size_px : (int, int)
        Width and height of the image in px.
    timeout_s : float
        Time after which drawing is given up, s.

    Raises
    ------
    RenderError
        If the mesh is empty, or the machine cannot draw.
    OutputError
        If the file cannot be written.

    Notes
    -----
    A mesh in rad has no true proportions: its depth is scaled until the relief shows.
    """
    if view not in get_args(View):
        raise ValueError(f"view: got {view!r}, expected one of {', '.join(get_args(View))}")
    if len(mesh.faces) == 0:
        raise RenderError("the mesh is empty: it has no faces to draw")
    with tempfile.TemporaryDirectory() as folder:
        write_mesh(mesh, Path(folder, "mesh.ply"))
        draw_apart([*_COMMAND, "mesh.ply", "picture.png", view, *map(str, size_px)], folder, "picture.png", timeout_s)
        write_atomically(path, Path(folder, "picture.png").read_bytes())


def draw_apart(
    command: list[str],
    folder: str,
    made: str,
    timeout_s: float,
    tell: Callable[[str], None] = lambda _: None,
) -> None:
    """Draw in a child process; what goes wrong there becomes one line here.

    Parameters
    ----------
    command : list of str
        What to run, in `folder`.
    folder : str
        Where.
    made : str
        The file there that shows that it has succeeded.
    timeout_s : float
        Time without a line from it after which it is given up, s.
    tell : callable
        Is given each line that it prints.

    Raises
    ------
    RenderError
        It cannot draw.
    """
    # Off screen needs no X server, and a dead one would be waited for.
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment["PYTHONPATH"] = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)
    # A graphics card or its stand-in first; OSMesa is only found by name where it is alone.
    for window in ({}, {"VTK_DEFAULT_OPENGL_WINDOW": "vtkOSOpenGLRenderWindow"}):
        code, errors = _listen(command, folder, environment | window, timeout_s, tell)
        if code == 0 and Path(folder, made).exists():
            return
        last_line = (errors.strip().splitlines() or [""])[-1]
        crashed = code not in (0, 1)
        if last_line and not crashed and not any(word in last_line.lower() for word in _GRAPHICS_WORDS):
            raise RenderError(f"cannot draw: {_OUR_ERRORS.sub('', last_line)}")
    raise RenderError(f"cannot draw, the graphics library (OpenGL) is missing or broken: {_GRAPHICS_CURE}")


def _listen(
    command: list[str], folder: str, environment: dict[str, str], timeout_s: float, tell: Callable[[str], None]
) -> tuple[int, str]:
    """Run a child to its end, and return its exit code and what it wrote to standard error."""
    with tempfile.TemporaryFile() as errors:
        try:
            child = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=errors)
        except OSError as error:
            raise RenderError(f"cannot start {command[0]} to draw: {error.strerror}") from error
        lines: queue.Queue[bytes] = queue.Queue()

        def read(output: IO[bytes]) -> None:
            for line in output:
                lines.put(line)
            lines.put(b"")

        with child:
            reader = threading.Thread(target=read, args=(child.stdout,), daemon=True)
            reader.start()
            try:
                while line := lines.get(timeout=timeout_s):
                    tell(line.decode(errors="replace").strip())
                code = child.wait(timeout_s)
            except (queue.Empty, subprocess.TimeoutExpired) as error:
                raise RenderError(f"drawing took more than {timeout_s:g} s: {_GRAPHICS_CURE}") from error
            finally:
                child.kill()  # does nothing to one that has ended
                reader.join()
        errors.seek(0)
        return code, errors.read().decode(errors="replace")


class Renderer:
    """A lit surface off screen; only for a child process.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of its images.
    """

    def __init__(self, size_px: tuple[int, int]) -> None:
        import pyvista  # slow to import, and only the child may draw

        self._pyvista, self.size_px = pyvista, size_px
        self._plotter = pyvista.Plotter(off_screen=True, window_size=list(size_px), lighting="none")
        self._plotter.set_background("#1d2127", top="#3a414b")
        for position, intensity in _LIGHTS:
            self._plotter.add_light(pyvista.Light(position=position, intensity=intensity, light_type="camera light"))
        self._plotter.enable_anti_aliasing("ssaa")

    def show(
        self,
        vertices: npt.NDArray[np.float32],
        faces: npt.NDArray[np.int32],
        colors: npt.NDArray[np.uint8],
        normals: npt.NDArray[np.float32] | None = None,
    ) -> None:
        """Put a surface on it, in place of the one before; without normals it gets those of its triangles."""
        surface = self._pyvista.PolyData.from_regular_faces(vertices, faces)
        surface.point_data["normals"] = vertex_normals(Mesh(vertices, faces, normals=normals))
        surface.point_data.active_normals_name = "normals"
        surface.point_data["colors"] = colors
        look = {"specular": 0.15, "specular_power": 20, "ambient": 0.05}
        self._plotter.add_mesh(
            surface, scalars="colors", rgb=True, name="surface", reset_camera=False, render=False, **look
        )

    def aim(self, points: npt.NDArray[np.floating], back: tuple[float, float, float]) -> None:
        """Look against a direction, so that all points just fill the image."""
        _aim(self._plotter.camera, points, back, self.size_px)

    def image(self) -> npt.NDArray[np.uint8]:
        """Return what is seen, (H, W, 3) RGB."""
        self._plotter.render()  # a screenshot alone is of what was rendered last
        return np.asarray(self._plotter.screenshot(return_img=True))


def _draw(mesh: Mesh, path: str, view: str, size_px: tuple[int, int]) -> None:
    vertices = proportioned(mesh)
    depth = vertices[:, 2:]
    colors = depth_colors(depth, np.ones(depth.shape, bool))[:, 0] if mesh.colors is None else mesh.colors
    renderer = Renderer(size_px)
    # Relief that is stretched has other normals.
    renderer.show(vertices, mesh.faces, colors, mesh.normals if mesh.unit == "mm" else None)
    renderer.aim(vertices[mesh.faces].reshape(-1, 3), VIEWS[view])
    write_png(path, renderer.image())


def proportioned(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Return the vertices in mm, or in px with the depth scaled to a third of the width."""
    if mesh.unit == "mm":
        return mesh.vertices
    low, high = np.percentile(mesh.vertices[:, 2], (1, 99))
    width = np.ptp(mesh.vertices[:, :2], axis=0).max()
    return mesh.vertices * np.array([1, 1, 0.33 * width / max(high - low, 1e-6)], np.float32)


def _aim(
    camera: Any, points: npt.NDArray[np.floating], direction: tuple[float, float, float], size_px: tuple[int, int]
) -> None:
    """Place a camera so that all points just fill its image."""
    back = np.array(direction) / np.linalg.norm(direction)
    right = np.cross((0, 1, 0), -back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(-back, right), back])
    placed = points @ axes.T  # right, down, towards the eye
    middle = (placed.min(axis=0) + placed.max(axis=0)) / 2
    half_height = np.tan(np.radians(_FIELD_OF_VIEW_DEG / 2))
    half_sizes = half_height * np.array([size_px[0] / size_px[1], 1])
    offsets = placed - middle
    distance = (np.abs(offsets[:, :2]) / half_sizes * _MARGIN + offsets[:, 2:]).max()
    camera.focal_point = middle @ axes
    camera.position = middle @ axes + distance * back
    camera.up = (0, -1, 0)
    camera.view_angle = _FIELD_OF_VIEW_DEG
    near, far = distance - offsets[:, 2].max(), distance - offsets[:, 2].min()
    camera.clipping_range = (0.9 * near, 1.1 * far)


if __name__ == "__main__":
    mesh_path, image_path, chosen_view, width, height = sys.argv[1:]
    _draw(read_mesh(mesh_path), image_path, chosen_view, (int(width), int(height)))
