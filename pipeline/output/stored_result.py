"""Frames of a ``result.zarr``, read one at a time."""

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from pipeline.decoding.frame import FIELDS
from pipeline.decoding.front_side import RimVotes
from pipeline.errors import DamageError, FootageError
from pipeline.output.mesh import Mesh
from pipeline.output.store_files import StoreFiles
from pipeline.output.store_marks import FrameMark, frame_fault, identity_digest, marked_frames, read_chunk, read_mark
from pipeline.output.store_metadata import DONE, read_metadata
from pipeline.output.surface_mesh import surface_mesh
from pipeline.zarr_chunks import decode_chunk

MeshKind = Literal["ply", "glb"]


def mesh_fields(*, in_mm: bool) -> tuple[str, str]:
    """Return the fields that a mesh is made of."""
    return "mask", "points" if in_mm else "range_image"


class StoredResult:
    """What `colorphase decode` has stored.

    Parameters
    ----------
    location : str or Path
        The ``result.zarr``: a folder, or an fsspec URL.

    Attributes
    ----------
    attributes : dict
        What the store says of how its frames were decoded.
    fields : frozenset of str
        What is stored of each frame.
    done : tuple of int
        The numbers of the frames that are whole.

    Raises
    ------
    FootageError
        It is no such store.
    """

    def __init__(self, location: str | Path) -> None:
        self.name = str(location)
        try:
            self._files = StoreFiles(location)
            found = read_metadata(self._files)
            self.done = () if found is None else tuple(sorted(marked_frames(self._files)))
        except DamageError as error:
            raise FootageError(f"{error}: run colorphase decode again as before, which mends it") from None
        except OSError as error:
            raise FootageError(f"{self.name} is not a result.zarr that can be read: decode first") from error
        if found is None:
            raise FootageError(f"{self.name} is not a result.zarr that can be read: decode first")
        self.attributes: dict[str, Any] = found[0]
        self._shapes = found[1]
        self._identity = identity_digest(self.attributes)
        self.fields = frozenset(self._shapes) - {DONE}
        self._mark: tuple[int, FrameMark] | None = None  # of the frame that was read last

    @property
    def in_mm(self) -> bool:
        """Whether ranges are in mm, and a mesh therefore needs points."""
        return bool(self.attributes.get("range_unit") == "mm")

    @property
    def front_is_clear(self) -> bool:
        """Whether it is clear which side of the ranges faces the camera: by a calibration, the settings or rims."""
        rims = RimVotes(**self.attributes.get("rims", {}))
        return self.in_mm or self.attributes["settings"].get("projector_side") is not None or rims.clear

    @property
    def wanted(self) -> range:
        """The numbers that the run was to decode, from its first to its last one that is done."""
        if not self.done:
            return range(0)
        return range(self.done[0], self.done[-1] + 1, int(self.attributes.get("step", 1)))

    def read(self, name: str, number: int) -> npt.NDArray[Any]:
        """Return a field of a frame.

        Raises
        ------
        FootageError
            The field was not stored, or its chunk is damaged.
        """
        self.require(name)
        try:
            chunk = read_chunk(self._files, number, name, self._mark_of(number))
            return decode_chunk(chunk, FIELDS[name].dtype, self._shapes[name][1:])
        except DamageError as error:
            raise self._damaged(number, error) from None

    def require(self, name: str) -> None:
        """Refuse to go on without a field.

        Raises
        ------
        FootageError
            It was not stored.
        """
        if name not in self.fields:
            raise FootageError(f"{self.name} holds no {name}: decode with that field")

    def frame_digest(self, number: int) -> str:
        """Return what tells a frame from all others, also from itself decoded otherwise.

        Raises
        ------
        FootageError
            Its mark is damaged.
        """
        return json.dumps(vars(self._mark_of(number)), sort_keys=True)

    def fault(self, number: int) -> str | None:
        """Return what is wrong with a frame that is done; None: all of it is as it was written."""
        return frame_fault(self._files, number, sorted(self.fields), self._identity)

    def _mark_of(self, number: int) -> FrameMark:
        if self._mark is None or self._mark[0] != number:
            try:
                self._mark = number, read_mark(self._files, number, self._identity)
            except DamageError as error:
                raise self._damaged(number, error) from None
        return self._mark[1]

    def _damaged(self, number: int, error: DamageError) -> FootageError:
        return FootageError(f"{self.name}: frame {number}: {error}: decode again as before, which mends it")

    def mesh(self, number: int, fields: Collection[str] | None = None) -> Mesh:
        """Return a frame as a mesh, with what is known of its vertices: if it is stored, and among `fields`.

        Raises
        ------
        FootageError
            What it is made of was not stored, or is damaged.
        """
        points = self.read("points", number) if self.in_mm else None
        values = self.read("range_image", number) if points is None else points[..., 2]
        mask = self.read("mask", number) & np.isfinite(values)
        asked = self.fields if fields is None else self.fields & set(fields)
        properties = {
            field.vertex: self.read(name, number)[mask]
            for name, field in FIELDS.items()
            if field.vertex is not None and name in asked
        }
        colors = self.read("texture", number)[mask] if "texture" in asked else None
        return surface_mesh(values, mask, points, properties, colors=colors)
