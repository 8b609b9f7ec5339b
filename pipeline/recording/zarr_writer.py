"""Write recordings in a Zarr group, a chunk per frame, and finish what a killed program left of one.

`footage.zarr_recording` reads them.
"""

import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import DamageError, FootageError, OutputError
from pipeline.files import LEFTOVER, explain, replace_file, sync
from pipeline.footage.zarr_recording import ATTRIBUTE, FRAMES, VERSION, RecordingTags
from pipeline.limits import MOST_FRAMES, read_text
from pipeline.locking import locked
from pipeline.models import ImageArray
from pipeline.zarr_chunks import CHUNK_KEYS, chunk_codecs, chunk_key, encode_chunk
from tikernels.raw.pixel_format import PixelFormat

#: What a recording's name has before its ending until it is finished.
PART = ".part"
_KEY = re.compile(r"c\.(\d+)[.0]*")
# The compressor's level: a higher one takes up to half as long again, for chunks that are 2 % smaller.
_LEVEL = 1
#: How many threads may write frames; each compresses and writes one by itself, without the interpreter.
MOST_THREADS = min(4, os.cpu_count() or 1)


class ZarrWriter:
    """Write frames as chunks behind the array's end, which a commit moves.

    Parameters
    ----------
    path : Path
        The group, which must not exist.
    size_px : (int, int)
        Width and height of every frame.
    format, tags
        How they are stored, and what the recording states of itself.

    Raises
    ------
    OSError
        It cannot be written.
    """

    def __init__(self, path: Path, size_px: tuple[int, int], format: PixelFormat, tags: RecordingTags) -> None:
        import zarr  # slow to import, and only needed here

        about: dict[str, Any] = {
            "version": VERSION,
            "layout": format.layout,
            "bits": format.bits,
            "bayer": tags.bayer,
            "transfer": tags.transfer,
            "rate_hz": str(tags.rate_hz),
        }
        if tags.sensor is not None:
            about["sensor"] = tags.sensor.model_dump(mode="json")
        (shape,) = format.plane_shapes(size_px[1], size_px[0])
        group = zarr.open_group(path, mode="w-", attributes={ATTRIBUTE: about})
        group.create_array(
            FRAMES,
            shape=(0, *shape),
            chunks=(1, *shape),
            dtype=np.dtype(format.dtype),
            compressors=chunk_codecs(_LEVEL),
            chunk_key_encoding=CHUNK_KEYS,
        )
        sync(path / FRAMES, path / "zarr.json", path, path.parent)
        self._folder = path / FRAMES
        self._metadata = self._folder / "zarr.json"
        self._says = json.loads(self._metadata.read_bytes())
        self.n_frames = 0  # of those committed

    def write(self, number: int, frame: ImageArray) -> int:
        """Write a frame's chunk, and return how many bytes that took."""
        chunk = encode_chunk(frame, _LEVEL)  # of black frames, too: one that is not there is a frame that is missing
        with (self._folder / chunk_key(number, frame.ndim)).open("xb") as file:
            file.write(chunk)
            file.flush()
            os.fsync(file.fileno())  # here, where several threads wait for the disk at once
        return len(chunk)

    def commit(self, n_frames: int) -> None:
        """Make the array end with what has been written, on the disk: first the chunks' names, then its length."""
        self._says["shape"][0] = n_frames
        sync(self._folder)
        replace_file(self._metadata, json.dumps(self._says, indent=2).encode(), safe=True)
        sync(self._folder)
        self.n_frames = n_frames

    def close(self) -> None:
        """Remove what was not committed; a second call does nothing."""
        _remove_from(self._folder, self.n_frames)


def unfinished(folder: Path) -> Iterator[Path]:
    """Yield the recordings in a folder that have not got their names yet."""
    yield from sorted(folder.glob(f"*{PART}.zarr"))


def finish_recording(part: Path) -> tuple[Path, int]:
    """Cut off what was not committed, and give a recording its name; one without frames is removed.

    Parameters
    ----------
    part : Path
        Recording that a recorder has left, see `unfinished`.

    Returns
    -------
    Path
        The recording.
    int
        Number of frames it holds.

    Raises
    ------
    FootageError
        It cannot be read.
    OutputError
        It is being written, its name is taken, or the folder cannot be written.
    """
    path = part.with_name(part.name.replace(f"{PART}{part.suffix}", part.suffix))
    with locked(path):
        if path.exists():
            raise OutputError(f"cannot finish {part}: {path.name} exists, move it away")
        try:
            n_frames = _cut_off(part)
            if n_frames:
                os.replace(part, path)
            else:
                shutil.rmtree(part)
            sync(path.parent)
        except DamageError as error:
            raise FootageError(f"cannot finish {part}: {error}") from None
        except OSError as error:
            raise OutputError(f"cannot finish {part}: {explain(error)}") from error
    return path, n_frames


def _cut_off(path: Path) -> int:
    """Remove what a program that was killed had written and not committed; return how many frames stay.

    Raises
    ------
    DamageError
        It is no recording of ours.
    OSError
        It cannot be written.
    """
    chunks = any(_KEY.fullmatch(file.name) for file in (path / FRAMES).glob("c.*"))
    try:
        n_frames = json.loads(read_text(path / FRAMES / "zarr.json"))["shape"][0]
    except FileNotFoundError:
        if not chunks:  # it was killed while it made this
            return 0
        raise DamageError(f"{path.name} does not say how many frames it holds") from None
    except (ValueError, KeyError, TypeError, IndexError, RecursionError):
        n_frames = None
    if type(n_frames) is not int or not 0 <= n_frames <= MOST_FRAMES:
        raise DamageError(f"{path.name} does not say how many frames it holds")
    _remove_from(path / FRAMES, n_frames)
    return n_frames


def _remove_from(folder: Path, n_frames: int) -> None:
    """Remove the chunks of frames from a number on, and half-written files."""
    for name in os.listdir(folder):
        key = _KEY.fullmatch(name)
        if (key is not None and int(key[1]) >= n_frames) or name.endswith(LEFTOVER):
            (folder / name).unlink()
