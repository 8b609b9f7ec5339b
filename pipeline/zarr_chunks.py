"""Zarr arrays (v3) as zarr writes them, without its import of 0.2 s, and the 1.5 ms that it needs for a chunk.

Behind every chunk is its CRC-32C, by zarr's codec `crc32c`: one wrong bit would change the rest of a compressed chunk.
"""

import functools
import json
import math
from collections.abc import Sequence
from typing import Any

import google_crc32c
import numpy as np
import numpy.typing as npt

from pipeline.errors import DamageError

# It takes a quarter of the time of zarr's default, for smaller chunks: `docs/video.md` has the table for results,
# `docs/footage.md` for recordings.
_NAME = "lz4"
_CHECKSUM_BYTES = 4
# A head of 16 bytes, and the checksum; with a margin.
_MOST_OVERHEAD = 64


def array_metadata(
    shape: tuple[int, ...],
    chunk: tuple[int, ...],
    dtype: npt.DTypeLike,
    level: int | None,
    axes: Sequence[str] | None = None,
    fill_value: float | str | None = None,
    attributes: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the ``zarr.json`` of an array.

    Parameters
    ----------
    shape, chunk : tuple of int
        Of the array, and of each of its chunks.
    dtype : dtype
        Of its values; str: text.
    level : int, optional
        Chunks are compressed, faster (1) or smaller (9), or not (None); and checked.
    axes, fill_value, attributes
        Names of the axes, the value of a missing chunk (0 or an empty text if it is left out), and the array's labels.
    """
    text = dtype is str
    first: dict[str, Any] = {"name": "vlen-utf8", "configuration": {}} if text else {"name": "bytes"}
    if not text and np.dtype(dtype).itemsize > 1:
        first["configuration"] = {"endian": "little"}
    codecs = [first]
    if level is not None:
        about = {"typesize": np.dtype(dtype).itemsize, "cname": _NAME, "clevel": level, "shuffle": "bitshuffle"}
        codecs.append({"name": "blosc", "configuration": {**about, "blocksize": 0}})
    return {
        "shape": shape,
        "data_type": "string" if text else np.dtype(dtype).name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        # Without folders of their own: three folders a chunk otherwise.
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
        "fill_value": ("" if text else np.dtype(dtype).type(0).item()) if fill_value is None else fill_value,
        "codecs": [*codecs, {"name": "crc32c"}],
        "attributes": attributes or {},
        **({} if axes is None else {"dimension_names": axes}),
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }


def group_metadata(attributes: dict[str, Any]) -> dict[str, Any]:
    """Return the ``zarr.json`` of a group."""
    return {"attributes": attributes, "zarr_format": 3, "node_type": "group"}


def as_text(metadata: dict[str, Any]) -> bytes:
    """Return metadata as it is stored."""
    return json.dumps(metadata, indent=2).encode()


def chunk_key(number: int, n_axes: int) -> str:
    """Return the name of a frame's chunk, in an array of `n_axes` axes beside the frames'."""
    return f"c.{number}" + ".0" * n_axes


def chunk_bytes(dtype: npt.DTypeLike, shape: tuple[int, ...]) -> int:
    """Return how many bytes a chunk of such values takes at most: those of noise are longer than the noise."""
    return int(np.dtype(dtype).itemsize) * math.prod(shape) + _MOST_OVERHEAD


def encode_chunk(values: npt.NDArray[Any], level: int) -> bytes:
    """Return an array's chunk, compressed and checked; from any number of threads at once."""
    values = np.asarray(values, order="C")
    content: bytes = _compressor(level).encode(values.astype(values.dtype.newbyteorder("<"), copy=False))
    return with_checksum(content)


def encode_texts(values: Sequence[str]) -> bytes:
    """Return a chunk of texts, checked."""
    texts = [value.encode() for value in values]
    counted = b"".join(len(text).to_bytes(4, "little") + text for text in texts)
    return with_checksum(len(texts).to_bytes(4, "little") + counted)


def decode_chunk(chunk: bytes, dtype: npt.DTypeLike, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Return what `encode_chunk` was given.

    Raises
    ------
    DamageError
        It is not as it was written.
    """
    content = without_checksum(chunk)
    # A chunk of blosc says at its fifth byte how long its content is, and at its thirteenth how long it is itself.
    if int.from_bytes(content[4:8], "little") != np.dtype(dtype).itemsize * math.prod(shape):
        raise DamageError("it holds another number of values")
    if int.from_bytes(content[12:16], "little") != len(content):
        raise DamageError("it is cut off")
    values = np.empty(shape, np.dtype(dtype).newbyteorder("<"))
    try:
        _compressor(1).decode(content, values)
    except (RuntimeError, ValueError) as error:  # what blosc makes of what it has not written
        raise DamageError(str(error)) from None
    return values.astype(np.dtype(dtype), copy=False)


def with_checksum(content: bytes) -> bytes:
    """Return content followed by its CRC-32C."""
    checksum: int = google_crc32c.value(content)
    return content + checksum.to_bytes(_CHECKSUM_BYTES, "little")


def without_checksum(content: bytes) -> bytes:
    """Return what `with_checksum` was given.

    Raises
    ------
    DamageError
        It is not as it was written.
    """
    inside, checksum = content[:-_CHECKSUM_BYTES], content[-_CHECKSUM_BYTES:]
    if len(content) < _CHECKSUM_BYTES or google_crc32c.value(inside).to_bytes(_CHECKSUM_BYTES, "little") != checksum:
        raise DamageError("its checksum is another one")
    return inside


@functools.cache
def _compressor(level: int) -> Any:
    from numcodecs import Blosc, blosc  # slow to import, and only needed where something is stored or read

    blosc.use_threads = False  # it works in the thread that calls it, of which there are several
    return Blosc(_NAME, clevel=level, shuffle=Blosc.BITSHUFFLE)
