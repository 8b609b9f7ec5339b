"""Subjects of the viewer: a result, footage that is decoded on demand, or a mesh."""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.decoder import Decoder
from pipeline.decoding.frame import FIELDS
from pipeline.errors import FootageError
from pipeline.footage.footage import BadFrame, Footage
from pipeline.models import ImageArray
from pipeline.output.mesh import Mesh
from pipeline.output.store_files import DONE
from pipeline.output.stored_result import StoredResult
from pipeline.settings import DecodeSettings
from pipeline.view.message import ViewedFrame, describe_maps
from pipeline.view.page import color_table
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.linearization import WHITE_LEVELS

# The frame rate where the times of frames are unknown.
_RATE_HZ = 25.0
# A result whose last frame is younger than this may still be growing, s.
_FRESH_S = 120.0


class Subject(ABC):
    """Frames for the page. Methods may be called from any thread."""

    title: str

    @abstractmethod
    def about(self) -> dict[str, Any]:
        """Return title, size, maps and number of frames, for JSON."""

    @abstractmethod
    def frame(self, place: int, names: Sequence[str]) -> ViewedFrame:
        """Return a frame by its index, from 0, with those of the named maps that it has.

        Raises
        ------
        FootageError
            The frame is damaged or does not exist.
        """

    def next(self, after: int, names: Sequence[str], most_s: float) -> ViewedFrame | None:
        """Return a live frame that is newer than frame number `after`; None: none came in time."""
        raise FootageError(f"{self.title} is not live: request frames by index")

    def close(self) -> None:  # noqa: B027 (most hold no resources)
        """Let go of files and processes."""

    def _describe(
        self,
        maps: dict[str, dict[str, str]],
        *,
        count: int,
        size_px: tuple[int, int] | None,
        rate_hz: float = _RATE_HZ,
        camera: bool = False,
        growing: bool = False,
        live: bool = False,
    ) -> dict[str, Any]:
        return {
            "title": self.title,
            "maps": maps,
            "count": count,
            "size": size_px,
            "rate_hz": rate_hz,
            "camera": camera,
            "growing": growing,
            "live": live,
            "colors": color_table(),
        }


class ResultSubject(Subject):
    """A stored result. Frames are read on demand; the result may grow meanwhile.

    Parameters
    ----------
    location : str or Path
        The ``result.zarr``.

    Raises
    ------
    FootageError
        It does not exist, or holds no field that can be shown.
    """

    def __init__(self, location: str | Path) -> None:
        self._location = str(location)
        self._written_s = self._last_written_s()
        self._result = StoredResult(location)
        self.title = Path(self._location).resolve().parent.name if "://" not in self._location else self._location
        if not self._maps():
            raise FootageError(f"{self._location} holds no field that can be shown: decode with --fields points mask")

    def _maps(self) -> dict[str, dict[str, str]]:
        return describe_maps(self._result.fields, in_mm=self._result.in_mm)

    def about(self) -> dict[str, Any]:
        """See `Subject`."""
        written_s = self._last_written_s()
        if written_s != self._written_s:
            self._written_s, self._result = written_s, StoredResult(self._location)
        result = self._result
        done = result.done
        rate_hz = _RATE_HZ
        if len(done) > 1 and (last_s := result[-1].time_s) is not None and (first_s := result[0].time_s) is not None:
            rate_hz = (len(done) - 1) / max(last_s - first_s, 1e-3)
        growing = time.time() - written_s < _FRESH_S
        return self._describe(self._maps(), count=len(done), size_px=result.size_px, rate_hz=rate_hz, growing=growing)

    def _last_written_s(self) -> float:
        """Return the time at which a frame was last written; 0 for a URL, where it is unknown."""
        marks = Path(self._location) / DONE
        return marks.stat().st_mtime if marks.is_dir() else 0.0

    def frame(self, place: int, names: Sequence[str]) -> ViewedFrame:
        """See `Subject`."""
        if not 0 <= place < len(self._result):
            raise FootageError(f"{self.title} has {len(self._result)} frames: index {place} is out of range")
        return ViewedFrame.of(self._result[place], names)


class FootageSubject(Subject):
    """Footage. Every frame is decoded on demand, without the frame before.

    Parameters
    ----------
    footage : Footage
        A picture, a folder of pictures, a video or a recording; closed with the subject.
    settings : DecodeSettings
        How to decode.
    calibration : Calibration or None
        The rig.
    arch : str
        Where to compute.

    Raises
    ------
    CalibrationError, DeviceNotReady
        See `Decoder`.
    """

    def __init__(self, footage: Footage, settings: DecodeSettings, calibration: Calibration | None, arch: str) -> None:
        self.title = Path(footage.name).name
        self._footage, self._stripes = footage, settings.stripes
        self._decoder = Decoder(settings, calibration, arch=arch)
        self._in_mm = calibration is not None and calibration.has_geometry
        self._lock = threading.Lock()
        self._seen: tuple[int, Any, ImageArray] | None = None  # the last frame shown

    def about(self) -> dict[str, Any]:
        """See `Subject`."""
        times, count = self._footage.times, len(self._footage)
        rate_hz = _RATE_HZ if times is None or count < 2 else 1 / max(float(np.median(np.diff(times.seconds))), 1e-3)
        maps = describe_maps(FIELDS, in_mm=self._in_mm)
        return self._describe(maps, count=count, size_px=self._footage.size_px, rate_hz=rate_hz, camera=True)

    def frame(self, place: int, names: Sequence[str]) -> ViewedFrame:
        """See `Subject`."""
        if not 0 <= place < len(self._footage):
            raise FootageError(f"{self.title} has {len(self._footage)} frames: index {place} is out of range")
        with self._lock:
            if self._seen is None or self._seen[0] != place:
                (stored,) = self._footage.frames(place, place + 1)
                if isinstance(stored, BadFrame):
                    raise FootageError(f"frame {stored.number} of {self.title}: {stored.reason}")
                levels = runtime.to_host(develop(stored.planes, stored.format, stripes=self._stripes)).copy()
                (decoded,) = self._decoder.decode_all(self._footage, place, place + 1)
                self._seen = place, decoded, as_bytes(levels, linear=self._footage.transfer == "linear")
            _, decoded, picture = self._seen
            return ViewedFrame.of(decoded, names, picture)

    def close(self) -> None:
        """Let go of files."""
        self._footage.close()


class MeshSubject(Subject):
    """A mesh.

    Parameters
    ----------
    mesh : Mesh
        The mesh.
    title : str
        Title of the page.
    """

    def __init__(self, mesh: Mesh, title: str) -> None:
        self.title = title
        values: dict[str, npt.NDArray[Any]] = {"depth": mesh.vertices[:, 2]}
        if mesh.colors is not None:
            values["texture"] = mesh.colors
        if (sigma := mesh.properties.get(f"sigma_{mesh.unit}")) is not None:
            values["sigma"] = sigma
        self._maps = {
            name: {"unit": "" if name == "texture" else mesh.unit, "kind": "color" if name == "texture" else "number"}
            for name in values
        }
        self._frame = ViewedFrame({"points": mesh.vertices, "faces": mesh.faces.astype(np.uint32), **values})

    def about(self) -> dict[str, Any]:
        """See `Subject`."""
        return self._describe(self._maps, count=1, size_px=None)

    def frame(self, place: int, names: Sequence[str]) -> ViewedFrame:
        """See `Subject`."""
        return self._frame


def as_bytes(levels: ImageArray, *, linear: bool, white: float | None = None) -> npt.NDArray[np.uint8]:
    """Return a picture in 8 bits for the screen; linear light is encoded by a power of 1/2.2, close to sRGB.

    Parameters
    ----------
    levels : (H, W, 3)
        Of a camera, up to `white`.
    linear : bool
        True for levels that are proportional to light.
    white : float, optional
        Full scale; None: that of the type.
    """
    white = WHITE_LEVELS[levels.dtype.name] if white is None else white
    if levels.dtype == np.float32:
        return _shown(levels / np.float32(white), linear=linear)
    # A table is faster than a power for each value.
    table = _shown(np.arange(2 ** (8 * levels.dtype.itemsize)) / white, linear=linear)
    return np.asarray(table[levels])


def _shown(shares: npt.NDArray[Any], *, linear: bool) -> npt.NDArray[np.uint8]:
    encoded = np.clip(shares, 0, 1) ** (1 / 2.2 if linear else 1)
    return np.asarray(np.rint(255 * encoded), np.uint8)
