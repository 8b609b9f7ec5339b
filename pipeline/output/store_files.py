"""The files of a ``result.zarr``: where they are, the metadata, and the mark of each frame, each with a checksum.

A store is a folder, or what an fsspec URL names. Its metadata is labelled by the CF conventions, as xarray reads them:
units, coordinates, the time of each frame. The times are the footage's, known before its first frame is decoded, so
coordinates are written with the metadata.

The attribute `metadata_sha256` is a SHA-256 of the group's ``zarr.json`` without that attribute, followed by those of
the arrays and the chunks of the coordinates in the order of their keys: whatever changes one of them, a wrong bit or an
editor, is noticed.

A frame that has a mark is complete. The mark lists the checksum of each of the frame's chunks. So a chunk that is
missing, changed, or another frame's is noticed, and so is a frame that was decoded with other settings than its
store's.
"""

import errno
import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from pipeline.decoding.frame import FIELDS, DecodedFrame
from pipeline.decoding.labels import (
    COORDINATES,
    DATASET_LABELS,
    Coordinate,
    axis_coordinates,
    dataset_labels,
    field_labels,
    frame_coordinates,
)
from pipeline.errors import DamageError, OutputError
from pipeline.files import LEFTOVER, explain, replace_file, sync
from pipeline.footage.frame_times import FrameTimes
from pipeline.limits import MOST_FRAMES, check_size, read_plain
from pipeline.output.store_model import ArraySays, GroupSays, StoreAttributes, parsed
from pipeline.zarr_chunks import (
    CHUNK_KEYS,
    chunk_bytes,
    chunk_codecs,
    chunk_key,
    decode_chunk,
    with_checksum,
    without_checksum,
)

#: How the names of files end that we, and zarr, have not finished.
LEFTOVERS = (LEFTOVER, ".partial")

#: The array that holds the marks, and how many bytes a mark is: a frame's record as JSON, padded with blanks.
DONE, MARK_BYTES = "done", 1024
#: Of the compressor.
LEVEL = 5

_CHECKSUM = "metadata_sha256"
_METADATA = "zarr.json"
# A coordinate is one chunk.
_VALUES = chunk_key(0, 0)
_BLANK = 0x20
# Larger ones are not ours: the attributes take a few kB, most of them what is known of the light.
_MOST_BYTES = 2**20

#: The attributes that are estimated from footage, and can be again, or follow from others; its frames depend on the
#: rest.
LEARNT = ("light", "code", "rims", "camera")

_KEY = re.compile(r"c\.(\d{1,18})\.0")
# Bytes of a chunk's checksum, at its end.
_CHUNK_CHECKSUM = slice(-4, None)
_STORED_BYTES = len(with_checksum(bytes(MARK_BYTES)))


class StoreFiles:
    """The files of a store, by their keys: paths in it, with slashes.

    Parameters
    ----------
    location : str or Path
        A folder, or an fsspec URL such as ``s3://bucket/result.zarr``.

    Attributes
    ----------
    name : str
        The location.
    folder : Path or None
        None behind a URL.

    Raises
    ------
    OutputError
        No file system for such URLs is installed.
    """

    def __init__(self, location: str | Path) -> None:
        self.name = str(location)
        self.folder = None if "://" in self.name else Path(location)
        self._remote: Any = None
        self._path = ""
        if self.folder is None:
            try:
                from fsspec.core import url_to_fs  # of the extra `cluster`

                self._remote, self._path = url_to_fs(self.name)
            except (ImportError, ValueError) as error:
                raise OutputError(f"cannot write to {self.name}: {' '.join(str(error).split())}") from None

    def read(self, key: str, most_bytes: int) -> bytes:
        """Return what a file holds.

        Raises
        ------
        FileNotFoundError, NotADirectoryError
            It is not there.
        OSError
            It cannot be read, or is longer than allowed.
        """
        if self.folder is not None:
            return read_plain(self.folder / key, most_bytes)
        with self._as_os_error():
            content: bytes = self._remote.cat_file(f"{self._path}/{key}", end=most_bytes + 1)
        if len(content) > most_bytes:
            raise OSError(errno.EOVERFLOW, f"it is larger than {most_bytes:,} bytes")
        return content

    def put(self, key: str, content: bytes) -> None:
        """Make or replace a file, completely or not at all; its content is on the disk, its name after `sync_folder`.

        Raises
        ------
        OSError
            It cannot be written, or its folder is gone.
        """
        if self.folder is not None:
            replace_file(self.folder / key, content, safe=True)
            return
        with self._as_os_error():
            self._remote.pipe_file(f"{self._path}/{key}", content)

    def remove(self, key: str) -> None:
        """Remove a file, if it is there.

        Raises
        ------
        OSError
            It cannot be removed.
        """
        if self.folder is not None:
            (self.folder / key).unlink(missing_ok=True)
            return
        with suppress(FileNotFoundError), self._as_os_error():
            self._remote.rm_file(f"{self._path}/{key}")

    def sync_folder(self, *keys: str) -> None:
        """Return when the names in folders are on the disk; behind a URL they are."""
        if self.folder is not None:
            sync(*(self.folder / key for key in keys))

    def sizes(self, key: str) -> dict[str, int]:
        """Return the names and the lengths of the files in a folder.

        Raises
        ------
        OSError
            It is not there, or cannot be read.
        """
        if self.folder is not None:
            with os.scandir(self.folder / key) as entries:
                return {entry.name: entry.stat().st_size for entry in entries if entry.is_file()}
        with self._as_os_error():
            self._remote.invalidate_cache()
            listed = self._remote.ls(f"{self._path}/{key}", detail=True)
        return {entry["name"].rpartition("/")[2]: entry["size"] for entry in listed if entry["type"] == "file"}

    def entries(self) -> dict[str, list[str]] | None:
        """Return the names in a folder, and for each that is a folder the names in it; None: it is a file."""
        if self.folder is None or not self.folder.exists():
            return {}
        if self.folder.is_file():
            return None
        return {entry.name: os.listdir(entry) if entry.is_dir() else [] for entry in os.scandir(self.folder)}

    def folders(self, keys: Iterable[str]) -> list[str]:
        """Return which of some names are folders here; behind a URL, where there are none, nothing."""
        return [] if self.folder is None else [key for key in keys if (self.folder / key).is_dir()]

    def remove_leftovers(self, *keys: str) -> None:
        """Remove the files in folders that a killed writer left half-written; while nobody writes."""
        if self.folder is None:
            return  # elsewhere nothing appears before it is complete
        for folder in (self.folder / key for key in keys):
            for name in os.listdir(folder):
                if name.endswith(LEFTOVERS):
                    (folder / name).unlink(missing_ok=True)

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Turn an error of writing into one line."""
        try:
            yield
        except OutputError:
            raise
        except OSError as error:
            gone = error.errno == errno.ENOENT
            what = "it has vanished: bring its disk back, and run again" if gone else explain(error)
            raise OutputError(f"cannot write {self.name}: {what}") from error

    @contextmanager
    def _as_os_error(self) -> Iterator[None]:
        """Turn what a remote file system raises, each its own errors, into one that every system has."""
        try:
            yield
        except OSError:
            raise
        except Exception as error:
            raise OSError(" ".join(str(error).split())) from error


def new_metadata(
    attributes: dict[str, Any],
    fields: Sequence[str],
    n_frames: int,
    size_px: tuple[int, int],
    times: FrameTimes | None = None,
) -> dict[str, bytes]:
    """Return the files that make a store of some frames, by their keys; the group's own comes last.

    Parameters
    ----------
    attributes : dict
        The store's attributes, as JSON.
    fields : sequence of str
        Those of `FIELDS` that are stored.
    n_frames, size_px
        Number of frames of the whole footage, their width and height.
    times : FrameTimes, optional
        Times of the frames, where they are known.
    """
    import zarr  # slow to import, and only needed here

    coordinates = _coordinates(attributes, fields, n_frames, size_px, times)
    labels = {**dataset_labels(attributes.get("colorphase_version")), "coordinates": " ".join(coordinates)}
    lengths = _axis_lengths(size_px)
    held: dict[str, Any] = {}
    group = zarr.create_group(zarr.storage.MemoryStore(held), attributes={**labels, **attributes})
    for name in (*fields, DONE):
        axes = _axes(name)
        dtype = np.dtype(np.uint8 if name == DONE else FIELDS[name].dtype)
        fill = _BLANK if name == DONE else np.nan if dtype.kind == "f" else 0
        shape = tuple(lengths[axis] for axis in axes)
        group.create_array(
            name,
            shape=(n_frames, *shape),
            chunks=(1, *shape),
            dtype=dtype,
            fill_value=fill,
            compressors=chunk_codecs(None if name == DONE else LEVEL),
            chunk_key_encoding=CHUNK_KEYS,
            dimension_names=("frame", *axes),
            attributes=_described(name, attributes, coordinates),
        )
    for name, (axes, values, about_it) in coordinates.items():
        is_text = values.dtype.kind == "O"
        array = group.create_array(
            name,
            shape=values.shape,
            chunks=values.shape,
            dtype=str if is_text else values.dtype,
            fill_value="" if is_text else 0,
            compressors=chunk_codecs(None if is_text else LEVEL),
            chunk_key_encoding=CHUNK_KEYS,
            dimension_names=axes,
            attributes=about_it,
            # A chunk that is all 0 is stored, too: one that is missing has been lost.
            config={"write_empty_chunks": True},
        )
        array[:] = values
    files = {key: content.to_bytes() for key, content in held.items() if key != _METADATA}
    about = json.loads(held[_METADATA].to_bytes())
    about["attributes"][_CHECKSUM] = _digest(about, files)
    return {**files, _METADATA: _text(about)}


def _coordinates(
    attributes: dict[str, Any],
    fields: Sequence[str],
    n_frames: int,
    size_px: tuple[int, int],
    times: FrameTimes | None,
) -> dict[str, Coordinate]:
    """Return the coordinates of a store; rows and columns are the camera's where a part of its picture is decoded."""
    part = attributes.get("region_of_interest")
    corner = (0, 0) if part is None else (part["x"], part["y"])
    axes = {axis for name in fields for axis in FIELDS[name].axes}
    known = () if times is None else (times.seconds, times.since)
    settings = attributes.get("settings", {})
    at_once = n_frames > 1 and settings.get("frame_s") is not None
    rows = axis_coordinates(axes, size_px, corner, settings.get("row_s", 0.0), at_once=at_once)
    return {**frame_coordinates(n_frames, *known), **rows}


def _described(name: str, attributes: dict[str, Any], coordinates: Mapping[str, Coordinate]) -> dict[str, Any]:
    """Return the attributes of an array; CF has every array name the times of its frames and rows."""
    if name == DONE:
        labels = {"long_name": "record of each frame that is whole, as JSON", "comment": "blank: it is not done"}
    else:
        labels = field_labels(name, FIELDS[name], attributes.get("range_unit", "rad"))
    along = {"frame", *_axes(name)}
    times = [key for key, (axes, _, _) in coordinates.items() if key not in axes and along.issuperset(axes)]
    return {**labels, **({"coordinates": " ".join(times)} if times else {})}


@dataclass(frozen=True)
class Metadata:
    """The metadata of a store, which is as it was written."""

    attributes: dict[str, Any]  # all attributes of how its frames were decoded, as JSON
    says: StoreAttributes  # what is read again of them
    shapes: dict[str, tuple[int, ...]]  # of the array of each field, and of the marks; the frames come first
    size_px: tuple[int, int]  # width and height of a frame
    times: FrameTimes | None  # of the frames; None: unknown

    @property
    def n_frames(self) -> int:
        """Number of the footage's frames."""
        return self.shapes[DONE][0]


def read_metadata(files: StoreFiles) -> Metadata | None:
    """Return a store's metadata; None where there is no store yet.

    Labels and coordinates other than the time, which follow from the others, are checked and left out.

    Raises
    ------
    DamageError
        It is a result, but its metadata is not as it was written.
    FootageError
        Its frames are larger than those that are read.
    OutputError
        Something else is there, or it cannot be read.
    """
    foreign = OutputError(f"{files.name} is not a result of ours: choose another folder")
    try:
        content = _content(files, _METADATA)
        says = parsed(GroupSays, content, f"{files.name}: {_METADATA}").attributes
    except (FileNotFoundError, NotADirectoryError):
        if _half_made(files):
            return None
        if not _holds_marks(files):
            raise foreign from None
        raise DamageError(f"{files.name}: {_METADATA} is missing") from None
    except DamageError:
        if not _holds_marks(files):
            raise foreign from None
        raise
    coordinates = says.coordinates.split()
    if not set(coordinates) <= set(COORDINATES):
        raise DamageError(f"{files.name}: the metadata of an array is missing (coordinates)")
    try:
        held, arrays = {}, {}
        for name in (*sorted((*says.fields, DONE)), *coordinates):
            key = f"{name}/{_METADATA}"
            held[key] = _content(files, key)
            arrays[name] = parsed(ArraySays, held[key], f"{files.name}: {key}")
        for name in coordinates:
            most = _MOST_BYTES + chunk_bytes(np.float64, arrays[name].shape)
            held[f"{name}/{_VALUES}"] = _content(files, f"{name}/{_VALUES}", most)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DamageError(f"{files.name}: the metadata of an array is missing ({error})") from None
    about = json.loads(content)
    if about["attributes"].get(_CHECKSUM) != _digest(about, held) or content != _text(about):
        raise DamageError(f"{files.name}: its metadata is not what was written")
    shapes = {name: array.shape for name, array in arrays.items() if name not in coordinates}
    size_px = _checked_size(files.name, shapes)
    attributes = {
        name: value for name, value in about["attributes"].items() if name not in (_CHECKSUM, *DATASET_LABELS)
    }
    times = None
    if "time" in coordinates:
        labels = arrays["time"].attributes
        times = FrameTimes(decode_chunk(held[f"time/{_VALUES}"], np.float64, shapes[DONE][:1]), labels.since)
        if labels.units is None or not times.known:
            raise DamageError(f"{files.name}: time holds no times")
    return Metadata(attributes, says, shapes, size_px, times)


def _checked_size(name: str, shapes: Mapping[str, tuple[int, ...]]) -> tuple[int, int]:
    """Return width and height of a store's frames, if its arrays are for the same number of frames of that size.

    Raises
    ------
    DamageError
        They are not.
    FootageError
        The frames are too large.
    """
    known = {field: shape for field, shape in shapes.items() if field in FIELDS}
    height, width = next((shape[1:3] for shape in known.values() if len(shape) > 2), (0, 0))
    check_size(name, width, height)
    lengths = _axis_lengths((width, height))
    for field, shape in {**known, DONE: shapes[DONE]}.items():
        if shape != shapes[DONE][:1] + tuple(lengths[axis] for axis in _axes(field)):
            raise DamageError(f"{name}: {field} has the shape {shape}, which is not that of a result")
    return width, height


def _axes(name: str) -> tuple[str, ...]:
    """Return the axes of an array behind that of the frames."""
    return ("record",) if name == DONE else FIELDS[name].axes


def _axis_lengths(size_px: tuple[int, int]) -> dict[str, int]:
    return {"y": size_px[1], "x": size_px[0], "xyz": 3, "rgb": 3, "record": MARK_BYTES}


def _content(files: StoreFiles, key: str, most_bytes: int = _MOST_BYTES) -> bytes:
    """Return a file of metadata.

    Raises
    ------
    FileNotFoundError, NotADirectoryError
        It is not there.
    OutputError
        It cannot be read.
    """
    try:
        return files.read(key, most_bytes)
    except (FileNotFoundError, NotADirectoryError):
        raise
    except OSError as error:
        raise OutputError(f"cannot read {files.name}: {error.strerror or error}") from None


def _half_made(files: StoreFiles) -> bool:
    """Return whether only remains of an interrupted creation of a store are there: the group's own file is its last."""
    there = files.entries()
    if there is None:
        return False
    arrays = {name: held for name, held in there.items() if name in FIELDS or name in (DONE, *COORDINATES)}
    written = {name: {_METADATA, _VALUES} if name in COORDINATES else {_METADATA} for name in arrays}
    inside = (key for name, held in arrays.items() for key in held if key not in written[name])
    return all(name.endswith(LEFTOVERS) for name in (*(there.keys() - arrays.keys()), *inside))


def _holds_marks(files: StoreFiles) -> bool:
    """Return whether a store without readable metadata is one of ours."""
    try:
        return any(name.startswith("c.") for name in files.sizes(DONE))
    except OSError:
        return False


def _text(about: dict[str, Any]) -> bytes:
    return json.dumps(about, indent=2).encode()


def _digest(about: dict[str, Any], files: Mapping[str, bytes]) -> str:
    """Return the checksum of the group's metadata and of other files, by their keys."""
    attributes = {name: value for name, value in about["attributes"].items() if name != _CHECKSUM}
    content = (files[key] for key in sorted(files))
    return hashlib.sha256(b"\n".join([_text({**about, "attributes": attributes}), *content])).hexdigest()


class OtherFrame(DamageError):
    """A frame was decoded with other settings than its store's."""


@dataclass(frozen=True)
class FrameMark:
    """The record of a frame as a whole."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    period_px: float | None
    noise_levels: float
    constant_known: bool
    warnings: list[str]
    identity: str  # see `identity_digest`
    chunks: dict[str, str]  # the checksum of each field's chunk, in hexadecimal
    made_of: str  # digest of what it was decoded from; empty: of a single picture
    measured_px: int  # pixels in the mask

    @classmethod
    def of(cls, frame: DecodedFrame, identity: str, chunks: dict[str, bytes], made_of: str) -> "FrameMark":
        """Return a decoded frame's mark."""
        return cls(
            None if frame.period_px is None else float(frame.period_px),
            float(frame.noise_levels),
            bool(frame.constant_known),
            list(frame.warnings),
            identity,
            {name: chunk[_CHUNK_CHECKSUM].hex() for name, chunk in chunks.items()},
            made_of,
            frame.measured_px,
        )

    def encoded(self) -> bytes:
        """Return what is stored: JSON, without the warnings that do not fit, padded with blanks; and its checksum."""
        warnings = list(self.warnings)
        while len(text := json.dumps({**vars(self), "warnings": warnings}).encode()) > MARK_BYTES:
            warnings.pop()
        return with_checksum(text.ljust(MARK_BYTES))


_MARKS = TypeAdapter(FrameMark)


def identity_digest(attributes: dict[str, Any]) -> str:
    """Return a short name of all that a frame's result depends on, except its number."""
    given = {name: value for name, value in attributes.items() if name not in LEARNT}
    return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:16]


def marked_frames(files: StoreFiles, n_frames: int = MOST_FRAMES) -> set[int]:
    """Return the numbers of a store's frames, of so many, that have a mark, which is not read.

    Raises
    ------
    OSError
        The store cannot be read.
    """
    keys = (_KEY.fullmatch(name) for name, size in files.sizes(DONE).items() if size == _STORED_BYTES)
    return {number for key in keys if key is not None and (number := int(key[1])) < n_frames}


def read_mark(files: StoreFiles, number: int, identity: str) -> FrameMark:
    """Return a frame's mark.

    Raises
    ------
    DamageError
        It is not there, is not as it was written, or is that of a frame that was decoded otherwise.
    """
    stored = _read_checked(files, f"{DONE}/{chunk_key(number, 1)}", _STORED_BYTES, "its mark")
    if stored is None:
        raise DamageError("it has no mark, and so is not whole")
    try:
        mark = _MARKS.validate_json(without_checksum(stored))
    except ValueError:
        raise DamageError("its mark is of another program, or of a newer version of this one") from None
    if mark.identity != identity:
        raise OtherFrame("it was decoded with other settings than its store's")
    return mark


def read_chunk(files: StoreFiles, number: int, name: str, shape: tuple[int, ...], mark: FrameMark) -> bytes:
    """Return the chunk of a frame's field, whose array has this shape.

    Raises
    ------
    DamageError
        It is not as it was written, or not there.
    """
    key = f"{name}/{chunk_key(number, len(FIELDS[name].axes))}"
    chunk = _read_checked(files, key, chunk_bytes(FIELDS[name].dtype, shape[1:]), name)
    if chunk is None:
        raise DamageError(f"{name} is missing")
    if chunk[_CHUNK_CHECKSUM].hex() != mark.chunks.get(name):
        raise DamageError(f"{name} is another frame's, or of another run")
    return chunk


def _read_checked(files: StoreFiles, key: str, most_bytes: int, what: str) -> bytes | None:
    """Return a file whose checksum is right, or raise what is wrong with it; None: there is none."""
    try:
        content = files.read(key, most_bytes)
        without_checksum(content)
    except FileNotFoundError:
        return None
    except DamageError as error:
        raise DamageError(f"{what} is damaged: {error}") from None
    except OSError as error:
        raise DamageError(f"{what} cannot be read: {error.strerror or error}") from None
    return content


def frame_fault(
    files: StoreFiles,
    number: int,
    shapes: Mapping[str, tuple[int, ...]],
    identity: str,
    made_of: str | None = None,
) -> str | None:
    """Return the fault of a frame that has a mark; None: all of it is as it was written.

    A digest states what the frame must have been decoded from.
    """
    try:
        mark = read_mark(files, number, identity)
        if made_of not in (None, mark.made_of):
            return "the footage has changed there since it was decoded"
        for name in sorted(shapes.keys() & FIELDS.keys()):
            read_chunk(files, number, name, shapes[name], mark)
    except DamageError as error:
        return str(error)
    return None
