"""Where frames come from: one protocol for image folders, video files and our own recordings.

A frame leaves its source in the form in which it was stored; `tikernels.development.develop` turns that into RGB.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy.typing as npt

from tikernels.pixel_format import Bayer, Matrix, PixelFormat, Siting


@dataclass(frozen=True)
class StoredFrame:
    """One frame as it was stored."""

    number: int  # in its source, from 0
    planes: tuple[npt.NDArray[Any], ...]  # see PixelFormat; views that keep what they look at alive; do not write
    format: PixelFormat


@dataclass(frozen=True)
class BadFrame:
    """A frame that is damaged, or is not like the others."""

    number: int  # in its source, from 0
    reason: str  # one line, without the number


class Source(Protocol):
    """Frames in their order, as often as asked for; not to be shared between threads."""

    @property
    def name(self) -> str:
        """What the user gave."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of every frame."""

    @property
    def format(self) -> PixelFormat:
        """How the first good frame is stored; others differ only if their frame says so."""

    @property
    def transfer(self) -> str | None:
        """How light is encoded ("linear", "srgb", "bt709"), where the container says so; None where it does not."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed because the container does not say it, a sentence each; for the user."""

    def __len__(self) -> int:
        """Return how many frames there are, damaged ones included."""

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[StoredFrame | BadFrame]:
        """Yield the frames start, start + step, ... below stop: each number once, in order, as a frame or a bad one."""

    def close(self) -> None:
        """Let go of files; harmless twice."""


def open_source(
    path: str | Path,
    *,
    bayer: Bayer | None = None,
    bits: int | None = None,
    siting: Siting | None = None,
    matrix: Matrix | None = None,
    full_range: bool | None = None,
) -> Source:
    """Open footage: a folder of pictures, a single picture, a video file, or a recording of ours.

    Parameters
    ----------
    path : str or Path
        Which.
    bayer, bits, siting, matrix, full_range
        How the pixels are stored, see `PixelFormat`; each wins over what the footage says of itself. Grey footage
        needs `bayer`.

    Raises
    ------
    FootageError
        There is no such footage, or it cannot be read.
    """
    raise NotImplementedError
