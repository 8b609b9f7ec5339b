"""Recordings in a Zarr group, a chunk a frame, as a source of frames; `recording.zarr_writer` writes them."""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import FootageError
from pipeline.footage.recording_tags import VERSION, RecordingTags, rate_of
from pipeline.footage.source import BadFrame, Frames, StoredAs, StoredFrame
from tikernels.raw.pixel_format import PixelFormat

#: Attribute of the group that says how its frames are stored, and the name of their array.
ATTRIBUTE = "colorphase_recording"
FRAMES = "frames"


class ZarrRecording:
    """A recording in a Zarr group; a `Source`.

    Parameters
    ----------
    path : Path
        The group.
    says : StoredAs
        What the user says of the pixels.

    Raises
    ------
    FootageError
        It is not a recording, of a later version, or damaged.
    """

    notes: tuple[str, ...] = ()

    def __init__(self, path: Path, says: StoredAs) -> None:
        import zarr  # slow to import, and only needed here

        self.name = str(path)
        self._path = path
        try:
            # Arrays of an older format may name codecs that run what they hold.
            group: Any = zarr.open_group(path, mode="r", zarr_format=3)
            about = group.attrs[ATTRIBUTE]
            version = about["version"]
        except (KeyError, TypeError, ValueError, OSError):
            raise FootageError(
                f"{path} is not a recording of frames: give a video, a folder of pictures or a recording"
            ) from None
        if version != VERSION:
            raise FootageError(f"{path} is a recording of version {version}, this program reads {VERSION}: update it")
        try:
            layout, bayer = about["layout"], about["bayer"]
            tags = RecordingTags(rate_of(about["rate_hz"]), about["transfer"], bayer, int(about["bits"]))
            format = PixelFormat(layout, tags.bits, **({"bayer": bayer} if layout == "bayer" else {}))
            self._array = group[FRAMES]
            height, width = self._array.shape[1:3]
            if self._array.shape[1:] != format.plane_shapes(height, width)[0] or self._array.dtype != format.dtype:
                raise ValueError(f"its frames are {self._array.shape[1:]} {self._array.dtype}")
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise FootageError(f"{path} is damaged: {error}") from None
        self.transfer = tags.transfer
        if len(self) == 0:
            raise FootageError(f"{path} holds no frames")
        self.size_px = (width, height)
        self.format = says.applied_to(format)

    def __len__(self) -> int:
        return int(self._array.shape[0])

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Frames:
        """Yield frames by number; see `Source`."""
        for number in range(len(self))[start:stop:step]:
            yield self._read(number)

    def close(self) -> None:
        """Do nothing: no file is open between two frames."""

    def _read(self, number: int) -> StoredFrame | BadFrame:
        chunk = self._path / FRAMES / self._array.metadata.encode_chunk_key((number, *(0,) * (self._array.ndim - 1)))
        if not chunk.exists():
            return BadFrame(number, "it is missing: its chunk is not there")
        try:
            levels = np.asarray(self._array[number])
        except Exception as error:  # each codec has errors of its own
            return BadFrame(number, f"it is damaged: {' '.join(str(error).split())}")
        return StoredFrame(number, (levels,), self.format)
