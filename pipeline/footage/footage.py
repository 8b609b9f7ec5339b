"""Frames in the form in which they were stored, and what every source of them can do."""

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self, cast, get_args

import numpy as np

from pipeline.errors import FootageError, SettingsError
from pipeline.footage.frame_times import FrameTimes
from pipeline.footage.picture_tags import upright
from pipeline.models import ImageArray, SensorPart
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import SITES, Bayer, Matrix, PixelFormat, Siting

#: Why grey footage cannot be decoded.
GREY = "it is grey, but the phase is in the colours: if it is a Bayer mosaic, say which: --bayer rggb"


@dataclass(frozen=True)
class StoredFrame:
    """One frame as it was stored."""

    number: int  # in its source, from 0
    planes: tuple[ImageArray, ...]  # see PixelFormat; views that keep what they look at alive; do not write
    format: PixelFormat


@dataclass(frozen=True)
class BadFrame:
    """A frame that is damaged, or is not like the others."""

    number: int  # in its source, from 0
    reason: str  # one line, without the number


#: What becomes of a bad frame: it ends the reading, or is left out.
OnBad = Literal["raise", "skip"]


def check_on_bad(on_bad: OnBad) -> None:
    """Refuse what is no way to treat bad frames.

    Raises
    ------
    SettingsError
        It is neither of the two.
    """
    if on_bad not in get_args(OnBad):
        raise SettingsError(f'on_bad is {on_bad!r}: give "raise" or "skip"')


#: Frames by number; closing them lets go of the file at once.
Frames = Generator[StoredFrame | BadFrame, None, None]


class Footage(ABC):
    """Frames in their order, as often as needed; not to be shared between threads.

    `open_footage` opens it. It is a context manager: leaving it lets go of files.

    Attributes
    ----------
    name : str
        As the user gave it.
    size_px : (int, int)
        Width and height of every frame, whose arrays have the shape (height, width, 3).
    format : PixelFormat
        Format of the first good frame; others differ only if their frame states it.
    transfer : str or None
        Encoding of light ("linear", "srgb", "bt709"), where the file states it.
    transfer_because : str
        The evidence for the transfer, or that there is none.
    sensor : SensorPart or None
        The part of the camera's sensor that frames are; None: the footage does not specify it.
    notes : tuple of str
        Assumptions, where the container does not specify it, one sentence each; for the user.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> with colorphase.Recorder("film.zarr", colorphase.PixelFormat("rgb"), rate_hz=30) as film:
    ...     for seed in range(2):
    ...         film.add(colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane", seed=seed)).image)
    >>> with colorphase.open_footage("film.zarr") as footage:
    ...     footage.size_px, [image.shape for image in footage.images()]
    ((160, 120), [(120, 160, 3), (120, 160, 3)])
    """

    name: str
    size_px: tuple[int, int]
    format: PixelFormat
    transfer: str | None
    transfer_because: str
    sensor: SensorPart | None
    notes: tuple[str, ...] = ()

    @abstractmethod
    def __len__(self) -> int:
        """Return how many frames there are, damaged ones included."""

    @abstractmethod
    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Frames:
        """Yield the frames start, start + step, ... below stop: each number once, in order, as a frame or a bad one.

        A frame comes in the form in which it was stored; `tikernels.develop` turns that into RGB.
        """

    @abstractmethod
    def files(self) -> list[Path]:
        """Return the file of each frame, some of which may be missing; or one file, if it holds them all."""

    def close(self) -> None:  # noqa: B027 (most have nothing open)
        """Let go of files; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        width, height = self.size_px
        return f"<{type(self).__name__} {self.name}: {len(self)} frames of {width}x{height} px>"

    @property
    def times(self) -> FrameTimes | None:
        """Times at which the frames were taken; None where they are unknown, as with a folder of pictures.

        A recording's capture log has the time of day at which each frame was exposed. Without one they follow from a
        recording's rate, and of other videos from their time stamps. The date in a video's head is not used: programs
        that cut or copy videos write their own.
        """
        return None

    def images(
        self, start: int = 0, stop: int | None = None, step: int = 1, *, stripes: str = "horizontal"
    ) -> Iterator[ImageArray]:
        """Yield the frames start, start + step, ... below stop as RGB.

        Parameters
        ----------
        start, stop, step : int
            As of a slice.
        stripes : {"horizontal", "vertical"}
            Direction of the fringe; a mosaic's missing colours are taken from along it.

        Yields
        ------
        (H, W, 3) uint8, uint16 or float32
            Levels up to 255, 65535 or 1, encoded as the camera encoded them; see `transfer`.

        Raises
        ------
        FootageError
            A frame is damaged, or is not like the others.
        """
        runtime.init("auto")
        for stored in self.frames(start, stop, step):
            if isinstance(stored, BadFrame):
                raise FootageError(f"frame {stored.number} of {self.name}: {stored.reason}")
            yield runtime.to_host(develop(stored.planes, stored.format, stripes=stripes)).copy()


@dataclass(frozen=True)
class StoredAs:
    """The user's description of the pixels, see `PixelFormat`; None: the footage's own.

    Examples
    --------
    >>> colorphase.StoredAs(bayer="rggb", bits=12).bits
    12
    """

    bayer: Bayer | None = None
    """Mosaic of grey footage."""
    bits: int | None = None
    """Number of bits of its values that are used."""
    siting: Siting | None = None
    """Place of chroma samples."""
    matrix: Matrix | None = None
    """Matrix by which luma was made."""
    full_range: bool | None = None
    """True if luma uses every level."""

    def applied_to(self, format: PixelFormat) -> PixelFormat:
        """Return a format as the user describes it.

        Raises
        ------
        FootageError
            The bits do not fit the values.
        """
        said = replace(format, **{name: value for name, value in vars(self).items() if value is not None})
        # Where bits are shifted up their number is known, and another one would need another shift.
        if said.dtype != format.dtype or (format.shift and said.bits != format.bits):
            raise FootageError(f"bits is {said.bits}, but its values have {format.bits}")
        return said


def turned(
    planes: tuple[ImageArray, ...], format: PixelFormat, orientation: int
) -> tuple[tuple[ImageArray, ...], PixelFormat]:
    """Return planes as they are to be seen by Exif's orientation (see `upright`), and how they are stored then."""
    if orientation == 1:
        return planes, format
    height, width = planes[0].shape[:2]
    if format.layout == "yuv":
        (x, y), (across, down), (left, above) = SITES[format.siting], format.subsampling, format.origin
        if orientation in (5, 6, 7, 8):
            x, y, across, down, left, above, height, width = y, x, down, across, above, left, width, height
        # Of the last samples pixels may be missing, too.
        if orientation in (2, 3, 6, 7):
            x, left = 1 - x, -(width + left) % across
        if orientation in (3, 4, 7, 8):
            y, above = 1 - y, -(height + above) % down
        siting = next(name for name, site in SITES.items() if site == (x, y))
        format = replace(format, siting=siting, subsampling=(across, down), origin=(left, above))
    if format.layout == "bayer":
        # A mosaic of as many pixels more than two as the picture has more than an even number.
        mosaic = np.tile(np.array(list(format.bayer)).reshape(2, 2), (2, 2))[: 2 + height % 2, : 2 + width % 2]
        corner = upright(mosaic, orientation)[:2, :2]
        format = replace(format, bayer=cast(Bayer, "".join(corner.ravel())))
    return tuple(cast(ImageArray, np.ascontiguousarray(upright(plane, orientation))) for plane in planes), format


def other_than_first(format: PixelFormat, size_px: tuple[int, int], source: Footage) -> str | None:
    """Say how a frame differs from its source's first in what all frames of a store must share; None: in nothing."""
    for here, first in zip(_kind(format, size_px), _kind(source.format, source.size_px), strict=True):
        if here != first:
            return f"it is {here}, the first is {first}"
    return None


def _kind(format: PixelFormat, size_px: tuple[int, int]) -> tuple[str, ...]:
    # Grey levels of one store are on one scale, and a region of interest begins at a sample of chroma.
    across, down = format.subsampling
    return f"{size_px[0]}x{size_px[1]} {format.layout}", f"of {format.bits} bits", f"subsampled by {across}x{down}"
