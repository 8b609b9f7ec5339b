"""Live decoding: what a process of its own makes of the newest frame, and that nothing ever waits for it."""

import sys
import threading
import time

import numpy as np
import pytest
from support.live_frames import PATIENCE_S, SIZE_PX, decoded, image, rig, wait_for

from pipeline import Decoder, DecodeSettings
from pipeline.acquisition.live import LiveDecoder
from pipeline.errors import CalibrationError
from tikernels import ShapeError, develop
from tikernels.raw.pixel_format import PixelFormat

BAYER12 = PixelFormat("bayer", 12, bayer="grbg")

__all__ = ["image", "rig"]

pytestmark = pytest.mark.usefixtures("kernels_on_disk")


def mosaic(image, format):
    rows, columns = np.indices(image.shape[:2])
    colors = np.array(["rgb".index(color) for color in format.bayer]).reshape(2, 2)
    return image[rows, columns, colors[rows % 2, columns % 2]].astype(np.uint16) * 16


def arrays(frame):
    return {name: value for name, value in vars(frame).items() if isinstance(value, np.ndarray)}


def are_alike(some, others):
    return some.keys() == others.keys() and all(np.array_equal(some[k], others[k], equal_nan=k != "mask") for k in some)


def test_what_becomes_of_a_frame(rig, image):
    frame = mosaic(image, BAYER12)
    expected = Decoder(DecodeSettings(), rig, arch="cpu").decode(develop((frame,), BAYER12))
    begin = time.monotonic()
    options = {"calibration": rig, "format": BAYER12, "arch": "cpu"}
    with LiveDecoder(SIZE_PX, **options) as decoder:
        assert decoder.latest() is None
        assert decoder.latency_s is None
        assert not decoder.offer(frame, 0, begin)  # it is still starting
        decoder.wait(PATIENCE_S)
        assert decoder.ready
        result = decoded(decoder, frame, 7)
        assert result is decoder.latest()
        assert begin < result.exposed_at_s < result.exposed_at_s + result.latency_s < time.monotonic()
        assert decoder.latency_s == result.latency_s
        assert result.measured == pytest.approx(expected.mask.mean())
        assert result.measured > 0.5
        fields = {name: getattr(expected, name) for name in ("range_image", "mask", "points")}
        assert are_alike(arrays(result), fields | {"sigma": expected.point_sigma})
        assert result.warnings == expected.warnings
        assert f"128x96 px, {100 * result.measured:.0f} % measured, " in repr(result)
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
        assert np.isnan(dark.sigma).all()
        assert "no fringe stands out" in dark.warnings[0]
        assert repr(dark).startswith("LiveFrame(10, 128x96 px, 0 % measured, ")
        with pytest.raises(ShapeError, match=r"frame has shape \(95, 128"):
            decoder.offer(frame[1:], 11, 0)
        with pytest.raises(ShapeError, match=r"width and height are swapped: size_px is \(width, height\)"):
            decoder.offer(frame.T, 11, 0)
        assert decoder.ended is None
    assert decoder.ended == "live decoding was closed"
    assert not decoder.offer(frame, 12, 0)
    assert decoder.latest() is dark
    decoder.close()


def test_without_a_calibration_frames_are_relative(image):
    """And a frame that is no light says why it cannot be decoded, without values of the frame before."""
    floats = PixelFormat("rgb", 32, channels="bgr0")
    frame = np.dstack([image[..., ::-1].astype(np.float32) / 255, np.zeros(image.shape[:2], np.float32)])
    expected = Decoder(arch="cpu").decode(np.ascontiguousarray(frame[..., 2::-1]))
    with LiveDecoder(SIZE_PX, format=floats, arch="cpu", texture=True) as decoder:
        result = decoded(decoder, frame, 1)
        assert result.points is None
        assert result.range_unit == "rad"
        fields = {name: getattr(expected, name) for name in ("range_image", "mask", "texture")}
        assert are_alike(arrays(result), fields | {"sigma": expected.phase_sigma})
        for number in (2, 3):  # in both slots
            bad = decoded(decoder, frame * np.nan, number)
            assert bad.measured == 0
            assert not bad.mask.any()
            assert not bad.texture.any()
            assert "NaN" in bad.warnings[0]
        assert are_alike(arrays(decoded(decoder, frame, 4)), arrays(result))


def test_arrays_are_of_one_frame(rig, image):
    """Read at any time while the next frame is decoded, from several threads; and what was read never changes."""
    images = [np.roll(image, shift, axis=1) for shift in (0, 24, 48)]  # three: each comes into both slots
    with LiveDecoder(SIZE_PX, calibration=rig, arch="cpu", texture=True) as decoder:
        alone = [decoded(decoder, images[number], number) for number in range(3)]
        kept = [{name: array.copy() for name, array in arrays(frame).items()} for frame in alone]
        for name, array in kept[0].items():
            assert not any(np.array_equal(array, other[name], equal_nan=name != "mask") for other in kept[1:])
        seen, mixed = set(), set()

        def look():
            frame = decoder.latest()
            seen.add(frame.number)
            if not are_alike(arrays(frame), kept[frame.number % 3]):
                mixed.add(frame.number)

        def offer(numbers, pause_s):
            for number in numbers:
                wait_for(lambda number=number: decoder.offer(images[number % 3], number, time.monotonic()))
                time.sleep(pause_s(number))

        def hammer():
            while not offered.is_set():
                look()
                time.sleep(0.001)  # the process that decodes has what others leave of the cores

        late = range(3, 83)
        for number in late:
            offer([number], lambda number: number % 20 / 20 * alone[-1].latency_s)
            look()
        offered = threading.Event()
        threads = [threading.Thread(target=hammer) for _ in range(2)]
        for thread in threads:
            thread.start()
        try:
            offer(range(late.stop, 150), lambda number: 0)
        finally:
            offered.set()
            for thread in threads:
                thread.join(PATIENCE_S)
        assert not mixed
        assert len(seen) > 50
        assert all(map(are_alike, map(arrays, alone), kept))


def test_it_cannot_start(rig, image, monkeypatch):
    other = "vulkan" if sys.platform == "darwin" else "metal"
    with LiveDecoder(SIZE_PX, calibration=rig, arch=other) as decoder:
        wait_for(lambda: decoder.ended)
        assert decoder.ended.startswith(f"live decoding has ended: {other} cannot be started here")
        assert not decoder.offer(image, 0, 0)

    def refuse(process):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.context.SpawnProcess.start", refuse)
    with LiveDecoder(SIZE_PX, calibration=rig, arch="cpu") as decoder:
        assert decoder.ended == "live decoding could not start: Resource temporarily unavailable"
        assert not decoder.offer(image, 0, 0)
        assert decoder.latest() is None
    with pytest.raises(ShapeError, match="RGB in one plane"):
        LiveDecoder(SIZE_PX, format=PixelFormat("yuv"))
    with pytest.raises(CalibrationError, match="frame is 96x128 but the calibration is for 128x96"):
        LiveDecoder(SIZE_PX[::-1], calibration=rig)
