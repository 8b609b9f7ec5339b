"""Write recordings in a Zarr group, a chunk a frame; `footage.zarr_recording` reads them."""

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.files import replace_file
from pipeline.footage.recording_tags import VERSION, RecordingTags
from pipeline.footage.zarr_recording import ATTRIBUTE, FRAMES
from pipeline.models import ImageArray
from pipeline.zarr_chunks import CHUNK_KEYS, chunk_codec, chunk_key, encode_chunk
from tikernels.raw.pixel_format import PixelFormat

_KEY = re.compile(r"c\.(\d+)[.0]*")
# The compressor's level: a higher one takes up to half as long again, for chunks that are 2 % smaller.
_LEVEL = 1
# Threads at most; each compresses and writes a frame by itself, without the interpreter.
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
        group = zarr.open_group(path, mode="w-", attributes={ATTRIBUTE: about})
        group.create_array(
            FRAMES,
            shape=(0, *shape),
            chunks=(1, *shape),
            dtype=np.dtype(format.dtype),
            # A checksum, because one wrong bit would change the rest of a chunk.
            compressors=[chunk_codec(_LEVEL), Crc32cCodec()],
            chunk_key_encoding=CHUNK_KEYS,
        )
        self._folder = path / FRAMES
        self._metadata = self._folder / "zarr.json"
        self._says = json.loads(self._metadata.read_bytes())
        self._checksum = google_crc32c.value
        self.n_frames = 0  # of those committed

    def write(self, number: int, frame: ImageArray) -> int:
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
        """Remove what was not committed; a second call does nothing."""
        for name in os.listdir(self._folder):
            key = _KEY.fullmatch(name)
            if key is not None and int(key[1]) >= self.n_frames:
                (self._folder / name).unlink()
