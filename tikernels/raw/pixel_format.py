"""Storage formats of a frame's pixels, in the words of cameras and codecs."""

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from tikernels.errors import ShapeError

Layout = Literal["rgb", "bayer", "yuv"]
Bayer = Literal["rggb", "bggr", "grbg", "gbrg"]
Siting = Literal["left", "centre", "top-left", "top", "bottom-left", "bottom", "right", "top-right", "bottom-right"]
Matrix = Literal["bt601", "bt709", "bt2020"]
#: np.uint8, np.uint16 or np.float32: type checkers cannot determine which.
LevelType: TypeAlias = type[Any]

BAYER_PATTERNS: tuple[Bayer, ...] = ("rggb", "bggr", "grbg", "gbrg")
#: Where a chroma sample sits among its pixels, across and down: 0 on the first, 1 on the last.
SITES: dict[Siting, tuple[float, float]] = {
    "left": (0, 0.5),
    "centre": (0.5, 0.5),
    "top-left": (0, 0),
    "top": (0.5, 0),
    "bottom-left": (0, 1),
    "bottom": (0.5, 1),
    "right": (1, 0.5),
    "top-right": (1, 0),
    "bottom-right": (1, 1),
}
#: Luma's weights of red and blue: Rec. ITU-R BT.601-7, BT.709-6 and BT.2020-2.
LUMA_WEIGHTS: dict[Matrix, tuple[float, float]] = {
    "bt601": (0.299, 0.114),
    "bt709": (0.2126, 0.0722),
    "bt2020": (0.2627, 0.0593),
}
#: Bits that denote float32 levels from 0 to 1.
FLOAT_BITS = 32


@dataclass(frozen=True)
class PixelFormat:
    """Storage format of a frame's planes.

    Planes are uint8 up to 8 bits, uint16 above, and float32 with 32 bits.

    Parameters
    ----------
    layout : {"rgb", "bayer", "yuv"}
        "rgb": one (H, W, 3 or 4) plane, or three (H, W) ones, in the order of `channels`. "bayer": one (H, W) mosaic.
        "yuv": (H, W) luma and two (H', W') planes of chroma; H' and W' are H and W over the subsampling, rounded up.
    bits : int
        8 to 16, or 32 for floats: full scale is 2 ** bits - 1, or 1.
    shift : int
        Number of bits by which values are shifted up (P010: 10 bits, shifted by 6).
    channels : str
        Contents of an "rgb" plane's channels, or of its planes: of r, g, b and 0 (unused).
    bayer : {"rggb", "bggr", "grbg", "gbrg"}
        The first two pixels of the first two rows.
    subsampling : (x, y)
        Pixels per chroma sample, 1, 2 or 4 along each axis.
    origin : (x, y)
        Number of pixels missing from the first chroma samples, left and above: of a picture of an odd size that was
        turned, one.
    siting : str
        Place of a chroma sample among its pixels, see `SITES`: "left" is the middle of the left column.
    matrix : {"bt601", "bt709", "bt2020"}
        Matrix by which luma was made of R, G, B.
    full_range : bool
        True if luma uses every level, False if 16 to 235 of 255.

    Examples
    --------
    >>> format = colorphase.PixelFormat("bayer", bits=12)
    >>> format.plane_shapes(480, 640), format.white_level
    (((480, 640),), 4095.0)
    """

    layout: Layout
    bits: int = 8
    shift: int = 0
    channels: str = "rgb"
    bayer: Bayer = "rggb"
    subsampling: tuple[int, int] = (1, 1)
    origin: tuple[int, int] = (0, 0)
    siting: Siting = "left"
    matrix: Matrix = "bt709"
    full_range: bool = False

    def __post_init__(self) -> None:
        """Refuse what no kernel can read.

        Raises
        ------
        ShapeError
            A value is none of those above.
        """
        choices = {
            "layout": ("rgb", "bayer", "yuv"),
            "bits": (*range(8, 17), FLOAT_BITS),
            "bayer": BAYER_PATTERNS,
            "matrix": tuple(LUMA_WEIGHTS),
            "siting": tuple(SITES),
            "subsampling": tuple((x, y) for x in (1, 2, 4) for y in (1, 2, 4)),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ShapeError(f"{name} is {getattr(self, name)!r}: choose {', '.join(map(str, allowed))}")
        if any(not 0 <= missing < step for missing, step in zip(self.origin, self.subsampling, strict=True)):
            raise ShapeError(f"origin is {self.origin}: give less than the subsampling, {self.subsampling}")
        if sorted(self.channels.replace("0", "")) != ["b", "g", "r"]:
            raise ShapeError(f"channels is {self.channels!r}: name r, g and b once, and 0 for what is unused")
        if self.bits == FLOAT_BITS and self.layout != "rgb":
            raise ShapeError(f"{self.layout} pixels of 32 bits: only RGB may be floats")

    @property
    def dtype(self) -> LevelType:
        """The element type of every plane."""
        if self.bits == FLOAT_BITS:
            return np.float32
        return np.uint8 if self.bits + self.shift <= 8 else np.uint16

    @property
    def white_level(self) -> float:
        """Full scale, levels."""
        return 1.0 if self.bits == FLOAT_BITS else float((2**self.bits - 1) << self.shift)

    @property
    def rgb_dtype(self) -> LevelType:
        """Type that `develop` returns: that of RGB of 8, 16 or 32 bits; float32 of everything else."""
        return self.dtype if self.layout == "rgb" and self.white_level in (255, 65535, 1) else np.float32

    def plane_shapes(self, height: int, width: int) -> tuple[tuple[int, ...], ...]:
        """Return the shape of each plane of a frame of a height and a width, px: (H, W, ...), rows first.

        An "rgb" frame's where its channels are in one plane.
        """
        if self.layout == "rgb":
            return ((height, width, len(self.channels)),)
        if self.layout == "bayer":
            return ((height, width),)
        (x, y), (left, above) = self.subsampling, self.origin
        return ((height, width), *(((-(-(height + above) // y), -(-(width + left) // x)),) * 2))
