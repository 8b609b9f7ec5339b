"""JPEG by FFmpeg, which says what is wrong with a picture where other decoders fill it up with grey."""

from contextlib import suppress
from typing import Any

from pipeline.errors import FootageError
from pipeline.footage.ffmpeg_messages import caught_messages
from pipeline.footage.picture_size import picture_size
from pipeline.footage.picture_tags import CMYK
from pipeline.limits import check_size, ffmpeg_limits

# What FFmpeg makes of a JPEG in cyan, magenta, yellow and black.
_FOUR_COLOURS = ("gbrap", "yuva444p", "cmyk")


class JpegDecoder:
    """Decode pictures one after another."""

    def __init__(self) -> None:
        self._context: Any = None

    def decode(self, data: bytes) -> Any:
        """Return FFmpeg's frame of a JPEG file.

        Raises
        ------
        FootageError
            It is damaged, or larger than what is read; the message is for behind its name.
        """
        import av  # slow to import, and only needed here

        size_px = picture_size(data)
        if size_px is None:
            raise FootageError("it is damaged (it does not say how large it is): copy it again")
        check_size("it", *size_px)
        if self._context is None:
            self._context = av.CodecContext.create("mjpeg", "r")
            self._context.options = ffmpeg_limits()
        frames = []
        with caught_messages() as said, suppress(av.error.FFmpegError):
            frames = self._context.decode(av.Packet(data))
        if said or not frames:
            self._context = None  # what it made of this one may stay in its state
            raise FootageError(f"it is damaged ({said[0] if said else 'nothing can be decoded'}): copy it again")
        if frames[0].format.name in _FOUR_COLOURS:
            raise FootageError(CMYK)
        return frames[0]
