"""Chunks of Zarr arrays, one a frame: what zarr writes, without the 1.5 ms and more that it needs for each.

Behind every chunk is its CRC-32C, by zarr's codec `crc32c`: one wrong bit would change the rest of a compressed chunk.
"""

import functools
import math
from typing import Any, Literal

import google_crc32c
import numpy as np
import numpy.typing as npt

from pipeline.errors import DamageError

#: Keys without folders of their own: three folders a chunk otherwise.
CHUNK_KEYS: Any = {"name": "default", "separator": "."}
# It takes a quarter of the time of zarr's default, for smaller chunks: `docs/video.md` has the table for results,
# `docs/footage.md` for recordings.
_NAME: Literal["lz4"] = "lz4"
_CHECKSUM_BYTES = 4
# A head of 16 bytes, and the checksum; with a margin.
_MOST_OVERHEAD = 64


def chunk_codecs(level: int | None) -> list[Any]:
    """Return the codecs of zarr that make chunks: compressed, faster (1) or smaller (9), or not (None); and checked."""
    from zarr.codecs import BloscCodec, Crc32cCodec  # slow to import, and only needed where something is stored

    compressors = [] if level is None else [BloscCodec(cname=_NAME, clevel=level, shuffle="bitshuffle")]
    return [*compressors, Crc32cCodec()]


def chunk_key(number: int, n_axes: int) -> str:
    """Return the name of a frame's chunk, in an array of `n_axes` axes in addition to the frames'."""
    return f"c.{number}" + ".0" * n_axes


def chunk_bytes(dtype: npt.DTypeLike, shape: tuple[int, ...]) -> int:
    """Return how many bytes a chunk of such values takes at most: those of noise are longer than the noise."""
    return int(np.dtype(dtype).itemsize) * math.prod(shape) + _MOST_OVERHEAD


def encode_chunk(values: npt.NDArray[Any], level: int) -> bytes:
    """Return a frame's chunk as `chunk_codecs` make it; from any number of threads at once."""
    values = np.asarray(values, order="C")
    content: bytes = _compressor(level).encode(values.astype(values.dtype.newbyteorder("<"), copy=False))
    return with_checksum(content)


def decode_chunk(chunk: bytes, dtype: npt.DTypeLike, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Return what `encode_chunk` was given.

    Raises
    ------
    DamageError
        It is not as it was written.
    """
    content = without_checksum(chunk)
    # A chunk of blosc states the length of its content at its fifth byte, and its own length at its thirteenth.
    if int.from_bytes(content[4:8], "little") != np.dtype(dtype).itemsize * math.prod(shape):
        raise DamageError("it holds another number of values")
    if int.from_bytes(content[12:16], "little") != len(content):
        raise DamageError("it is cut off")
    values = np.empty(shape, np.dtype(dtype).newbyteorder("<"))
    try:
        _compressor(1).decode(content, values)
    except (RuntimeError, ValueError) as error:  # blosc's errors on what it has not written
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
    from numcodecs import Blosc

    chunk_codecs(level)  # importing zarr's codecs makes blosc work in the thread that calls it
    return Blosc(_NAME, clevel=level, shuffle=Blosc.BITSHUFFLE)
