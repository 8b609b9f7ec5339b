"""``result.zarr``: the fields of every frame, in a form that other programs read (Zarr v3); see `docs/video.md`.

A frame's chunks are written first, its mark last, once they are on the disk: a frame with a mark is complete, whatever
happened to the program or the machine. The size of the store, and whether its disk holds it, is estimated at the start.
"""

import json
import shutil
from collections.abc import Callable, Iterable, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibration import Calibration
from pipeline.decoding.frame import FIELDS, DecodedFrame
from pipeline.decoding.labels import COORDINATES
from pipeline.errors import DamageError, OutputError, SettingsError
from pipeline.files import make_folder
from pipeline.footage.frame_times import FrameTimes
from pipeline.output.store_files import (
    DONE,
    LEVEL,
    MARK_BYTES,
    FrameMark,
    OtherFrame,
    StoreFiles,
    frame_fault,
    identity_digest,
    marked_frames,
    new_metadata,
    read_mark,
    read_metadata,
)
from pipeline.zarr_chunks import chunk_key, encode_chunk

# Threads that check whether frames are complete: reading and checksums release the interpreter.
_READERS = 4

# What a chunk may hold in addition to values that do not compress: Blosc's head is 16 bytes, the checksum 4.
_CHUNK_HEAD_BYTES = 20
# Frames of one footage differ in how much of them is measured, and so in size; an estimate from one of them is not
# taken to be this many times too large.
_SURELY = 2.0
# Bytes; less is no question on any disk.
WORTH_SAYING = 100e6


def camera_attribute(calibration: Calibration | None) -> dict[str, Any]:
    """Return a store's description of the camera whose pixels it holds, for programs that need its lens."""
    lens = None if calibration is None else calibration.camera
    return {"camera": None if lens is None else json.loads(lens.model_dump_json())}


def chosen_fields(names: Sequence[str] | None, *, in_mm: bool) -> tuple[str, ...]:
    """Return the fields to store, in their usual order; None: all that there are.

    Raises
    ------
    SettingsError
        There is no such field, or not without a calibration.
    """
    there = [name for name, field in FIELDS.items() if in_mm or not field.in_mm]
    for name in names or ():
        if name not in FIELDS:
            raise SettingsError(f"no field is called {name!r}: choose of {', '.join(FIELDS)}")
        if name not in there:
            raise SettingsError(f"{name} needs a calibration with a geometry: add --calibration, or leave it out")
    return tuple(name for name in there if names is None or name in names)


@dataclass(frozen=True)
class WrittenFrame:
    """A frame whose chunks are written, and which has no mark yet."""

    number: int
    mark: FrameMark
    n_bytes: int  # of its chunks and its mark


class ResultStore:
    """The frames of one footage, each written once and marked when it is safe; never made by being opened.

    Parameters
    ----------
    location : str or Path
        A folder, or an fsspec URL such as ``s3://bucket/result.zarr``.
    identity : dict
        Attributes that all its frames share, as JSON: a store with others is refused.
    fields : sequence of str
        Those of `FIELDS` that are stored.

    Attributes
    ----------
    says : StoreAttributes
        The store's attributes.

    Raises
    ------
    OutputError
        It is not there, is damaged, or holds something else.
    """

    def __init__(self, location: str | Path, identity: dict[str, Any], fields: Sequence[str]) -> None:
        self._files = StoreFiles(location)
        self._fields = tuple(fields)
        whole = _whole_identity(identity, fields)
        try:
            found = read_metadata(self._files)
        except DamageError as error:
            raise OutputError(f"{error}: run again, which repairs it") from None
        if found is None:
            raise OutputError(f"{location} is not there: every worker must see it under this name")
        self.says, self._shapes, self._n_frames = found.says, found.shapes, found.n_frames
        _refuse_mixing(self._files.name, found.attributes, whole)
        self._identity = identity_digest(whole)

    @classmethod
    def make(
        cls,
        location: str | Path,
        identity: dict[str, Any],
        fields: Sequence[str],
        n_frames: int,
        size_px: tuple[int, int],
        also: dict[str, Any] | None = None,
        times: FrameTimes | None = None,
    ) -> "ResultStore":
        """Make a store, or write a damaged one's metadata anew; and open it.

        Parameters
        ----------
        location, identity, fields
            As above.
        n_frames, size_px
            Number of frames of the whole footage, their width and height.
        also : dict, optional
            Further attributes of a new store, which an old one keeps as they were.
        times : FrameTimes, optional
            Times of the frames, where they are known.

        Raises
        ------
        OutputError
            The place cannot be written, or holds something else.
        """
        files, whole = StoreFiles(location), _whole_identity(identity, fields)
        try:
            there = read_metadata(files) is not None
        except DamageError:
            there = False
            _refuse_others(files, identity_digest(whole))
        if not there:
            with files.explained():
                content = new_metadata({**whole, **(also or {})}, fields, n_frames, size_px, times)
                for key, text in content.items():  # the group's comes last: if it is there, all are
                    folder = key.rpartition("/")[0]
                    if files.folder is not None:
                        make_folder(files.folder / folder)
                    files.put(key, text)
                    files.sync_folder(folder)
        return cls(location, identity, fields)

    def done(self) -> set[int]:
        """Return the numbers of the frames that have a mark."""
        with self._files.explained():
            return marked_frames(self._files, self._n_frames)

    def faults(self, numbers: Iterable[int], made_of: Callable[[int], str]) -> dict[int, str]:
        """Check whether frames that have a mark are complete, and return the faults, by number.

        Behind a URL, where reading all may cost more than decoding it anew, only the marks, with the digest of what
        the frame with a number is made of, and the presence of all files are checked.
        """
        numbers = sorted(numbers)
        missing: dict[int, str] = {}
        remote = self._files.folder is None
        if remote:
            with self._files.explained():
                names = {name: self._files.sizes(name).keys() for name in self._fields}
            keys = {name: len(FIELDS[name].axes) for name in self._fields}
            missing = {
                number: f"{name} is missing"
                for number in numbers
                for name in self._fields
                if chunk_key(number, keys[name]) not in names[name]
            }
        read = {} if remote else self._shapes

        def fault(number: int) -> str | None:
            return frame_fault(self._files, number, read, self._identity, made_of(number))

        with ThreadPoolExecutor(_READERS, "check") as readers:
            found = zip(numbers, readers.map(fault, numbers), strict=True)
            return {number: wrong for number, wrong in found if wrong is not None} | missing

    def unmeasured(self, numbers: Iterable[int]) -> list[int]:
        """Return the numbers of those frames, all of which have a mark, in which nothing was measured.

        Raises
        ------
        DamageError
            A mark is damaged.
        """
        numbers = sorted(numbers)
        with ThreadPoolExecutor(_READERS, "marks") as readers:
            marks = readers.map(lambda number: read_mark(self._files, number, self._identity), numbers)
            return [number for number, mark in zip(numbers, marks, strict=True) if mark.measured_px == 0]

    def check(self, numbers: Set[int]) -> None:
        """Check that frames that were stored are still there.

        Raises
        ------
        OutputError
            Some, or the whole store, have been removed.
        """
        lost = numbers - self.done()
        if lost:
            frames = "a frame has" if len(lost) == 1 else f"{len(lost)} frames have"
            raise OutputError(f"{self._files.name}: {frames} vanished after being stored: run again")

    def write(self, number: int, frame: DecodedFrame, made_of: str = "") -> WrittenFrame:
        """Write a frame's chunks, with a digest of its source; may be called again, and from several threads.

        Returns
        -------
        WrittenFrame
            For `commit`, which makes it part of the store.

        Raises
        ------
        OutputError
            The disk is full, or the store is gone.
        """
        chunks = {}
        with self._files.explained():
            for name in self._fields:
                chunks[name] = stored_chunk(name, frame)
                # Unlike zarr never into a store that is gone.
                self._files.put(f"{name}/{chunk_key(number, len(FIELDS[name].axes))}", chunks[name])
        n_bytes = sum(map(len, chunks.values())) + MARK_BYTES
        return WrittenFrame(number, FrameMark.of(frame, self._identity, chunks, made_of), n_bytes)

    def commit(self, frames: Iterable[WrittenFrame]) -> None:
        """Mark frames whose chunks are written, once those are there whatever happens; from any thread.

        Raises
        ------
        OutputError
            The disk is full, or the store is gone.
        """
        with self._files.explained():
            self._files.sync_folder(*self._fields)  # the chunks' content is on the disk, now their names are, too
            for frame in frames:
                self._files.put(f"{DONE}/{chunk_key(frame.number, 1)}", frame.mark.encoded())
            self._files.sync_folder(DONE)

    def unmark(self, numbers: Iterable[int]) -> None:
        """Remove the marks and the values of frames that are incomplete, or other footage's.

        Raises
        ------
        OutputError
            The store cannot be written.
        """
        with self._files.explained():
            for number in numbers:
                self._files.remove(f"{DONE}/{chunk_key(number, 1)}")
                for name in self._fields:  # of a frame that is bad now Zarr would read them
                    self._files.remove(f"{name}/{chunk_key(number, len(FIELDS[name].axes))}")

    def remove_leftovers(self) -> None:
        """Remove the files that a killed writer left half-written; while nobody writes."""
        with self._files.explained():
            coordinates = self._files.folders(COORDINATES)
            self._files.remove_leftovers("", *self._fields, DONE, *coordinates)


def is_there(location: str | Path) -> bool:
    """Return whether a store is there.

    Raises
    ------
    DamageError
        It is, but its metadata is not as it was written.
    OutputError
        Something else is there, or it cannot be read.
    """
    return read_metadata(StoreFiles(location)) is not None


def holds_footage(location: Path) -> bool:
    """Return whether a store holds more than a picture's result.

    Raises
    ------
    OutputError
        Something else is there, or it cannot be read.
    """
    files = StoreFiles(location)
    try:
        found = read_metadata(files)
    except DamageError:
        with files.explained():
            return len(marked_frames(files)) > 1
    return found is not None and found.says.footage is not None


def write_store(path: Path, frame: DecodedFrame) -> None:
    """Write one frame as a new store: each field becomes an array whose first axis is the frame, one chunk per frame.

    Raises
    ------
    OutputError
        The place cannot be written.
    """
    height, width = frame.mask.shape
    fields = chosen_fields(None, in_mm=frame.calibrated)
    camera = camera_attribute(frame.calibration)
    store = ResultStore.make(path, frame.attributes, fields, 1, (width, height), camera)
    store.commit([store.write(0, frame)])


def _whole_identity(identity: dict[str, Any], fields: Sequence[str]) -> dict[str, Any]:
    """Return what all frames of a store share, as it reads once it is written as JSON."""
    whole: dict[str, Any] = json.loads(json.dumps({**identity, "fields": list(fields)}))
    return whole


def _refuse_others(files: StoreFiles, identity: str) -> None:
    """Refuse to repair a store whose frames were decoded otherwise, as far as their marks can be read."""
    numbers: set[int] = set()
    with files.explained(), suppress(FileNotFoundError):
        numbers = marked_frames(files)
    for number in sorted(numbers):
        try:
            read_mark(files, number, identity)
        except OtherFrame:
            raise OutputError(
                f"{files.name} is damaged and holds frames made otherwise: choose another folder, or run as before"
            ) from None
        except DamageError:
            continue


def _refuse_mixing(name: str, found: dict[str, Any], identity: dict[str, Any]) -> None:
    there, here = _flat({key: found.get(key) for key in identity}), _flat(identity)
    for key in {**here, **there}:  # what is null on one side has no key of its own on the other
        if there.get(key) != here.get(key):
            was, now = json.dumps(there.get(key)), json.dumps(here.get(key))
            what = key.removesuffix("_sha256")
            other = f"{key} is {was} there, {now} here" if what == key else f"{what} is another one"
            raise OutputError(f"{name} holds frames made otherwise ({other}): choose another folder, or run as before")


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat.update(_flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value})
    return flat


def stored_chunk(name: str, frame: DecodedFrame) -> bytes:
    """Return a field of a frame as it is stored: rounded, compressed, and with its checksum."""
    values = np.asarray(getattr(frame, name))
    return encode_chunk(FIELDS[name].rounded(values, frame.noise_levels, in_mm=frame.calibrated), LEVEL)


def frame_bytes(frame: DecodedFrame, fields: Sequence[str]) -> int:
    """Return how many bytes a frame takes in a store."""
    return sum(len(stored_chunk(name, frame)) for name in fields) + MARK_BYTES


def most_frame_bytes(fields: Sequence[str], size_px: tuple[int, int]) -> int:
    """Return how many bytes a frame takes at most, where nothing of it can be compressed.

    >>> most_frame_bytes(["mask"], (640, 480))  # a byte per pixel
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
    """Forecast of what a run will add to a store: at first by one frame, then by those that it has stored.

    Parameters
    ----------
    location : str
        The store.
    n_frames : int
        Number of frames to write.
    most_bytes : int
        Largest size of one; see `most_frame_bytes`.
    frame_bytes : float or None
        Size of one, by a frame like it; None: there is no such frame.
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
            A line for the user: the expected size, or that it may not fit. None: it is small.

        Raises
        ------
        OutputError
            It surely does not fit.
        """
        free = free_bytes(self._location)
        if self._frame_bytes is None:
            if self._most < WORTH_SAYING:
                return None
            return f"note: {self._location} will grow by {in_bytes(self._most)} at most, by less where it compresses"
        expected = self._n_frames * self._frame_bytes
        sizes = f"about {in_bytes(expected)}, at most {in_bytes(self._most)}"
        if free is None or expected <= free:
            return None if expected < WORTH_SAYING else f"note: {self._location} will grow by {sizes}"
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
        return None if expected < WORTH_SAYING else in_bytes(expected)


def in_bytes(count: float) -> str:
    """Return a size in a readable unit.

    >>> in_bytes(2.14e9), in_bytes(87_654_321), in_bytes(5_100), in_bytes(0)
    ('2.1 GB', '88 MB', '5.1 kB', '0 bytes')
    """
    for unit, name in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= unit:
            return f"{count / unit:.{1 if count < 10 * unit else 0}f} {name}"
    return f"{count:.0f} bytes"
