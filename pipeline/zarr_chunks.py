"""Chunks of Zarr arrays, one a frame: what zarr writes, without the 1.5 ms and more that it needs for each."""

import functools
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

#: Keys without folders of their own: three folders a chunk otherwise.
CHUNK_KEYS: Any = {"name": "default", "separator": "."}
# It takes a quarter of the time of zarr's default, for smaller chunks: `docs/video.md` has the table for results,
# `docs/footage.md` for recordings.
_NAME: Literal["lz4"] = "lz4"


def chunk_codec(level: int) -> Any:
    """Return the codec of zarr by which chunks are compressed, faster (1) or smaller (9)."""
    from zarr.codecs import BloscCodec  # slow to import, and only needed where something is stored

    return BloscCodec(cname=_NAME, clevel=level, shuffle="bitshuffle")


def chunk_key(number: int, n_axes: int) -> str:
    """Return the name of a frame's chunk, in an array of `n_axes` axes beside the frames'."""
    return f"c.{number}" + ".0" * n_axes


def encode_chunk(values: npt.NDArray[Any], level: int) -> bytes:
    """Return a frame's chunk as `chunk_codec` makes it; from any number of threads at once."""
    values = np.asarray(values, order="C")
    chunk: bytes = _compressor(level).encode(values.astype(values.dtype.newbyteorder("<"), copy=False))
    return chunk


@functools.cache
def _compressor(level: int) -> Any:
    from numcodecs import Blosc

    chunk_codec(level)  # importing zarr's codecs makes blosc work in the thread that calls it
    return Blosc(_NAME, clevel=level, shuffle=Blosc.BITSHUFFLE)
