"""How large a ``result.zarr`` will be, and whether its disk holds that: said before hours have gone into it."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.decoding.frame import FIELDS, DecodedFrame
from pipeline.errors import OutputError
from pipeline.output.store_files import StoreFiles
from pipeline.output.store_metadata import LEVEL, MARK_BYTES
from pipeline.zarr_chunks import encode_chunk

# What a chunk may hold beside its values that do not compress: Blosc's head is 16 bytes, the checksum 4.
_CHUNK_HEAD_BYTES = 20
# Frames of one footage differ in how much of them is measured, and so in size; an estimate from one of them is not
# taken to be this many times too large.
_SURELY = 2.0
# Bytes; less is no question on any disk.
_WORTH_SAYING = 100e6


def stored_chunk(name: str, frame: DecodedFrame) -> bytes:
    """Return a field of a frame as it is stored: rounded, compressed, and with its checksum."""
    values = np.asarray(getattr(frame, name))
    return encode_chunk(FIELDS[name].rounded(values, frame.noise_levels, in_mm=frame.calibrated), LEVEL)


def frame_bytes(frame: DecodedFrame, fields: Sequence[str]) -> int:
    """Return how many bytes a frame takes in a store."""
    return sum(len(stored_chunk(name, frame)) for name in fields) + MARK_BYTES


def most_frame_bytes(fields: Sequence[str], size_px: tuple[int, int]) -> int:
    """Return how many bytes a frame takes at most, where nothing of it can be compressed.

    >>> most_frame_bytes(["mask"], (640, 480))  # a byte a pixel
    308244
    """
    lengths = {"y": size_px[1], "x": size_px[0], "xyz": 3, "rgb": 3}
    counts = {name: int(np.prod([lengths[axis] for axis in FIELDS[name].axes], dtype=np.int64)) for name in fields}
    values = sum(count * np.dtype(FIELDS[name].dtype).itemsize for name, count in counts.items())
    return values + len(fields) * _CHUNK_HEAD_BYTES + MARK_BYTES


def mean_frame_bytes(location: str | Path, fields: Sequence[str]) -> float | None:
    """Return how many bytes a frame takes on average of those that a store holds; None: there is none.

    Raises
    ------
    OutputError
        The store cannot be read.
    """
    files = StoreFiles(location)
    with files.explained():
        sizes = [[size for key, size in files.sizes(name).items() if key.startswith("c.")] for name in fields]
    if not all(sizes):
        return None
    return sum(sum(of_field) / len(of_field) for of_field in sizes) + MARK_BYTES


def free_bytes(location: str | Path) -> int | None:
    """Return how many bytes are free on the disk of a place; None where that is not known, as behind a URL."""
    if "://" in str(location):
        return None
    place = Path(location).absolute()
    try:
        return shutil.disk_usage(next(folder for folder in (place, *place.parents) if folder.exists())).free
    except (OSError, StopIteration):
        return None


class SizeForecast:
    """How much a run will add to a store: at first by one frame, then by those that it has stored.

    Parameters
    ----------
    location : str
        The store.
    n_frames : int
        How many frames will be written.
    most_bytes : int
        What one takes at most; see `most_frame_bytes`.
    frame_bytes : float or None
        What one takes, by a frame like it; None: there was none to ask.
    """

    def __init__(self, location: str, n_frames: int, most_bytes: int, frame_bytes: float | None) -> None:
        self._location, self._n_frames = location, n_frames
        self._most, self._frame_bytes = n_frames * most_bytes, frame_bytes
        self._n_stored = self._stored = 0

    def check(self) -> str | None:
        """Compare what is to be written with what is free, before it is written.

        Returns
        -------
        str or None
            What the user should know: how much it will be, or that it may not fit. None: it is little.

        Raises
        ------
        OutputError
            It surely does not fit.
        """
        free = free_bytes(self._location)
        if self._frame_bytes is None:
            if self._most < _WORTH_SAYING:
                return None
            return f"note: {self._location} will grow by {in_bytes(self._most)} at most, by less where it compresses"
        expected = self._n_frames * self._frame_bytes
        sizes = f"about {in_bytes(expected)}, at most {in_bytes(self._most)}"
        if free is None or expected <= free:
            return None if expected < _WORTH_SAYING else f"note: {self._location} will grow by {sizes}"
        doubt = (
            f"{self._location} will grow by {sizes}, and {in_bytes(free)} are free on its disk: choose fewer --fields, "
            "part of the frames by --stop or --step, or another disk"
        )
        if expected > _SURELY * free:
            raise OutputError(doubt)
        return f"warning: {doubt}"

    def corrected_by(self, n_bytes: int) -> str | None:
        """Count a stored frame; return how much all of them will be, or None where it is little."""
        self._n_stored += 1
        self._stored += n_bytes
        expected = self._stored / self._n_stored * self._n_frames
        return None if expected < _WORTH_SAYING else in_bytes(expected)


def in_bytes(count: float) -> str:
    """Return a size as people say it.

    >>> in_bytes(2.14e9), in_bytes(87_654_321), in_bytes(5_100), in_bytes(0)
    ('2.1 GB', '88 MB', '5.1 kB', '0 bytes')
    """
    for unit, name in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= unit:
            return f"{count / unit:.{1 if count < 10 * unit else 0}f} {name}"
    return f"{count:.0f} bytes"
