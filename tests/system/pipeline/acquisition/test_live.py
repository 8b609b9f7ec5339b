"""Live decoding: what a process of its own makes of the newest frame, and that nothing ever waits for it."""

import sys
import time

import numpy as np
import pytest
from support.live_frames import PATIENCE_S, RGB8, SIZE_PX, decoded, image, rig, wait_for

from pipeline import Decoder, DecodeSettings
from pipeline.acquisition.live import LiveDecoder
from pipeline.output.range_image import write_range_image
from tikernels import ShapeError, develop
from tikernels.raw.pixel_format import PixelFormat

BAYER12 = PixelFormat("bayer", 12, bayer="grbg")

__all__ = ["image", "rig"]

pytestmark = pytest.mark.usefixtures("kernels_on_disk")


def mosaic(image, format):
    rows, columns = np.indices(image.shape[:2])
    colors = np.array(["rgb".index(color) for color in format.bayer]).reshape(2, 2)
    return image[rows, columns, colors[rows % 2, columns % 2]].astype(np.uint16) * 16


def test_what_becomes_of_a_frame(rig, image, tmp_path):
    frame = mosaic(image, BAYER12)
    expected = Decoder(DecodeSettings(), rig, arch="cpu").decode(develop((frame,), BAYER12))
    write_range_image(tmp_path / "expected.png", expected.range_image, expected.mask, "mm")
    begin = time.monotonic()
    with LiveDecoder(DecodeSettings(), rig, BAYER12, SIZE_PX, tmp_path / "live.png", "cpu") as decoder:
        assert decoder.latest() is None
        assert not decoder.offer(frame, 0, begin)  # it is still starting
        decoder.wait(PATIENCE_S)
        assert decoder.ready
        result = decoded(decoder, frame, 7)
        assert 0 < result.latency_s < time.monotonic() - begin
        assert result.measured == pytest.approx(expected.mask.mean())
        assert result.measured > 0.5
        assert result.phase_sigma == pytest.approx(np.median(expected.phase_sigma[expected.mask]))
        assert result.warnings == expected.warnings
        assert (tmp_path / "live.png").read_bytes() == (tmp_path / "expected.png").read_bytes()
        # The frame is the caller's again at once, and while it is decoded no other one is taken.
        decoder.wait(PATIENCE_S)
        buffer = frame.copy()
        assert decoder.offer(buffer, 8, time.monotonic())
        buffer[...] = 0
        taken = decoder.offer(buffer, 9, time.monotonic())
        wait_for(lambda: decoder.latest().number >= 8)
        assert taken or decoder.latest().measured == result.measured
        dark = decoded(decoder, np.zeros_like(frame), 10)
        assert dark.measured == 0
        assert np.isnan(dark.phase_sigma)
        assert "no fringe stands out" in dark.warnings[0]
        with pytest.raises(ShapeError, match=r"frame has shape \(95, 128"):
            decoder.offer(frame[1:], 11, 0)
        assert decoder.ended is None
    assert decoder.ended == "live decoding was closed"
    assert not decoder.offer(frame, 12, 0)
    decoder.close()
    assert sorted(left.name for left in tmp_path.iterdir()) == ["expected.png", "live.png"]


def test_it_cannot_start(rig, image, monkeypatch):
    other = "vulkan" if sys.platform == "darwin" else "metal"
    with LiveDecoder(DecodeSettings(), rig, RGB8, SIZE_PX, arch=other) as decoder:
        wait_for(lambda: decoder.ended)
        assert decoder.ended.startswith(f"live decoding has ended: {other} cannot be started here")
        assert not decoder.offer(image, 0, 0)

    def refuse(process):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.context.SpawnProcess.start", refuse)
    with LiveDecoder(DecodeSettings(), rig, RGB8, SIZE_PX, arch="cpu") as decoder:
        assert decoder.ended == "live decoding could not start: Resource temporarily unavailable"
        assert not decoder.offer(image, 0, 0)
        assert decoder.latest() is None
    with pytest.raises(ShapeError, match="RGB in one plane"):
        LiveDecoder(DecodeSettings(), rig, PixelFormat("yuv"), SIZE_PX)
