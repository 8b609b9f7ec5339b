"""Sources of the surfaces in pictures: a mesh, or the frames of a ``result.zarr``."""

from pathlib import Path

import numpy as np

from pipeline.errors import FootageError, RenderError
from pipeline.output.folder import file_digest
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_mesh
from pipeline.output.pictures.color_meaning import Colors
from pipeline.output.stored_result import StoredResult, mesh_fields
from pipeline.output.surface_mesh import frame_mesh

# Frames, evenly spaced, that set the eye's place and the colours' limits for a whole film.
_ASKED = 16
# Of their points every sixteenth is enough for that.
_EVERY = 16


class MeshSource:
    """One mesh for all pictures.

    Parameters
    ----------
    path : str or Path
        A PLY file.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._mesh = read_mesh(path)
        self.broken: dict[int, str] = {}

    def samples(self) -> list[Mesh]:
        """Return the meshes that set the limits and the eye's place."""
        return [self._mesh]

    def mesh(self, number: int) -> Mesh | None:
        """Return the mesh of a picture."""
        return self._mesh

    def digest(self, number: int) -> str:
        """Return a digest that distinguishes the mesh from others."""
        return str(file_digest(self._path))


class StoreSource:
    """The frames of a store.

    Parameters
    ----------
    location : str or Path
        The ``result.zarr``.
    colors : str
        What colours will show.

    Attributes
    ----------
    broken : dict of int to str
        What is wrong with frames that were asked for and are damaged.

    Raises
    ------
    FootageError
        There is no such store, it holds no frame that is done, or lacks a field that is needed.
    """

    def __init__(self, location: str | Path, colors: Colors) -> None:
        self.result = StoredResult(location)
        if not self.result.done:
            raise FootageError(f"{self.result.name} holds no frame that is done: decode first")
        sigma = "point_sigma" if self.result.in_mm else "phase_sigma"
        more = {"modulation": ("modulation",), "sigma": (sigma,), "texture": ("texture",)}.get(colors, ())
        self._fields = (*mesh_fields(in_mm=self.result.in_mm), *more)
        for field in self._fields:
            self.result.require(field)
        # It distinguishes noise from steps, and walls from objects.
        self._fields = tuple(dict.fromkeys((*self._fields, *({sigma} & self.result.fields))))
        self._done = set(self.result.done)
        self.broken: dict[int, str] = {}
        self._last: tuple[int, Mesh | None] | None = None  # the frame that was asked for last

    def samples(self) -> list[Mesh]:
        """Return the points of some frames, spread over all of them, without faces.

        Raises
        ------
        RenderError
            None of them shows a surface.
        """
        done = self.result.done
        asked = [done[i] for i in np.unique(np.linspace(0, len(done) - 1, _ASKED).astype(int))]
        found = [points for number in asked if (points := self._points(number)) is not None]
        if not found:
            raise RenderError("no frame shows a surface: run colorphase inspect on the footage")
        return found

    def mesh(self, number: int) -> Mesh | None:
        """Return the mesh of a frame; None: it is not there, is damaged, or shows no surface."""
        if self._last is None or self._last[0] != number:
            self._last = number, self._made(number)
        return self._last[1]

    def _made(self, number: int) -> Mesh | None:
        if number not in self._done:
            return None
        try:
            mesh = frame_mesh(self.result.frame(number), fields=self._fields)
        except FootageError as error:
            self.broken[number] = str(error)
            return None
        return mesh if len(mesh.faces) else None

    def digest(self, number: int) -> str:
        """Return a digest that distinguishes a frame from others, also from itself decoded otherwise."""
        if number not in self._done:
            return "missing"
        try:
            return self.result.frame(number).digest
        except FootageError:
            return "damaged"

    def _points(self, number: int) -> Mesh | None:
        in_mm = self.result.in_mm
        try:
            values = {name: getattr(self.result.frame(number), name) for name in self._fields}
        except FootageError:
            return None
        place = values["points"] if in_mm else _pixel_points(values["range_image"])
        mask = values["mask"] & np.isfinite(place).all(axis=-1)
        sigma = "point_sigma" if in_mm else "phase_sigma"
        names = {sigma: f"sigma_{'mm' if in_mm else 'rad'}", "modulation": "modulation"}
        known = {names[name]: values[name][mask][::_EVERY].astype(np.float32) for name in names if name in values}
        colors = values["texture"][mask][::_EVERY] if "texture" in values else None
        points = np.ascontiguousarray(place[mask][::_EVERY], np.float32)
        faces = np.empty((0, 3), np.int32)
        return Mesh(points, faces, colors, known, unit="mm" if in_mm else "rad") if len(points) else None


def _pixel_points(
    values: np.ndarray[tuple[int, int], np.dtype[np.float32]],
) -> np.ndarray[tuple[int, int, int], np.dtype[np.float32]]:
    y, x = np.indices(values.shape, np.float32)
    return np.stack([x, y, values], axis=-1)
