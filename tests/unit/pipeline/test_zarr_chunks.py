"""Chunks that zarr itself reads and writes."""

import numpy as np
import pytest
import zarr
from support.numbered_frames import RGB8, frame_of
from zarr.codecs import BloscCodec, Crc32cCodec

from pipeline.errors import DamageError
from pipeline.recording.recorder import Recorder
from pipeline.zarr_chunks import (
    CHUNK_KEYS,
    chunk_codecs,
    chunk_key,
    decode_chunk,
    encode_chunk,
    with_checksum,
    without_checksum,
)
from tikernels.raw.pixel_format import PixelFormat

RGB12 = PixelFormat("rgb", 12)


def test_chunks_are_those_of_zarr(tmp_path):
    for format in (RGB8, RGB12):
        path = tmp_path / f"{format.bits}.zarr"
        with Recorder(path, format) as recorder:
            for number in range(3):
                recorder.add(frame_of(number, format))
        array = zarr.create_array(
            tmp_path / f"{format.bits} by zarr",
            data=np.array([frame_of(number, format) for number in range(3)]),
            chunks=(1, 22, 34, 3),
            compressors=[BloscCodec(cname="lz4", clevel=1, shuffle="bitshuffle"), Crc32cCodec()],
            chunk_key_encoding={"name": "default", "separator": "."},
        )
        ours = zarr.open_group(path, mode="r")["frames"]
        assert ours.metadata == array.metadata
        for number in range(3):
            chunks = [folder / f"c.{number}.0.0.0" for folder in (path / "frames", tmp_path / f"{format.bits} by zarr")]
            assert chunks[0].read_bytes() == chunks[1].read_bytes()


def test_a_chunk_is_little_endian_whatever_the_array_is(tmp_path):
    values = np.arange(12, dtype=np.uint16).reshape(3, 4)
    chunk = encode_chunk(values, 1)
    assert encode_chunk(values.astype(">u2"), 1) == chunk
    assert encode_chunk(np.asfortranarray(values), 1) == chunk
    array = zarr.create_array(
        tmp_path / "a.zarr",
        shape=(1, 3, 4),
        chunks=(1, 3, 4),
        dtype="<u2",
        compressors=chunk_codecs(1),
        chunk_key_encoding=CHUNK_KEYS,
    )
    (tmp_path / "a.zarr" / chunk_key(0, 2)).write_bytes(chunk)
    np.testing.assert_array_equal(array[0], values)


def test_a_key_has_a_zero_for_every_other_axis():
    assert [chunk_key(7, n_axes) for n_axes in range(4)] == ["c.7", "c.7.0", "c.7.0.0", "c.7.0.0.0"]


@pytest.mark.parametrize("shape", [(10**9, 10**9), (2**16, 2**14), (3, 5), (0,), ()])
def test_a_chunk_of_another_length_takes_no_memory(shape):
    chunk = encode_chunk(np.zeros((3, 4), np.uint8), 1)
    with pytest.raises(DamageError, match="another number of values"):
        decode_chunk(chunk, np.uint8, shape)


def test_a_chunk_that_says_that_it_is_longer_than_it_is():
    content = bytearray(without_checksum(encode_chunk(np.arange(12.0), 1)))
    content[12:16] = (2**30).to_bytes(4, "little")
    with pytest.raises(DamageError, match="it is cut off"):
        decode_chunk(with_checksum(bytes(content)), np.float64, (12,))
