"""What a ``result.zarr`` says of itself: its attributes and arrays, with a checksum over all of it.

What it says is labelled by the CF conventions, as xarray reads them: units, coordinates, the time of each frame. The
times are the footage's, known before its first frame is decoded, so coordinates are written with the metadata.

The attribute `metadata_sha256` is a SHA-256 of the group's ``zarr.json`` without that attribute, followed by those of
the arrays and the chunks of the coordinates in the order of their keys: whatever changes one of them, a wrong bit or an
editor, is noticed.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.decoding.frame import FIELDS
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
from pipeline.footage.frame_times import FrameTimes
from pipeline.output.store_files import LEFTOVERS, StoreFiles
from pipeline.zarr_chunks import CHUNK_KEYS, chunk_codecs, chunk_key, decode_chunk

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
        What the store says of its frames, as JSON.
    fields : sequence of str
        Which of `FIELDS` are stored.
    n_frames, size_px
        Of the whole footage: how many frames, their width and height.
    times : FrameTimes, optional
        When they were taken, where that is known.
    """
    import zarr  # slow to import, and only needed here

    coordinates = _coordinates(attributes, fields, n_frames, size_px, times)
    labels = {**dataset_labels(attributes.get("colorphase_version")), "coordinates": " ".join(coordinates)}
    lengths = {"y": size_px[1], "x": size_px[0], "xyz": 3, "rgb": 3, "record": MARK_BYTES}
    held: dict[str, Any] = {}
    group = zarr.create_group(zarr.storage.MemoryStore(held), attributes={**labels, **attributes})
    for name in (*fields, DONE):
        axes = ("record",) if name == DONE else FIELDS[name].axes
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
            attributes=_described(name, attributes, timed=times is not None),
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
    return {**frame_coordinates(n_frames, *known), **axis_coordinates(axes, size_px, corner)}


def _described(name: str, attributes: dict[str, Any], *, timed: bool) -> dict[str, Any]:
    """Return what an array says of itself; with `timed` frames have times, which CF has every array name."""
    if name == DONE:
        labels = {"long_name": "record of each frame that is whole, as JSON", "comment": "blank: it is not done"}
    else:
        labels = field_labels(name, FIELDS[name], attributes.get("range_unit", "rad"))
    return {**labels, **({"coordinates": "time"} if timed else {})}


def read_metadata(files: StoreFiles) -> tuple[dict[str, Any], dict[str, tuple[int, ...]]] | None:
    """Return a store's attributes, and the shape of each of its arrays; None where there is no store yet.

    Labels and coordinates, which follow from the others and from the footage, are checked and left out.

    Raises
    ------
    DamageError
        It is a result, but its metadata is not as it was written.
    OutputError
        Something else is there, or it cannot be read.
    """
    foreign = OutputError(f"{files.name} is not a result of ours: choose another folder")
    try:
        content = _content(files, _METADATA)
        about = _parsed(files, _METADATA, content)
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
    attributes = about.get("attributes")
    if not isinstance(attributes, dict) or not {"settings", "colorphase_version"} <= attributes.keys():
        if not _holds_marks(files):
            raise foreign
        raise DamageError(f"{files.name}: {_METADATA} is not what was written")
    try:
        coordinates = attributes.get("coordinates", "").split()  # stores that an earlier version made have none
        if not set(coordinates) <= set(COORDINATES):
            raise KeyError("coordinates")
        names = [f"{name}/{_METADATA}" for name in (*attributes["fields"], DONE)]
        names += [f"{name}/{key}" for name in coordinates for key in (_METADATA, _VALUES)]
        held = {key: _content(files, key) for key in names}
    except (FileNotFoundError, NotADirectoryError, KeyError, TypeError, AttributeError) as error:
        raise DamageError(f"{files.name}: the metadata of an array is missing ({error})") from None
    if attributes.get(_CHECKSUM) != _digest(about, held) or content != _text(about):
        raise DamageError(f"{files.name}: its metadata is not what was written")
    shapes = {
        name: tuple(json.loads(held[f"{name}/{_METADATA}"])["shape"]) for name in sorted((*attributes["fields"], DONE))
    }
    return {name: value for name, value in attributes.items() if name not in (_CHECKSUM, *DATASET_LABELS)}, shapes


def read_times(files: StoreFiles) -> FrameTimes | None:
    """Return when the frames of a store whose metadata is whole were taken; None: nothing has told.

    Raises
    ------
    DamageError
        The metadata is no longer whole.
    """
    try:
        about = json.loads(files.read(f"time/{_METADATA}"))
        chunk = files.read(f"time/{_VALUES}")
    except OSError:
        return None
    _, _, since = about["attributes"]["units"].partition(" since ")
    return FrameTimes(decode_chunk(chunk, np.float64, tuple(about["shape"])), since or None)


def _content(files: StoreFiles, key: str) -> bytes:
    """Return a file of metadata.

    Raises
    ------
    FileNotFoundError, NotADirectoryError
        It is not there.
    OutputError
        It cannot be read.
    """
    try:
        return files.read(key)
    except (FileNotFoundError, NotADirectoryError):
        raise
    except OSError as error:
        raise OutputError(f"cannot read {files.name}: {error.strerror or error}") from None


def _parsed(files: StoreFiles, key: str, content: bytes) -> dict[str, Any]:
    """Return what a file of metadata says.

    Raises
    ------
    DamageError
        It is not JSON.
    """
    try:
        parsed = json.loads(content) if len(content) <= _MOST_BYTES else None
    except (ValueError, RecursionError):
        parsed = None
    if not isinstance(parsed, dict):
        raise DamageError(f"{files.name}: {key} is not what was written")
    return parsed


def _half_made(files: StoreFiles) -> bool:
    """Whether nothing is there but what an interrupted making of a store leaves: the group's own file is its last."""
    there = files.entries()
    if there is None:
        return False
    arrays = {name: held for name, held in there.items() if name in FIELDS or name in (DONE, *COORDINATES)}
    written = {name: {_METADATA, _VALUES} if name in COORDINATES else {_METADATA} for name in arrays}
    inside = (key for name, held in arrays.items() for key in held if key not in written[name])
    return all(name.endswith(LEFTOVERS) for name in (*(there.keys() - arrays.keys()), *inside))


def _holds_marks(files: StoreFiles) -> bool:
    """Whether a store without readable metadata is one of ours."""
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
