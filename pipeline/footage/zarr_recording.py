"""Recordings in a Zarr group, a chunk per frame, as a source of frames; `recording.zarr_writer` writes them."""

import os
import re
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import DamageError, FootageError
from pipeline.footage.footage import BadFrame, Footage, Frames, StoredAs, StoredFrame
from pipeline.footage.frame_times import LOG, FrameTimes
from pipeline.limits import check_missing, check_size, read_plain, read_text
from pipeline.models import SensorPart, build
from pipeline.zarr_chunks import chunk_bytes, chunk_key, decode_chunk
from tikernels.errors import ShapeError
from tikernels.raw.linearization import TRANSFERS
from tikernels.raw.pixel_format import PixelFormat

#: Of the format of recordings.
VERSION = "1"
# Videos count in ms: above this, two frames of an exported recording could share one.
MOST_FRAMES_A_SECOND = 500
#: Attribute of the group that states how its frames are stored, and the name of their array.
ATTRIBUTE = "colorphase_recording"
FRAMES = "frames"


def rate_of(text: str) -> Fraction:
    """Return frames per second, from how a recording writes them.

    Raises
    ------
    ValueError
        It is no fraction.
    """
    # Of 1e999999999 Fraction would make a number of that many digits; cameras' rates have ten.
    if re.fullmatch(r"[0-9]{1,20}(/0{0,20}[1-9][0-9]{0,20})?", text) is None:
        raise ValueError(f"rate {text[:40]!r} is no fraction")
    return Fraction(text)


@dataclass(frozen=True)
class RecordingTags:
    """Tags of a recording; its frames' size is not one.

    Raises
    ------
    ShapeError
        The rate or the transfer is none that a recording can have.
    """

    rate_hz: Fraction  # frames per second
    transfer: str | None
    bayer: str | None  # None: RGB
    bits: int
    sensor: SensorPart | None = None  # the part of the camera's that frames are; None: not known

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= MOST_FRAMES_A_SECOND:
            raise ShapeError(f"rate_hz is {self.rate_hz}: give one above 0 and up to {MOST_FRAMES_A_SECOND}")
        if self.transfer not in (None, *TRANSFERS):
            raise ShapeError(f"transfer is {self.transfer!r}: choose {', '.join(TRANSFERS)}")


class ZarrRecording(Footage):
    """A recording in a Zarr group.

    Parameters
    ----------
    path : Path
        The group.
    says : StoredAs
        The user's description of the pixels.

    Raises
    ------
    FootageError
        It is not a recording, of a later version, or damaged.
    """

    def __init__(self, path: Path, says: StoredAs) -> None:
        import zarr  # slow to import, and only needed here

        self.name = str(path)
        self._path = path
        try:
            for head in (path / "zarr.json", path / FRAMES / "zarr.json"):
                read_text(head)  # which no recording makes long
            # Arrays of an older format may name codecs that run what they hold.
            group: Any = zarr.open_group(path, mode="r", zarr_format=3)
            about = group.attrs[ATTRIBUTE]
            version, array = about["version"], group.get(FRAMES)
        except Exception:  # zarr checks little of a damaged file, and fails in many ways
            raise FootageError(
                f"{path} is not a recording of frames: give a video, a folder of pictures or a recording"
            ) from None
        if version != VERSION:
            raise FootageError(
                f"{path} is a recording of version {str(version)[:40]}, this program reads {VERSION}: update it"
            )
        try:
            layout, bayer = about["layout"], about["bayer"]
            said = about.get("sensor")
            sensor = None if said is None else build(SensorPart, said, ValueError, "sensor")
            tags = RecordingTags(rate_of(about["rate_hz"]), about["transfer"], bayer, int(about["bits"]), sensor)
            format = PixelFormat(layout, tags.bits, **({"bayer": bayer} if layout == "bayer" else {}))
            self._n_frames, height, width = (int(size) for size in array.shape[:3])
            (self._shape,) = format.plane_shapes(height, width)
            self._dtype = np.dtype(format.dtype)
            if array.shape[1:] != self._shape or array.dtype != self._dtype:
                raise ValueError(f"its frames have shape {array.shape[1:]} {array.dtype}")
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise FootageError(f"{path} is damaged: {error}") from None
        if self._n_frames == 0:
            raise FootageError(f"{path} holds no frames")
        check_size(str(path), width, height)
        check_missing(str(path), self._n_frames, sum(name.startswith("c.") for name in os.listdir(path / FRAMES)))
        self.transfer = tags.transfer
        self.transfer_because = "the recording says so" if tags.transfer else "the recording does not say"
        self.rate_hz = tags.rate_hz
        self.sensor = tags.sensor
        self.size_px = (width, height)
        self.format = says.applied_to(format)

    def __len__(self) -> int:
        return self._n_frames

    @property
    def times(self) -> FrameTimes:
        """Times at which frames were taken, by the capture's log or the recording's rate; see `Footage`."""
        logged = FrameTimes.logged(self._path.parent / LOG, len(self))
        if logged is not None:
            return logged
        return FrameTimes(np.array([float(number / self.rate_hz) for number in range(len(self))]), None)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Frames:
        """Yield frames by number; see `Footage`."""
        for number in range(len(self))[start:stop:step]:
            yield self._read(number)

    def files(self) -> list[Path]:
        """Return the frames' chunks; see `Footage`."""
        return [self._path / FRAMES / chunk_key(number, len(self._shape)) for number in range(len(self))]

    def _read(self, number: int) -> StoredFrame | BadFrame:
        chunk = self._path / FRAMES / chunk_key(number, len(self._shape))
        try:
            stored = read_plain(chunk, chunk_bytes(self._dtype, self._shape))
            levels = decode_chunk(stored, self._dtype, self._shape)
        except FileNotFoundError:
            return BadFrame(number, "it is missing: its chunk is not there")
        except (DamageError, OSError) as error:
            return BadFrame(number, f"it is damaged: {error.strerror or error}")
        return StoredFrame(number, (levels,), self.format)
