"""Pictures to an MP4 file, and parts of a film to one."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

# Quality of H.264 and of MPEG-4 that shows no blocks. One thread: parts of a film are encoded side by side. No picture
# is made of later ones, so that parts follow each other without a gap.
_X264 = {"crf": "17", "preset": "veryfast", "threads": "1", "bf": "0"}
_MPEG4 = {"qmin": "2", "qmax": "5"}


class FilmEncoder:
    """Pictures to an MP4 file: H.264 where FFmpeg can make it, else MPEG-4.

    Parameters
    ----------
    path : str or Path
        The file.
    size_px : (int, int)
        Width and height, even.
    fps : float
        Pictures a second.
    """

    def __init__(self, path: str | Path, size_px: tuple[int, int], fps: float) -> None:
        import av  # slow to import, and only needed here

        self.codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
        self._container = av.open(str(path), "w")
        rate = Fraction(round(fps * 1000), 1000)
        settings = _X264 if self.codec == "libx264" else _MPEG4
        self._stream: Any = self._container.add_stream(self.codec, rate=rate, options=settings)
        self._stream.width, self._stream.height = size_px
        self._stream.pix_fmt = "yuv420p"
        # Of a file that does not say it, players guess the matrix by the number of rows: 1 is BT.709, limited range.
        context = self._stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = context.color_range = 1

    def __enter__(self) -> "FilmEncoder":
        return self

    def __exit__(self, error: object, *_: object) -> None:
        if error is None:
            self._container.mux(self._stream.encode())
        self._container.close()

    def add(self, image: npt.NDArray[np.uint8]) -> None:
        """Add a picture, (H, W, 3) RGB."""
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")
        self._container.mux(self._stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))


def join_parts(parts: Sequence[tuple[Path, int]], path: Path, fps: float) -> None:
    """Join parts of a film to one, as they are encoded.

    Parameters
    ----------
    parts : sequence of (Path, int)
        MP4 files of `FilmEncoder`, in their order, and how many pictures each has.
    path : Path
        The MP4 file to write.
    fps : float
        Pictures a second.
    """
    import av

    step = Fraction(1000, round(fps * 1000))  # seconds a picture
    shift = Fraction(0)
    with av.open(str(path), "w", options={"movflags": "faststart"}) as film:
        stream: Any = None
        for part, n_pictures in parts:
            with av.open(str(part)) as source:
                video = source.streams.video[0]
                if stream is None:
                    stream = film.add_stream_from_template(video)
                    stream.time_base = video.time_base
                for packet in source.demux(video):
                    if packet.dts is None:  # the end
                        continue
                    ticks = round(shift / video.time_base)
                    packet.pts, packet.dts = packet.pts + ticks, packet.dts + ticks
                    packet.stream = stream
                    film.mux(packet)
            shift += n_pictures * step
