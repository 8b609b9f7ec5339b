"""From what a camera or codec stored to linear RGB light: demosaicing, chroma upsampling, transfer, lateral colour."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from tikernels.raw.development import develop
    from tikernels.raw.lateral_color import align_channels
    from tikernels.raw.linearization import TRANSFERS, WHITE_LEVELS, Transfer, linear_values, linearize
    from tikernels.raw.pixel_format import PixelFormat

__all__ = [
    "TRANSFERS",
    "WHITE_LEVELS",
    "PixelFormat",
    "Transfer",
    "align_channels",
    "develop",
    "linear_values",
    "linearize",
]
__getattr__, __dir__ = lazily(__name__)
