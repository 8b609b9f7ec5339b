"""``result.zarr``: the fields of every frame, in a form that other programs read (Zarr v3); see `docs/video.md`.

A frame's chunks are written first, its mark last: what has a mark is whole, whatever happened to the program.
"""

import errno
import json
import os
import re
from collections.abc import Iterator, Sequence, Set
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibration import Calibration
from pipeline.decoding.frame import FIELDS, DecodedFrame
from pipeline.errors import OutputError, SettingsError
from pipeline.files import LEFTOVER, explain, replace_file
from pipeline.settings import DecodeSettings
from pipeline.zarr_chunks import CHUNK_KEYS, chunk_codec, chunk_key, encode_chunk

#: The array that holds the marks.
DONE = "done"

# Of the compressor.
_LEVEL = 5
# A mark is its frame's record as JSON, padded with blanks: whoever finds another length finds a mark cut off.
_MARK_BYTES = 1024
_BLANK = 0x20
_MARK_KEY = re.compile(r"c\.(\d+)\.0")
_LEFTOVERS = (LEFTOVER, ".partial")  # what we, and what zarr, call a file while it is written


def result_attributes(settings: DecodeSettings, calibration: Calibration | None) -> dict[str, Any]:
    """Return what a result says about how it was made: settings, calibration's hash, version; and its range's unit."""
    return {
        "colorphase_version": version("colorphase"),
        "settings": json.loads(settings.model_dump_json()),
        "calibration_sha256": None if calibration is None else calibration.digest(),
        "range_unit": "mm" if calibration is not None and calibration.has_geometry else "rad",
    }


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


class ResultStore:
    """The frames of one footage, each written once and marked when it is safe; never made by being opened.

    Parameters
    ----------
    location : str or Path
        A folder, or an fsspec URL such as ``s3://bucket/result.zarr``.
    identity : dict
        What all its frames share, as JSON: a store that says otherwise is refused.
    fields : sequence of str
        Which of `FIELDS` are stored.

    Attributes
    ----------
    attributes : dict
        What the store says.

    Raises
    ------
    OutputError
        It is not there, or holds something else.
    """

    def __init__(self, location: str | Path, identity: dict[str, Any], fields: Sequence[str]) -> None:
        self.location, self._folder, self._files = _place(location)
        self._fields = tuple(fields)
        found = read_attributes(location)
        if found is None:
            raise OutputError(f"{location} is not there: every worker must see it under this name")
        _refuse_mixing(self.location, found, _whole_identity(identity, fields))
        self.attributes = found

    @classmethod
    def make(
        cls,
        location: str | Path,
        identity: dict[str, Any],
        fields: Sequence[str],
        n_frames: int,
        size_px: tuple[int, int],
        also: dict[str, Any] | None = None,
    ) -> "ResultStore":
        """Make what is missing of a store, and open it.

        Parameters
        ----------
        location, identity, fields
            As above.
        n_frames, size_px
            Of the whole footage: how many frames, their width and height.
        also : dict, optional
            Further attributes of a new store, which an old one keeps as they were.

        Raises
        ------
        OutputError
            The place cannot be written, or holds something else.
        """
        import zarr  # slow to import, and only needed here

        name, folder, _ = _place(location)
        identity = _whole_identity(identity, fields)
        found = read_attributes(location)
        if found is not None:
            _refuse_mixing(name, found, identity)
        lengths = {"y": size_px[1], "x": size_px[0], "xyz": 3, "record": _MARK_BYTES}
        axes: tuple[str, ...]
        fill: float
        with _explained(name, folder):
            group = zarr.open_group(name, mode="a", attributes={**identity, **(also or {})})
            for field in (*fields, DONE):
                if field in group:
                    continue
                if field == DONE:
                    axes, dtype, fill, codec = ("record",), np.dtype(np.uint8), _BLANK, None
                else:
                    axes, dtype, codec = FIELDS[field].axes, np.dtype(FIELDS[field].dtype), chunk_codec(_LEVEL)
                    fill = np.nan if dtype.kind == "f" else 0
                shape = tuple(lengths[axis] for axis in axes)
                group.create_array(
                    field,
                    shape=(n_frames, *shape),
                    chunks=(1, *shape),
                    dtype=dtype,
                    fill_value=fill,
                    compressors=codec,
                    chunk_key_encoding=CHUNK_KEYS,
                    dimension_names=("frame", *axes),
                )
        return cls(location, identity, fields)

    def done(self) -> set[int]:
        """Return the numbers of the frames that are whole."""
        with _explained(self.location, self._folder):
            return done_frames(self.location)

    def check(self, numbers: Set[int]) -> None:
        """Look whether frames that were stored are still there.

        Raises
        ------
        OutputError
            Somebody has removed some, or the whole store.
        """
        lost = numbers - self.done()
        if lost:
            frames = "a frame has" if len(lost) == 1 else f"{len(lost)} frames have"
            raise OutputError(f"{self.location}: {frames} vanished after being stored: run again")

    def write(self, number: int, frame: DecodedFrame) -> None:
        """Write a frame's chunks and, once they are safe, its mark; may be called again, and from several threads.

        Raises
        ------
        OutputError
            The disk is full, or the store is gone.
        """
        with _explained(self.location, self._folder):
            for name in self._fields:
                values = np.asarray(getattr(frame, name))
                values = FIELDS[name].rounded(values, frame.noise_levels, in_mm=frame.calibrated)
                # Unlike zarr never into a store that is gone.
                self._put(name, chunk_key(number, values.ndim), encode_chunk(values, _LEVEL))
            self._put(DONE, chunk_key(number, 1), _mark(frame))

    def _put(self, name: str, key: str, content: bytes) -> None:
        if self._folder is None:
            fs, path = self._files
            fs.pipe_file(f"{path}/{name}/{key}", content)
        else:
            # File systems keep the order in which names appear: the mark's comes after its chunks', power cut or not.
            replace_file(self._folder / name / key, content, safe=True)

    def remove_leftovers(self) -> None:
        """Remove the files that a writer who was killed left half-written; while nobody writes."""
        if self._folder is None:
            return  # elsewhere nothing appears before it is whole
        with _explained(self.location, self._folder):
            for folder in (self._folder, *(self._folder / name for name in (*self._fields, DONE))):
                for name in os.listdir(folder):
                    if name.endswith(_LEFTOVERS):
                        (folder / name).unlink(missing_ok=True)


def done_frames(location: str | Path) -> set[int]:
    """Return the numbers of a store's frames that are whole.

    Raises
    ------
    OSError
        The store cannot be read; each remote file system has errors of its own.
    """
    _, folder, files = _place(location)
    if folder is not None:
        with os.scandir(folder / DONE) as entries:
            sizes = {entry.name: entry.stat().st_size for entry in entries}
    else:
        fs, path = files
        fs.invalidate_cache()
        listed = fs.ls(f"{path}/{DONE}", detail=True)
        sizes = {entry["name"].rpartition("/")[2]: entry["size"] for entry in listed}
    keys = (_MARK_KEY.fullmatch(name) for name, size in sizes.items() if size == _MARK_BYTES)
    return {int(key[1]) for key in keys if key is not None}


def read_attributes(location: str | Path) -> dict[str, Any] | None:
    """Return what a store says of how its frames were decoded; None where there is none yet.

    Raises
    ------
    OutputError
        Something else is there.
    """
    name, folder, files = _place(location)
    try:
        if folder is not None:
            text = (folder / "zarr.json").read_bytes()
        else:
            fs, path = files
            text = fs.cat_file(f"{path}/zarr.json")
        attributes: dict[str, Any] = json.loads(text)["attributes"]
    except (FileNotFoundError, NotADirectoryError):
        if folder is not None and folder.exists() and (folder.is_file() or _holds_others(folder)):
            raise OutputError(f"{name} is not a result of ours: choose another folder") from None
        return None
    except OSError as error:
        raise OutputError(f"cannot read {name}: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError):
        raise OutputError(f"{name} is not a result of ours: choose another folder") from None
    return attributes


def holds_footage(location: Path) -> bool:
    """Whether a store holds more than a picture's result."""
    return location.is_dir() and "footage" in (read_attributes(location) or {})


def write_store(path: Path, frame: DecodedFrame, settings: DecodeSettings, calibration: Calibration | None) -> None:
    """Write one frame as a new store.

    Parameters
    ----------
    path : Path
        The folder to make.
    frame : DecodedFrame
        What to store: each field becomes an array whose first axis is the frame, one chunk a frame.
    settings, calibration
        How it was decoded; kept as attributes.

    Raises
    ------
    OutputError
        The place cannot be written.
    """
    height, width = frame.mask.shape
    fields = chosen_fields(None, in_mm=frame.calibrated)
    ResultStore.make(path, result_attributes(settings, calibration), fields, 1, (width, height)).write(0, frame)


def _place(location: str | Path) -> tuple[str, Path | None, Any]:
    """Return a location's name, and its folder or else its file system and path there.

    Raises
    ------
    OutputError
        No file system for such URLs is installed.
    """
    name = str(location)
    if "://" not in name:
        return name, Path(location), None
    try:
        from fsspec.core import url_to_fs  # of the extra `cluster`

        return name, None, url_to_fs(name)
    except (ImportError, ValueError) as error:
        raise OutputError(f"cannot write to {name}: {' '.join(str(error).split())}") from None


def _holds_others(folder: Path) -> bool:
    """Whether a folder holds more than what is left of a store whose making was interrupted."""
    return any(not name.endswith(_LEFTOVERS) for name in os.listdir(folder))


def _whole_identity(identity: dict[str, Any], fields: Sequence[str]) -> dict[str, Any]:
    """Return what all frames of a store share, as it reads once it is written as JSON."""
    whole: dict[str, Any] = json.loads(json.dumps({**identity, "fields": list(fields)}))
    return whole


@contextmanager
def _explained(name: str, folder: Path | None) -> Iterator[None]:
    """Turn what a file system raises into one line; no folder: a remote one."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        gone = error.errno == errno.ENOENT
        what = "it has vanished: bring its disk back, and run again" if gone else explain(error)
        raise OutputError(f"cannot write {name}: {what}") from error
    except Exception as error:
        if folder is not None:
            raise
        # Each remote file system has errors of its own.
        raise OutputError(f"cannot write {name}: {' '.join(str(error).split())}") from error


def _refuse_mixing(name: str, found: dict[str, Any], identity: dict[str, Any]) -> None:
    if "settings" not in found:
        raise OutputError(f"{name} is not a result of ours: choose another folder")
    there, here = _flat({key: found.get(key) for key in identity}), _flat(identity)
    for key in {**here, **there}:  # what is null on one side has no key of its own on the other
        if there.get(key) != here.get(key):
            was, now = json.dumps(there.get(key)), json.dumps(here.get(key))
            raise OutputError(
                f"{name} holds frames made otherwise ({key} is {was} there, {now} here): choose another folder, or run "
                "as before"
            )


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat.update(_flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value})
    return flat


def _mark(frame: DecodedFrame) -> bytes:
    """Return what is known of a frame as a whole, as JSON."""
    record = {
        "period_px": None if frame.period_px is None else float(frame.period_px),
        "noise_levels": float(frame.noise_levels),
        "constant_known": bool(frame.constant_known),
    }
    warnings = list(frame.warnings)
    while len(text := json.dumps({**record, "warnings": warnings}).encode()) > _MARK_BYTES:
        warnings.pop()
    return text.ljust(_MARK_BYTES)
