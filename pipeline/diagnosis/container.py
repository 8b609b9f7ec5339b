"""What the container of footage says: kind, codec, rate, and where frames are missing between others."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.footage.image_folder import ImageFolder
from pipeline.footage.source import Source
from pipeline.footage.video_file import VideoFile

_NUMBER = re.compile(r"\d+")
_LOSSY_SUFFIXES = (".jpg", ".jpeg", ".jpe")
# A step longer than this many usual ones hides a missing frame; shorter ones are those of an uneven clock.
_GAP = 1.5


@dataclass(frozen=True)
class ContainerFacts:
    """What is known without decoding."""

    container: str
    codec: str
    pixels: str  # in FFmpeg's words, or those of `PixelFormat`
    lossy: bool  # whether the codec drops what it considers invisible
    predicts: bool  # whether frames are made of others, so that one that does not change is repeated exactly
    rate_hz: float | None  # frames a second
    bits_a_pixel: float | None
    missing: int | None  # frames that are not there between others; None: nothing tells
    gaps: int  # in how many places


def container_facts(path: Path, source: Source) -> ContainerFacts:
    """Return what the container of an open source says."""
    width, height = source.size_px
    if isinstance(source, VideoFile):
        import av  # slow to import, and only needed here

        with av.open(f"file:{path.absolute()}", metadata_errors="replace") as container:
            stream = container.streams.video[0]
            context = stream.codec_context
            rate = stream.average_rate
            missing, gaps = _missing(source.stamps)
            return ContainerFacts(
                container=container.format.long_name,
                codec=context.name,
                pixels=str(context.pix_fmt),
                lossy=bool(context.codec.lossy),
                predicts=not (context.codec.intra_only or context.name == "ffv1"),
                rate_hz=None if not rate else float(rate),
                bits_a_pixel=8 * path.stat().st_size / (len(source) * width * height),
                missing=missing,
                gaps=gaps,
            )
    if isinstance(source, ImageFolder):
        lossy = source.names[0].lower().endswith(_LOSSY_SUFFIXES)
        # The number that changes from name to name: the last one.
        numbers = [int(found[-1]) for name in source.names if (found := _NUMBER.findall(Path(name).stem))]
        missing, gaps = _missing(numbers) if len(numbers) == len(source) else (None, 0)
        kind = "a picture" if len(source) == 1 else "a folder of pictures"
        codec = Path(source.names[0]).suffix[1:].lower()
        return ContainerFacts(kind, codec, source.format.layout, lossy, False, None, None, missing, gaps)
    return ContainerFacts("our recording in Zarr", "blosc", source.format.layout, False, False, None, None, None, 0)


def _missing(places: Sequence[int]) -> tuple[int | None, int]:
    """Return how many steps are missing from ascending places, and in how many gaps; None where none are usual."""
    if len(places) < 3:
        return None, 0
    steps = np.diff(np.asarray(places, np.float64))
    usual = float(np.median(steps))
    if usual <= 0 or steps.min() <= 0:
        return None, 0
    gaps = steps[steps > _GAP * usual]
    # A clock without a rate: what looks like gaps is how it goes.
    if len(gaps) > 0.2 * len(steps):
        return None, 0
    return int((np.rint(gaps / usual) - 1).sum()), len(gaps)
