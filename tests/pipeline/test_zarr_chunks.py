"""Chunks that zarr itself reads and writes."""

import numpy as np
import zarr
from support.numbered_frames import RGB8, frame_of
from zarr.codecs import BloscCodec, Crc32cCodec

from pipeline.recording.recorder import Recorder
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
