"""Small video files for tests and benchmarks: planes in, a file out, by FFmpeg through PyAV."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import reference

from tikernels.raw.pixel_format import PixelFormat

Planes = Sequence[npt.NDArray[Any]]

#: What cameras and `ffmpeg` write; q 2 and crf 10 are near the best that each does.
MJPEG = ("mjpeg", "yuvj420p", {"qmin": "2", "qmax": "2", "flags": "+qscale", "global_quality": str(2 * 118)})
H264 = ("libx264", "yuv420p", {"crf": "10"})


def moving_planes(n_frames: int, format: PixelFormat, size_px: tuple[int, int] = (64, 48)) -> list[Planes]:
    """Return frames of smooth noise that moves, each unlike all others."""
    width, height = size_px
    rng = np.random.default_rng(7)
    frames = []
    coarse = rng.integers(40, 200, (height // 8 + 1, width // 8 + n_frames + 1)).astype(np.uint8)
    for i in range(n_frames):
        picture = np.kron(coarse[:, i : i + width // 8 + 1], np.ones((8, 8), np.uint8))
        shapes = format.plane_shapes(height, width)
        frames.append([np.resize(picture[: s[0], : s[1]], s[:2]).astype(format.dtype) for s in shapes])
    return frames


def encode(
    path: Path,
    frames: Iterable[Planes],
    codec: str,
    pixels: str,
    options: dict[str, str] | None = None,
    *,
    stamps: Sequence[int] | None = None,
    container_options: dict[str, str] | None = None,
    **properties: Any,
) -> Path:
    """Write a video; `stamps` are frame times in 1/30 s."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream: Any = None
        for number, planes in enumerate(frames):
            height, width = planes[0].shape[:2]
            if stream is None:
                stream = container.add_stream(codec, rate=30, options=options or {})
                stream.width, stream.height, stream.pix_fmt = width, height, pixels
                for name, value in properties.items():
                    setattr(stream.codec_context, name, value)
            frame = av.VideoFrame(width, height, pixels)
            for buffer, plane in zip(frame.planes, planes, strict=True):
                step = plane.itemsize * (plane.shape[2] if plane.ndim == 3 else 1)
                strides = (buffer.line_size, step, plane.itemsize)[: plane.ndim]
                np.ndarray(plane.shape, plane.dtype, buffer, 0, strides)[...] = plane
            for name, value in properties.items():
                setattr(frame, name, value)
            frame.time_base = Fraction(1, 30)
            frame.pts = number if stamps is None else stamps[number]
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def packets(path: Path) -> list[tuple[int, int]]:
    """Return where each coded frame begins, and how long it is, bytes."""
    with av.open(str(path)) as container:
        return [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]


def flip(path: Path, number: int) -> None:
    """Change one bit in the middle of one coded frame."""
    begin, size = packets(path)[number]
    data = bytearray(path.read_bytes())
    data[begin + size // 2] ^= 4
    path.write_bytes(data)


def erase(path: Path, number: int) -> None:
    """Overwrite one coded frame with zeros, except its head."""
    begin, size = packets(path)[number]
    data = bytearray(path.read_bytes())
    data[begin + 60 : begin + size] = bytes(size - 60)
    path.write_bytes(data)


def film(path: Path, image: npt.NDArray[Any], format: PixelFormat, codec: tuple[str, str, dict[str, str]]) -> Path:
    """Write five frames of one picture, chroma averaged as the format says; the third has neighbours to lean on."""
    planes = reference.subsample_chroma(image / np.iinfo(image.dtype).max, format)
    return encode(path, 5 * [planes], *codec)
