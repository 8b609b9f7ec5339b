"""A surface drawn off screen by VTK, with what all pictures of a film share: colours and their limits, and the eye.

Only for a child process, which ends where there is no graphics library.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import RenderError
from pipeline.output.background import object_vertices
from pipeline.output.mesh import Mesh, vertex_normals
from pipeline.output.pictures.color_meaning import Distance, SurfaceColors
from pipeline.output.pictures.drawing_process import PictureOptions
from pipeline.output.pictures.picture_overlay import PictureOverlay
from pipeline.output.pictures.viewpoint import FIELD_OF_VIEW_DEG, VIEWS, Viewpoint, fitted_viewpoint, lit_colors, turn

Ground = tuple[tuple[int, int, int], tuple[int, int, int]]
#: RGB of what is behind a surface, above and below.
GROUND: Ground = ((58, 65, 75), (29, 33, 39))
BLACK: Ground = ((0, 0, 0), (0, 0, 0))
WHITE: Ground = ((255, 255, 255), (255, 255, 255))
_WINDOWS = {"vtkEGLRenderWindow": "EGL", "vtkOSOpenGLRenderWindow": "OSMesa", "vtkXOpenGLRenderWindow": "GLX"}

# Share of the points on each side that may be stray ones, and does not move the eye away.
_STRAY = 0.002
# Places of an eye that moves, and points, that determine how far away it must be.
_TURNS, _TURNED_POINTS = 73, 2000
# Part of its width that the depth of a surface in rad is scaled to, for the relief to show.
_RELIEF = 0.33


class SurfaceRenderer:
    """Draws one surface at a time, in colours that are ready.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of its images.
    samples : int
        By how many rows and columns a pixel is made up, so that edges are smooth; 1: none are mixed, for buffers.
    ground : pair of RGB
        What is behind the surface.
    """

    def __init__(self, size_px: tuple[int, int], samples: int = 2, *, ground: Ground = GROUND) -> None:
        import pyvista  # slow to import, and only the child may draw
        from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

        self._pyvista, self._size_px, self._samples = pyvista, size_px, samples
        self._sides_px = [samples * side for side in size_px]
        self._plotter = pyvista.Plotter(off_screen=True, window_size=self._sides_px, lighting="none")
        self._plotter.disable_anti_aliasing()  # its own costs three times as much
        # The surface alone is drawn, with its part in every pixel: the library's ground costs a sixth of a picture.
        self._plotter.set_background("black")
        self._plotter.renderer.SetBackgroundAlpha(0.0)
        self._plotter.render_window.SetAlphaBitPlanes(True)
        self._pixels = vtkUnsignedCharArray()
        width, height = size_px
        above, below = np.array(ground, np.float64)
        fall = np.linspace(above, below, height)
        self._ground = np.repeat(np.rint(fall).astype(np.uint8)[:, None], width, axis=1)
        self._surface: Any = None

    def show(self, vertices: npt.NDArray[np.float32], faces: npt.NDArray[np.int32]) -> None:
        """Put a surface on it, in place of the one before."""
        self._bounds = [
            float(side) for ends in zip(vertices.min(axis=0), vertices.max(axis=0), strict=True) for side in ends
        ]
        self._surface = self._pyvista.PolyData.from_regular_faces(vertices, faces)
        self._surface.point_data["colors"] = np.zeros((len(vertices), 3), np.uint8)
        self._plotter.add_mesh(
            self._surface, scalars="colors", rgb=True, lighting=False, name="surface", reset_camera=False, render=False
        )

    def paint(self, colors: npt.NDArray[np.float32]) -> None:
        """Give each vertex of the surface its colour, (N, 3), 0 to 255."""
        self._surface.point_data["colors"] = (colors + np.float32(0.5)).astype(np.uint8)

    def image(self, eye: Viewpoint) -> npt.NDArray[np.uint8]:
        """Return what is seen, (H, W, 3) RGB."""
        self._look(eye)
        width, height = self._sides_px
        self._plotter.render_window.GetRGBACharPixelData(0, 0, width - 1, height - 1, 1, self._pixels)
        pixels = self._pyvista.convert_array(self._pixels).reshape(height, width, 4)
        if self._samples > 1:
            pixels = cv2.resize(pixels, self._size_px, interpolation=cv2.INTER_AREA)
        # Rows come from below.
        red, green, blue, part = cv2.split(cv2.flip(pixels, 0))
        behind = cv2.multiply(self._ground, cv2.merge([255 - part] * 3), scale=1 / 255)
        return np.asarray(cv2.add(cv2.merge([red, green, blue]), behind), np.uint8)

    def ground(self) -> npt.NDArray[np.uint8]:
        """Return a picture of nothing."""
        return self._ground.copy()

    def depth(self, eye: Viewpoint) -> npt.NDArray[np.float32]:
        """Return how far before the eye what is seen lies, along the line of sight, (H, W) mm; NaN where nothing is."""
        self._plotter.show(auto_close=False, interactive=False)  # which the library asks for
        self._look(eye)
        return np.asarray(-self._plotter.get_image_depth(fill_value=np.nan), np.float32)

    def name(self) -> str:
        """Return what draws, and by which library, as in "llvmpipe (LLVM 15.0.6, 256 bits), EGL"."""
        window = self._plotter.render_window
        lines = (
            line.partition("OpenGL renderer string:")[2].strip() for line in window.ReportCapabilities().split("\n")
        )
        kind = type(window).__name__
        return f"{next(filter(None, lines), 'an unknown renderer')}, {_WINDOWS.get(kind, kind)}"

    def _look(self, eye: Viewpoint) -> None:
        # Asked for the surface's bounds, the library would walk over all triangles.
        camera = self._plotter.camera
        camera.SetPosition(*eye.position)
        camera.SetFocalPoint(*eye.focal_point)
        camera.SetViewUp(*eye.up)
        camera.SetViewAngle(FIELD_OF_VIEW_DEG)
        self._plotter.renderer.ResetCameraClippingRange(self._bounds)
        self._plotter.render_window.Render()


class Scene:
    """The pictures of a surface, or of one that changes.

    Parameters
    ----------
    samples : sequence of Mesh
        Meshes that set limits and the eye's place for all pictures; they need no faces.
    options : PictureOptions
        How they are drawn.
    distance : callable, optional
        Distance from another mesh, which the colours then show.

    Raises
    ------
    RenderError
        The meshes do not have what the colours would show, or the options ask for mm that they do not have.
    """

    def __init__(self, samples: Sequence[Mesh], options: PictureOptions, distance: Distance | None = None) -> None:
        self._options, self._in_mm = options, samples[0].unit == "mm"
        if not self._in_mm and (options.camera is not None or options.path is not None):
            raise RenderError("a camera in mm needs a surface in mm: use --view, or decode with a calibration")
        self._colors = SurfaceColors(samples, options.colors, distance, options.limits, options.colormap)
        self._overlay = PictureOverlay(options.size_px, self._colors.scale)
        points = np.concatenate([mesh.vertices for mesh in samples])
        self._scale = np.ones(3, np.float32) if self._in_mm else _relief_scale(points)
        near, far = np.quantile(points * self._scale, (_STRAY, 1 - _STRAY), axis=0)
        first = samples[0].vertices[object_vertices(samples[0])] * self._scale
        self._middle = np.median(first, axis=0)
        self._eye, self._pivot = self._first_eye(np.clip(points * self._scale, near, far))

    def show(self, renderer: SurfaceRenderer, mesh: Mesh) -> None:
        """Put a surface into the renderer, in place of the one before."""
        vertices = mesh.vertices * self._scale
        # Relief that is stretched has other normals.
        normals = vertex_normals(mesh if self._in_mm else Mesh(vertices, mesh.faces))
        self._surface = vertices, normals, self._colors.of(mesh)
        renderer.show(vertices, mesh.faces)

    def picture(self, renderer: SurfaceRenderer, part: float, label: str = "") -> npt.NDArray[np.uint8]:
        """Return the picture of what is shown when this part of the film, 0 to 1, is over, (H, W, 3) RGB."""
        eye = self.viewpoint(part)
        vertices, normals, colors = self._surface
        renderer.paint(lit_colors(vertices, normals, colors, eye))
        image = renderer.image(eye)
        self._overlay.draw(image, self._px_per_mm(eye), label)
        return image

    def normal_image(self, renderer: SurfaceRenderer) -> npt.NDArray[np.uint8]:
        """Return what is shown in colours by its normals: right, up and towards the eye, -1 to 1, as 0 to 255."""
        eye = self.viewpoint(0.0)
        axes = eye.axes() * np.array([[1.0], [-1.0], [1.0]])
        renderer.paint((self._surface[1] @ axes.T.astype(np.float32) + 1) * np.float32(127.5))
        return renderer.image(eye)

    def viewpoint(self, part: float) -> Viewpoint:
        """Return where the eye is when this part of the film, 0 to 1, is over."""
        if self._options.path is not None:
            return self._options.path.viewpoint(part)
        return self._eye.turned(self._angle(part), self._pivot)

    def _angle(self, part: float) -> float:
        swung = self._options.sway_deg * np.sin(2 * np.pi * part)
        return float(np.radians(self._options.turn_deg * part + swung))

    def _first_eye(self, points: npt.NDArray[np.floating]) -> tuple[Viewpoint, npt.NDArray[np.floating]]:
        """Return where the eye begins, and what it goes round; all that is seen on its way fits into the picture."""
        if self._options.camera is not None:
            return self._options.camera, np.array(self._options.camera.focal_point)
        towards_eye, up = (np.array(direction) for direction in VIEWS[self._options.view])
        pivot = (points.min(axis=0) + points.max(axis=0)) / 2
        if self._options.turn_deg or self._options.sway_deg:
            # Where the eye goes round the surface to the left, the surface turns to the right before it.
            few = points[:: max(1, len(points) // _TURNED_POINTS)] - pivot
            angles = {self._angle(part) for part in np.linspace(0, 1, _TURNS)}
            points = np.concatenate([pivot + turn(few, up, angle) for angle in angles])
        margins = self._overlay.margins_px()
        return fitted_viewpoint(points, towards_eye, up, self._options.size_px, margins), pivot

    def _px_per_mm(self, eye: Viewpoint) -> float | None:
        """Return how many px a mm is across the line of sight, at the depth of the object's middle."""
        depth = float(eye.depth_of(self._middle))
        if not self._in_mm or depth <= 0:
            return None
        return float(self._options.size_px[1] / (2 * np.tan(np.radians(FIELD_OF_VIEW_DEG / 2)) * depth))


def _relief_scale(points: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    low, high = np.percentile(points[:, 2], (1, 99))
    width = np.ptp(points[:, :2], axis=0).max()
    return np.array([1, 1, _RELIEF * width / max(high - low, 1e-6)], np.float32)
