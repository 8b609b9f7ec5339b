"""Frames of a ``result.zarr``, read one at a time."""

import json
import warnings
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.calibration.lens import Lens
from pipeline.decoding.frame import FIELDS
from pipeline.errors import DamageError, DecodeWarning, FootageError
from pipeline.output.mesh import Mesh, RangeGrid, provenance_of
from pipeline.output.store_files import (
    DONE,
    FrameMark,
    StoreFiles,
    frame_fault,
    identity_digest,
    marked_frames,
    read_chunk,
    read_mark,
    read_metadata,
)
from pipeline.output.surface_mesh import MeshCounts, MeshOptions, surface_mesh
from pipeline.showing import to_html
from pipeline.zarr_chunks import decode_chunk


def mesh_fields(*, in_mm: bool) -> tuple[str, str]:
    """Return the fields that a mesh is made of."""
    return "mask", "points" if in_mm else "range_image"


class StoredResult:
    """A result that `colorphase decode` has stored.

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
            self.done = () if found is None else tuple(sorted(marked_frames(self._files, found.n_frames)))
        except FootageError:
            raise
        except DamageError as error:
            raise FootageError(f"{error}: run colorphase decode again as before, which repairs it") from None
        except OSError as error:
            raise FootageError(f"{self.name} is not a result.zarr that can be read: decode first") from error
        if found is None:
            raise FootageError(f"{self.name} is not a result.zarr that can be read: decode first")
        self.attributes = found.attributes
        self._metadata = found
        self._identity = identity_digest(self.attributes)
        stored = frozenset(found.shapes) - {DONE}
        self.fields = stored & FIELDS.keys()
        if strange := sorted(stored - FIELDS.keys()):
            by = found.says.colorphase_version
            warnings.warn(
                f"{self.name} was written by colorphase {by}, and this version leaves out fields that it does not know "
                f"({', '.join(strange)}): update colorphase to read them",
                DecodeWarning,
                stacklevel=2,
            )
        self._mark: tuple[int, FrameMark] | None = None  # of the frame that was read last

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of what was decoded of each frame."""
        return self._metadata.size_px

    @property
    def in_mm(self) -> bool:
        """Whether ranges are in mm, and a mesh therefore needs points."""
        return self._metadata.says.range_unit == "mm"

    @property
    def front_is_clear(self) -> bool:
        """Whether it is clear which side of the ranges faces the camera: by a calibration, the settings or rims."""
        says = self._metadata.says
        return self.in_mm or says.settings.get("projector_side") is not None or says.rim_votes.clear

    @property
    def wanted(self) -> range:
        """The numbers that the run was to decode, from its first to its last one that is done."""
        if not self.done:
            return range(0)
        return range(self.done[0], self.done[-1] + 1, self._metadata.says.step)

    def read(self, name: str, number: int) -> npt.NDArray[Any]:
        """Return a field of a frame.

        Raises
        ------
        FootageError
            The field was not stored, or its chunk is damaged.
        """
        self.require(name)
        try:
            shape = self._metadata.shapes[name]
            chunk = read_chunk(self._files, number, name, shape, self._mark_of(number))
            return decode_chunk(chunk, FIELDS[name].dtype, shape[1:])
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

    def require_mm(self) -> None:
        """Refuse to go on without places in mm.

        Raises
        ------
        FootageError
            The frames were decoded without a calibration.
        """
        if not self.in_mm:
            raise FootageError(f"{self.name} is in rad, not in mm: decode with a --calibration that holds the geometry")

    def frame_digest(self, number: int) -> str:
        """Return a text that distinguishes a frame from all others, also from itself decoded otherwise.

        Raises
        ------
        FootageError
            Its mark is damaged.
        """
        return json.dumps(vars(self._mark_of(number)), sort_keys=True)

    def fault(self, number: int) -> str | None:
        """Return what is wrong with a frame that is done; None: all of it is as it was written."""
        return frame_fault(self._files, number, self._metadata.shapes, self._identity)

    def _mark_of(self, number: int) -> FrameMark:
        if self._mark is None or self._mark[0] != number:
            try:
                self._mark = number, read_mark(self._files, number, self._identity)
            except DamageError as error:
                raise self._damaged(number, error) from None
        return self._mark[1]

    def _damaged(self, number: int, error: DamageError) -> FootageError:
        return FootageError(f"{self.name}: frame {number}: {error}: decode again as before, which repairs it")

    @property
    def camera(self) -> Lens | None:
        """The camera whose pixels the frames have; None: without a calibration."""
        return self._metadata.says.camera

    def provenance(self, number: int) -> dict[str, str]:
        """Return how a frame was made, as files carry it."""
        return provenance_of(self.attributes, number, self.time_s(number))

    def mesh(self, number: int, fields: Collection[str] | None = None, options: MeshOptions | None = None) -> Mesh:
        """Return a frame as a mesh; see `counted_mesh`."""
        return self.counted_mesh(number, fields, options)[0]

    def counted_mesh(
        self, number: int, fields: Collection[str] | None = None, options: MeshOptions | None = None
    ) -> tuple[Mesh, MeshCounts]:
        """Return a frame as a mesh, and what became of its pixels.

        Parameters
        ----------
        number : int
            The frame.
        fields : collection of str, optional
            What the mesh is to carry, as far as it is stored; None: all.
        options : MeshOptions, optional
            What to leave out, and whether to smooth.

        Raises
        ------
        FootageError
            What it is made of was not stored, or is damaged.
        SettingsError
            The options ask for mm, and there are none.
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
        region, texture = (self.read(name, number) if name in asked else None for name in ("region", "texture"))
        mesh, counts = surface_mesh(values, mask, points, properties, region, options, texture)
        return replace(mesh, provenance=self.provenance(number)), counts

    def grid(self, number: int) -> RangeGrid:
        """Return a frame's places with all that is stored of them, in the camera's grid.

        Raises
        ------
        FootageError
            There are no places in mm, or the frame is damaged.
        """
        self.require_mm()
        mask = self.read("mask", number)
        points = np.where(mask[..., None], self.read("points", number), np.float32(np.nan))
        time_s = self.time_s(number)
        return RangeGrid(
            points,
            self.read("texture", number) if "texture" in self.fields else None,
            {
                field.vertex: np.where(mask, self.read(name, number), np.float32(np.nan))
                for name, field in FIELDS.items()
                if field.vertex is not None and name in self.fields
            },
            self.camera,
            float(number) if time_s is None else time_s,  # pictures, as if one per second
            self.provenance(number),
        )

    def time_s(self, number: int) -> float | None:
        """Return when a frame was taken, s, since 1970 or since the first frame; None: the footage does not say."""
        times = self._metadata.times
        return None if times is None else times.of(number)

    def warnings(self, number: int) -> list[str]:
        """Return what the user should know of a frame.

        Raises
        ------
        FootageError
            Its mark is damaged.
        """
        return list(self._mark_of(number).warnings)

    def _repr_html_(self) -> str | None:
        return to_html(self)
