"""What all pictures of a film share: proportions, colours and their limits, where the eye is, and what is written."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.errors import RenderError
from pipeline.output.mesh import Mesh, vertex_normals
from pipeline.output.pictures.color_meaning import Distance, SurfaceColors
from pipeline.output.pictures.lighting import lit_colors
from pipeline.output.pictures.object_choice import object_vertices
from pipeline.output.pictures.picture_job import PictureOptions
from pipeline.output.pictures.picture_overlay import PictureOverlay
from pipeline.output.pictures.surface_renderer import SurfaceRenderer
from pipeline.output.pictures.viewpoint import FIELD_OF_VIEW_DEG, VIEWS, Viewpoint, fitted_viewpoint, turn

# Share of the points on each side that may be stray ones, and does not move the eye away.
_STRAY = 0.002
# Places of an eye that moves, and points, that tell how far away it must be.
_TURNS, _TURNED_POINTS = 73, 2000
# Part of its width that the depth of a surface in rad is scaled to, for the relief to show.
_RELIEF = 0.33


class Scene:
    """The pictures of a surface, or of one that changes.

    Parameters
    ----------
    samples : sequence of Mesh
        What tells limits and the eye's place for all pictures; they need no faces.
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
        self._colors = SurfaceColors(samples, options.colors, distance)
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
