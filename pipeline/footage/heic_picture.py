"""Pictures as phones store them: HEIC, read by libheif, which the extra `heic` brings.

References
----------
ISO/IEC 23008-12 (HEIF), 6.5.10 for how a picture is turned, and 10.2 for the brands.
"""

import io
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import FootageError
from pipeline.footage.picture_tags import PictureTags, with_colors
from pipeline.limits import check_size

_BRANDS = {b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1"}
_INSTALL = "it is a picture in HEIC: pip install 'colorphase[heic]' to read it, or save it as PNG, TIFF or JPEG"


def is_heic(data: bytes) -> bool:
    """Return whether a file that begins like this (12 bytes) is one."""
    return data[4:8] == b"ftyp" and data[8:12] in _BRANDS


def read_heic(data: bytes) -> tuple[npt.NDArray[Any], PictureTags]:
    """Return a picture's levels, (H, W, 3) RGB, uint8 or uint16 of 16 bits, and what the file says of them.

    It is turned as the camera was held, by the file's own turns; what Exif repeats of these does not count.

    Raises
    ------
    FootageError
        It is damaged, grey or too large, or the extra is not installed.
    """
    try:
        import pillow_heif
    except ImportError:
        raise FootageError(_INSTALL) from None
    try:
        picture = pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False)
        check_size("the picture", *picture.size)
        levels = np.asarray(picture)
    except (ValueError, RuntimeError, EOFError, SyntaxError) as error:
        raise FootageError("it is damaged: copy it again") from error
    if levels.ndim != 3:
        raise FootageError("it is grey, but the phase is in the colours: give a colour picture")
    tags = PictureTags(1, "srgb", "a HEIC picture that says nothing else is sRGB")
    marked = picture.info.get("nclx_profile") or {}
    tags = with_colors(tags, picture.info.get("icc_profile"), marked.get("transfer_characteristics"))
    return np.ascontiguousarray(levels[..., :3]), tags
