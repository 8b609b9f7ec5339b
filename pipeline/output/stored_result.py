"""Frames of a ``result.zarr``, each read when it is used."""

import json
import warnings
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from pipeline.calibration.lens import Lens
from pipeline.decoding.fields import Field
from pipeline.decoding.frame import FIELDS
from pipeline.decoding.frame_fields import FrameFields
from pipeline.errors import DamageError, DecodeWarning, FootageError
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
from pipeline.showing import to_html, view_frames
from pipeline.zarr_chunks import decode_chunk

if TYPE_CHECKING:
    from pipeline.view.embedded import EmbeddedPage


def mesh_fields(*, in_mm: bool) -> tuple[str, str]:
    """Return the fields that a mesh needs."""
    return "mask", "points" if in_mm else "range_image"


class ResultFrame(FrameFields):
    """A frame of a result: a decoded frame's fields, as far as they are stored, each read when first used.

    A field that was not stored, or whose chunk is damaged, raises a `FootageError`; without a calibration `points` and
    `point_sigma` are None.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(sheet.image)
    >>> frame.save("face.zarr")
    >>> stored = colorphase.StoredResult("face.zarr")[0]
    >>> stored
    <ResultFrame 0: 160x120 px, 100.0% measured, 826 to 988.8 mm>
    >>> bool((stored.points[stored.mask] == frame.points[frame.mask]).all())
    True
    """

    number: int

    def __init__(self, result: "StoredResult", number: int) -> None:
        self._result = result
        self.number = number
        times = result._metadata.times
        self.time_s = None if times is None else times.of(number)
        self.dated = times is not None and times.since is not None

    def __getattr__(self, name: str) -> Any:
        if name == "warnings":
            found: Any = tuple(self._mark.warnings)
        elif name == "period_px":
            found = self._mark.period_px
        elif name not in FIELDS:
            raise AttributeError(f"a frame of a result has no {name}")
        elif self.calibrated or not FIELDS[name].in_mm:
            found = self._result._read(name, self.number, self._mark)
        else:
            found = None
        vars(self)[name] = found
        return found

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.fields]

    @property
    def fields(self) -> dict[str, Field[Any]]:
        """The fields that are stored, by name."""
        return {name: entry for name, entry in FIELDS.items() if name in self._result.fields}

    @property
    def calibrated(self) -> bool:
        """True if `range_image` is a depth in mm."""
        return self._result.in_mm

    @property
    def camera(self) -> Lens | None:
        """The camera whose pixels it has; None: without a calibration."""
        return self._result.camera

    @property
    def attributes(self) -> dict[str, Any]:
        """The store's attributes of how it was decoded."""
        return self._result.attributes

    @property
    def digest(self) -> str:
        """A text that distinguishes the frame from all others, also from itself decoded otherwise."""
        return json.dumps(vars(self._mark), sort_keys=True)

    @cached_property
    def _mark(self) -> FrameMark:
        return self._result._mark_of(self.number)


class StoredResult:
    """A result that `colorphase decode` has stored: a sequence of its complete frames, in their order.

    ``result[0]`` is the first of them, ``result[-1]`` the last, ``result.frame(17)`` the footage's frame 17.

    Parameters
    ----------
    location : str or Path
        The ``result.zarr``: a folder, or an fsspec URL.

    Attributes
    ----------
    attributes : dict
        The store's attributes of how its frames were decoded.
    fields : frozenset of str
        Names of the fields that are stored of each frame.
    done : tuple of int
        The numbers of the complete frames.

    Raises
    ------
    FootageError
        It is no such store.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> with colorphase.Recorder("film.zarr", colorphase.PixelFormat("rgb"), rate_hz=30) as film:
    ...     for seed in range(2):
    ...         film.add(colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane", seed=seed)).image)
    >>> _ = colorphase.decode_footage("film.zarr", "out", calibration=rig, arch="cpu", workers=1)
    >>> result = colorphase.StoredResult("out/result.zarr")
    >>> [f"{np.nanmedian(frame.points[..., 2]):.0f} mm at {frame.time_s:.3f} s" for frame in result]
    ['900 mm at 0.000 s', '900 mm at 0.033 s']
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

    def __len__(self) -> int:
        return len(self.done)

    def __iter__(self) -> Iterator[ResultFrame]:
        return (ResultFrame(self, number) for number in self.done)

    @overload
    def __getitem__(self, place: int) -> ResultFrame: ...

    @overload
    def __getitem__(self, place: slice) -> list[ResultFrame]: ...

    def __getitem__(self, place: int | slice) -> ResultFrame | list[ResultFrame]:
        if isinstance(place, slice):
            return [ResultFrame(self, number) for number in self.done[place]]
        return ResultFrame(self, self.done[place])

    def __repr__(self) -> str:
        width, height = self.size_px
        fields = ", ".join(sorted(self.fields))
        return f"<StoredResult {self.name}: {len(self)} frames of {width}x{height} px, {fields}>"

    def frame(self, number: int) -> ResultFrame:
        """Return a frame by its number in the footage; one that is not `done` fails when a field is used.

        Raises
        ------
        FootageError
            The footage has no such frame.
        """
        if not 0 <= number < self._metadata.n_frames:
            raise FootageError(f"{self.name} has frames 0 to {self._metadata.n_frames - 1}, and no {number}")
        return ResultFrame(self, number)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of what was decoded of each frame."""
        return self._metadata.size_px

    @property
    def in_mm(self) -> bool:
        """True if ranges are in mm, and a mesh therefore needs points."""
        return self._metadata.says.range_unit == "mm"

    @property
    def front_known(self) -> bool:
        """True if a calibration, the settings or rims determine which side of the ranges faces the camera."""
        says = self._metadata.says
        return self.in_mm or says.settings.get("projector_side") is not None or says.state.rims.clear

    @property
    def wanted(self) -> range:
        """The numbers that the run was to decode, from its first to its last one that is done."""
        if not self.done:
            return range(0)
        return range(self.done[0], self.done[-1] + 1, self._metadata.says.step)

    def _read(self, name: str, number: int, mark: FrameMark) -> Any:
        self.require(name)
        try:
            shape = self._metadata.shapes[name]
            return decode_chunk(read_chunk(self._files, number, name, shape, mark), FIELDS[name].dtype, shape[1:])
        except DamageError as error:
            raise self._damaged(number, error) from None

    def require(self, name: str) -> None:
        """Refuse to continue without a field.

        Raises
        ------
        FootageError
            It was not stored.
        """
        if name not in self.fields:
            raise FootageError(f"{self.name} holds no {name}: decode with that field")

    def require_mm(self) -> None:
        """Refuse to continue without positions in mm.

        Raises
        ------
        FootageError
            The frames were decoded without a calibration.
        """
        if not self.in_mm:
            raise FootageError(f"{self.name} is in rad, not in mm: decode with a --calibration that holds the geometry")

    def fault(self, number: int) -> str | None:
        """Return what is wrong with a frame that is done; None: all of it is as it was written."""
        return frame_fault(self._files, number, self._metadata.shapes, self._identity)

    def _mark_of(self, number: int) -> FrameMark:
        try:
            return read_mark(self._files, number, self._identity)
        except DamageError as error:
            raise self._damaged(number, error) from None

    def _damaged(self, number: int, error: DamageError) -> FootageError:
        return FootageError(f"{self.name}: frame {number}: {error}: decode again as before, which repairs it")

    @property
    def camera(self) -> Lens | None:
        """The camera whose pixels the frames have; None: without a calibration."""
        return self._metadata.says.camera

    def view(self) -> "EmbeddedPage":
        """Return a page for a notebook with up to 24 frames, evenly spaced; see `FrameFields.view`."""
        page: EmbeddedPage = view_frames(self)
        return page

    def _repr_html_(self) -> str | None:
        return to_html(self)
