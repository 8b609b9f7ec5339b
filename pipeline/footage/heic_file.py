"""HEIC, as phones store pictures, by libheif, which the extra `heic` brings.

Phones store chroma at half the resolution. libheif repeats each sample, which takes most of a fringe
(`tikernels.raw.chroma_upsampling`). As the samples are found again in pairs of pixels, the planes are, too.

References
----------
ISO/IEC 23008-12 (HEIF), 6.5.10 for how a picture is turned, and 10.2 for the brands.
"""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import FootageError
from pipeline.footage.picture_tags import TRANSPARENT, PictureTags, is_transparent, several, with_colors
from pipeline.limits import check_size
from pipeline.models import ImageArray
from tikernels.raw.pixel_format import LUMA_WEIGHTS, Matrix, PixelFormat, Siting

_BRANDS = {b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1"}
_INSTALL = "it is a picture in HEIC: pip install 'colorphase[heic]' to read it, or save it as PNG, TIFF or JPEG"
# ITU-T H.273; what libheif takes where the file says nothing is BT.601.
_MATRICES: dict[int, Matrix] = {1: "bt709", 9: "bt2020"}
# Pixels of a chroma sample, down and across.
_PAIRED = {420: (2, 2), 422: (1, 2)}
_SIXTEEN = 65535
# A chroma sample differs between its two pixels by rounding, in 1/255; where a colour is cut off by more.
_ROUNDING, _MOST_CUT = 2, 0.1


def is_heic(data: bytes) -> bool:
    """Return whether a file that begins like this (12 bytes) is one."""
    return data[4:8] == b"ftyp" and data[8:12] in _BRANDS


def read_heic(data: bytes) -> tuple[tuple[ImageArray, ...], PixelFormat, PictureTags]:
    """Return a picture's planes, how they are stored, and what the file says of them.

    It is turned as the camera was held, by the file's own turns; what Exif repeats of these does not count. Of several
    pictures it is the one that the file calls its first.

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
    except (ValueError, RuntimeError, EOFError, SyntaxError, IndexError) as error:
        raise FootageError("it is damaged: copy it again") from error
    if levels.ndim != 3:
        raise FootageError("it is grey, but the phase is in the colours: give a colour picture")
    tags = PictureTags(1, "srgb", "a HEIC picture that says nothing else is sRGB")
    marked = picture.info.get("nclx_profile") or {}
    tags = with_colors(tags, picture.info.get("icc_profile"), marked.get("transfer_characteristics"))
    notes = [several(len(picture))] if len(picture) > 1 else []
    notes += [TRANSPARENT] if is_transparent(levels) else []
    tags = replace(tags, notes=(*tags.notes, *notes))
    levels = np.ascontiguousarray(levels[..., :3])
    half = picture.info.get("chroma")
    if half not in _PAIRED:
        return (levels,), PixelFormat("rgb", 8 * levels.itemsize), tags
    return *_planes(levels, half, _MATRICES.get(marked.get("matrix_coefficients", 0), "bt601")), tags


def _planes(levels: npt.NDArray[Any], half: int, matrix: Matrix) -> tuple[tuple[ImageArray, ...], PixelFormat]:
    """Return luma and chroma, of 16 bits, of a picture in which chroma samples are repeated.

    Raises
    ------
    FootageError
        They are not in pairs, as in a part of a picture, and in 4:2:2 that is turned.
    """
    red, blue = LUMA_WEIGHTS[matrix]
    light = levels.astype(np.float32) * np.float32(_SIXTEEN / np.iinfo(levels.dtype).max)
    luma = light @ np.array([red, 1 - red - blue, blue], np.float32)
    middle = (_SIXTEEN + 1) / 2
    chroma = [(light[..., k] - luma) / (2 * (1 - weight)) + middle for k, weight in ((2, blue), (0, red))]
    down, across = _PAIRED[half]
    if any(_unlike_pairs(part, axis) > _MOST_CUT for part in chroma for axis in range(2) if (down, across)[axis] == 2):
        raise FootageError("its colours have half the resolution, and cannot be told apart again: save it as PNG")
    planes = (luma, *(_means(part, down, across) for part in chroma))
    rounded = tuple(np.rint(np.clip(plane, 0, _SIXTEEN)).astype(np.uint16) for plane in planes)
    # HEVC's 4:2:2 sits left; encoders of pictures average 4:2:0 in the middle.
    siting: Siting = "centre" if down == 2 else "left"
    return rounded, PixelFormat("yuv", 16, subsampling=(across, down), siting=siting, matrix=matrix, full_range=True)


def _means(chroma: npt.NDArray[np.floating], down: int, across: int) -> npt.NDArray[np.floating]:
    """Return the mean of each cell of pixels; the last ones may be incomplete."""
    height, width = chroma.shape
    whole = np.pad(chroma, ((0, -height % down), (0, -width % across)), "edge")
    cells = whole.reshape(-(-height // down), down, -(-width // across), across)
    return np.asarray(cells.mean(axis=(1, 3)))


def _unlike_pairs(chroma: npt.NDArray[np.floating], axis: int) -> float:
    """Return the share of pairs of values along an axis that are not alike."""
    half = chroma.shape[axis] // 2
    first, second = (np.take(chroma, range(begin, 2 * half, 2), axis) for begin in (0, 1))
    return float(np.mean(np.abs(first - second) > _ROUNDING * _SIXTEEN / 255)) if half else 0.0
