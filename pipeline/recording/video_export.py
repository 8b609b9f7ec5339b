"""A recording as a video, for archives and players: lossless FFV1 in Matroska.

Pixels go into FFV1's own formats of the next larger depth, values as they are; Matroska's time stamps and its colour
element have times and transfer, and tags what no video states: the mosaic, the bits in use, and the exact rate.

References
----------
FFV1: RFC 9043. Matroska: RFC 9559. ITU-T H.273 for the numbers of transfers.
"""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from pipeline.errors import FootageError, OutputError
from pipeline.files import explain, make_folder, replace_file
from pipeline.footage.footage import BadFrame, StoredAs
from pipeline.footage.video_file import BAYER_TAG, BITS_TAG, RATE_TAG, SENSOR_TAG
from pipeline.footage.zarr_recording import ZarrRecording
from pipeline.models import ImageArray
from tikernels.raw.pixel_format import PixelFormat

# Bits a colour that FFV1 has formats for, in RGB and grey.
_DEPTHS = (8, 9, 10, 12, 14, 16)
_TRANSFERS = {"bt709": 1, "linear": 8, "srgb": 13}
# Every frame by itself, in slices that are coded in parallel, each with a checksum.
_OPTIONS = {"g": "1", "level": "3", "slicecrc": "1", "slices": "16"}
_MS = Fraction(1, 1000)


def export_video(recording: Path, video: Path, notify: Callable[[int, int], None] = lambda done, of: None) -> int:
    """Write every frame of a recording into a video, which decodes to the same; return how many they are.

    Parameters
    ----------
    recording : Path
        A recording in Zarr.
    video : Path
        The ``.mkv`` to write.
    notify : callable
        Called with how many frames of how many are written.

    Raises
    ------
    FootageError
        It is no recording, or one of its frames is damaged: no video then.
    OutputError
        The recording holds floats, which FFV1 does not, or the video cannot be written.
    """
    source = ZarrRecording(recording, StoredAs())
    if source.format.dtype == np.float32:
        raise OutputError(f"{recording} holds floats, and FFV1 8 to 16 bits: keep it in Zarr")
    try:
        make_folder(video.parent)
        replace_file(video, lambda file: _encode(source, file, notify))
    except FootageError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write {video}: {explain(error)}") from error
    return len(source)


def _encode(source: ZarrRecording, file: BinaryIO, notify: Callable[[int, int], None]) -> None:
    import av  # slow to import, and only needed here

    format = source.format
    with av.open(file, "w", format="matroska") as container:
        container.metadata.update({RATE_TAG: str(source.rate_hz), BITS_TAG: str(format.bits)})
        if format.layout == "bayer":
            container.metadata[BAYER_TAG] = format.bayer
        if source.sensor is not None:
            container.metadata[SENSOR_TAG] = source.sensor.model_dump_json()
        stream: Any = container.add_stream("ffv1", rate=source.rate_hz, options=_OPTIONS)
        stream.width, stream.height = source.size_px
        stream.pix_fmt = _pixels(format)
        context = stream.codec_context
        context.time_base, context.thread_type = _MS, "SLICE"
        if source.transfer is not None:
            context.color_trc = _TRANSFERS[source.transfer]
        for stored in source.frames():
            if isinstance(stored, BadFrame):
                raise FootageError(f"frame {stored.number} of {source.name}: {stored.reason}")
            frame = _filled(av.VideoFrame(*source.size_px, stream.pix_fmt), stored.planes[0])
            frame.pts, frame.time_base = round(stored.number / source.rate_hz / _MS), _MS
            container.mux(stream.encode(frame))
            notify(stored.number + 1, len(source))
        container.mux(stream.encode())


def _pixels(format: PixelFormat) -> str:
    """Return FFmpeg's name of the pixel format that holds such values."""
    depth = next(depth for depth in _DEPTHS if depth >= format.bits)
    if depth == 8:
        return "gray" if format.layout == "bayer" else "bgr0"
    return f"{'gray' if format.layout == 'bayer' else 'gbrp'}{depth}le"


def _filled(frame: Any, levels: ImageArray) -> Any:
    """Return a frame of FFmpeg that holds these values."""
    if levels.ndim == 2:
        _plane(frame, 0, levels.shape, levels.dtype)[...] = levels
    elif levels.dtype == np.uint8:
        _plane(frame, 0, (*levels.shape[:2], 4), levels.dtype)[..., :3] = levels[..., ::-1]
    else:
        for i, color in enumerate((1, 2, 0)):
            _plane(frame, i, levels.shape[:2], levels.dtype)[...] = levels[..., color]
    return frame


def _plane(frame: Any, plane: int, shape: tuple[int, ...], dtype: npt.DTypeLike) -> ImageArray:
    """Return a plane of a frame of FFmpeg to write into."""
    size = np.dtype(dtype).itemsize
    strides = (frame.planes[plane].line_size, size * (shape[2] if len(shape) == 3 else 1), size)
    return np.ndarray(shape, dtype, frame.planes[plane], 0, strides[: len(shape)])
