"""Recordings in a Zarr group: a chunk a frame."""

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.chunks import CHUNK_KEYS, chunk_codec, chunk_key, encode_chunk
from pipeline.errors import FootageError
from pipeline.files import replace_file
from pipeline.video.stored import BadFrame, Frames, StoredAs, StoredFrame
from pipeline.video.tags import VERSION, RecordingTags, rate_of
from tikernels.pixel_format import PixelFormat

_ATTRIBUTE = "colorphase_recording"
_FRAMES = "frames"
_KEY = re.compile(r"c\.(\d+)[.0]*")
# Of the compressor: a higher one takes up to a half longer, and what it makes is 2 % smaller.
_LEVEL = 1
# Each compresses and writes a frame by itself, and lets go of the interpreter meanwhile.
_MOST_THREADS = 4


class ZarrWriter:
    """Write frames as chunks behind the array's end, which a commit moves.

    Parameters
    ----------
    path : Path
        The group, which must not exist.
    size_px : (int, int)
        Width and height of every frame.
    format, tags
        How they are stored, and what the recording says of itself.

    Raises
    ------
    OSError
        It cannot be written.
    """

    #: How many threads may call `write`.
    most_threads = min(_MOST_THREADS, os.cpu_count() or 1)

    def __init__(self, path: Path, size_px: tuple[int, int], format: PixelFormat, tags: RecordingTags) -> None:
        import google_crc32c
        import zarr  # slow to import, and only needed here
        from zarr.codecs import Crc32cCodec

        about: dict[str, Any] = {
            "version": VERSION,
            "layout": format.layout,
            "bits": format.bits,
            "bayer": tags.bayer,
            "transfer": tags.transfer,
            "rate_hz": str(tags.rate_hz),
        }
        (shape,) = format.plane_shapes(size_px[1], size_px[0])
        group = zarr.open_group(path, mode="w-", attributes={_ATTRIBUTE: about})
        group.create_array(
            _FRAMES,
            shape=(0, *shape),
            chunks=(1, *shape),
            dtype=np.dtype(format.dtype),
            # A checksum, because one wrong bit would change the rest of a chunk.
            compressors=[chunk_codec(_LEVEL), Crc32cCodec()],
            chunk_key_encoding=CHUNK_KEYS,
        )
        self._folder = path / _FRAMES
        self._metadata = self._folder / "zarr.json"
        self._says = json.loads(self._metadata.read_bytes())
        self._checksum = google_crc32c.value
        self.n_frames = 0  # of those committed

    def write(self, number: int, frame: npt.NDArray[Any]) -> int:
        """Write a frame's chunk, and return how many bytes that took."""
        chunk = encode_chunk(frame, _LEVEL)  # of black frames, too: one that is not there is a frame that is missing
        with (self._folder / chunk_key(number, frame.ndim)).open("xb") as file:
            file.write(chunk)
            file.write(self._checksum(chunk).to_bytes(4, "little"))
        return len(chunk) + 4

    def commit(self, n_frames: int) -> None:
        """Make the array end with what has been written."""
        self._says["shape"][0] = n_frames
        replace_file(self._metadata, json.dumps(self._says, indent=2).encode())
        self.n_frames = n_frames

    def close(self) -> None:
        """Remove what was not committed; harmless twice."""
        for name in os.listdir(self._folder):
            key = _KEY.fullmatch(name)
            if key is not None and int(key[1]) >= self.n_frames:
                (self._folder / name).unlink()


class ZarrRecording:
    """A recording of ours in a Zarr group; a `Source`.

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
            about = group.attrs[_ATTRIBUTE]
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
            self._array = group[_FRAMES]
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
        chunk = self._path / _FRAMES / self._array.metadata.encode_chunk_key((number, *(0,) * (self._array.ndim - 1)))
        if not chunk.exists():
            return BadFrame(number, "it is missing: its chunk is not there")
        try:
            levels = np.asarray(self._array[number])
        except Exception as error:  # each codec has errors of its own
            return BadFrame(number, f"it is damaged: {' '.join(str(error).split())}")
        return StoredFrame(number, (levels,), self.format)
