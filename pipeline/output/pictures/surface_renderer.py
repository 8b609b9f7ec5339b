"""A surface drawn off screen by VTK; only for a child process, which ends where there is no graphics library."""

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.output.pictures.viewpoint import FIELD_OF_VIEW_DEG, Viewpoint

# The ground's RGB, above and below.
_GROUND = ((58, 65, 75), (29, 33, 39))
_WINDOWS = {"vtkEGLRenderWindow": "EGL", "vtkOSOpenGLRenderWindow": "OSMesa", "vtkXOpenGLRenderWindow": "GLX"}


class SurfaceRenderer:
    """Draws one surface at a time, in colours that are ready.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of its images.
    samples : int
        By how many rows and columns a pixel is made up, so that edges are smooth; 1: none are mixed, for buffers.
    ground : bool
        Whether what is behind the surface is drawn, too, or is black.
    """

    def __init__(self, size_px: tuple[int, int], samples: int = 2, *, ground: bool = True) -> None:
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
        above, below = np.array(_GROUND, np.float64) * ground
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
