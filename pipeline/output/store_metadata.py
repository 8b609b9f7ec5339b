"""What a ``result.zarr`` says of itself: its attributes and arrays, with a checksum over all of it.

The attribute `metadata_sha256` is a SHA-256 of the group's ``zarr.json`` without that attribute, followed by those of
the arrays in the order of their names: whatever changes one of them, a wrong bit or an editor, is noticed.
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from pipeline.decoding.frame import FIELDS
from pipeline.errors import DamageError, OutputError
from pipeline.output.store_files import LEFTOVERS, StoreFiles
from pipeline.zarr_chunks import CHUNK_KEYS, chunk_codecs

#: The array that holds the marks, and how many bytes a mark is: a frame's record as JSON, padded with blanks.
DONE, MARK_BYTES = "done", 1024
#: Of the compressor.
LEVEL = 5

_CHECKSUM = "metadata_sha256"
_METADATA = "zarr.json"
_BLANK = 0x20
# Larger ones are not ours: the attributes take a few kB, most of them what is known of the light.
_MOST_BYTES = 2**20


def new_metadata(
    attributes: dict[str, Any], fields: Sequence[str], n_frames: int, size_px: tuple[int, int]
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
    """
    import zarr  # slow to import, and only needed here

    lengths = {"y": size_px[1], "x": size_px[0], "xyz": 3, "rgb": 3, "record": MARK_BYTES}
    held: dict[str, Any] = {}
    group = zarr.create_group(zarr.storage.MemoryStore(held), attributes=attributes)
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
            attributes=_described(name, attributes),
        )
    files = {key: content.to_bytes() for key, content in held.items() if key != _METADATA}
    about = json.loads(held[_METADATA].to_bytes())
    about["attributes"][_CHECKSUM] = _digest(about, [files[key] for key in sorted(files)])
    return {**files, _METADATA: _text(about)}


def _described(name: str, attributes: dict[str, Any]) -> dict[str, Any]:
    """Return what an array says of itself, by the names that xarray and CF (Climate and Forecast) conventions use."""
    if name == DONE:
        return {"long_name": "record of each frame that is whole, as JSON"}
    unit = FIELDS[name].unit
    unit = attributes.get("range_unit", "rad") if unit == "range" else unit
    meaning = " ".join(FIELDS[name].meaning.split())
    return {"long_name": name.replace("_", " "), "comment": meaning, **({} if unit is None else {"units": unit})}


def read_metadata(files: StoreFiles) -> tuple[dict[str, Any], dict[str, tuple[int, ...]]] | None:
    """Return a store's attributes, and the shape of each of its arrays; None where there is no store yet.

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
        arrays = {name: _content(files, f"{name}/{_METADATA}") for name in sorted((*attributes["fields"], DONE))}
    except (FileNotFoundError, NotADirectoryError, KeyError, TypeError) as error:
        raise DamageError(f"{files.name}: the metadata of an array is missing ({error})") from None
    if attributes.get(_CHECKSUM) != _digest(about, arrays.values()) or content != _text(about):
        raise DamageError(f"{files.name}: its metadata is not what was written")
    shapes = {name: tuple(json.loads(array)["shape"]) for name, array in arrays.items()}
    return {name: value for name, value in attributes.items() if name != _CHECKSUM}, shapes


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
    arrays = {name: held for name, held in there.items() if name in FIELDS or name == DONE}
    names = [*(there.keys() - arrays.keys()), *(name for held in arrays.values() for name in held if name != _METADATA)]
    return all(name.endswith(LEFTOVERS) for name in names)


def _holds_marks(files: StoreFiles) -> bool:
    """Whether a store without readable metadata is one of ours."""
    try:
        return any(name.startswith("c.") for name in files.sizes(DONE))
    except OSError:
        return False


def _text(about: dict[str, Any]) -> bytes:
    return json.dumps(about, indent=2).encode()


def _digest(about: dict[str, Any], arrays: Iterable[bytes]) -> str:
    attributes = {name: value for name, value in about["attributes"].items() if name != _CHECKSUM}
    return hashlib.sha256(b"\n".join([_text({**about, "attributes": attributes}), *arrays])).hexdigest()
