"""Frames that tell their numbers, for recordings whose every frame is looked at again."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.footage.opening import open_footage
from pipeline.recording.recorder import Recorder
from tikernels.raw.pixel_format import PixelFormat

RGB8 = PixelFormat("rgb")
BURST = 5  # frames


def frame_of(number: int, format: PixelFormat = RGB8) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
    """Return a frame that tells its number, and does not compress."""
    (shape,) = format.plane_shapes(22, 34)
    return np.random.default_rng(number).integers(0, 2**format.bits, shape).astype(format.dtype)


def add(recorder: Recorder, n_frames: int) -> None:
    """Record the next frames."""
    for _ in range(n_frames):
        recorder.add(frame_of(recorder.n_frames))


def frames_of(
    format: PixelFormat = RGB8, n_frames: int = 9
) -> list[npt.NDArray[np.uint8]] | list[npt.NDArray[np.uint16]]:
    """Return frames that differ from each other in every pixel."""
    return [frame_of(number, format) for number in range(n_frames)]


def record(
    path: Path, format: PixelFormat = RGB8, n_frames: int = 9, **options: Any
) -> list[npt.NDArray[np.uint8]] | list[npt.NDArray[np.uint16]]:
    """Record frames, and return them."""
    frames = frames_of(format, n_frames)
    with Recorder(path, format, **options) as recorder:
        for frame in frames:
            recorder.add(frame)
    return frames


def rgb(planes, format):
    """Return (H, W, 3), or the mosaic, of what a source gives."""
    if format.channels == "gbr":
        return np.stack([planes[2], planes[0], planes[1]], axis=-1)
    return planes[0][..., 2::-1] if format.channels == "bgr0" else planes[0]


def held(path):
    """Return how many frames a recording holds, having compared each with what was recorded."""
    source = open_footage(path)
    assert source.notes == ()
    frames = list(source.frames())
    assert [frame.number for frame in frames] == list(range(len(source)))
    for frame in frames:
        levels = frame.planes[0][..., 2::-1] if frame.format.channels == "bgr0" else frame.planes[0]
        np.testing.assert_array_equal(levels, frame_of(frame.number))
    return len(frames)
