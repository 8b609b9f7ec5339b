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
from pipeline.footage.picture_tags import H273_MATRICES, TRANSPARENT, PictureTags, is_transparent, several, with_colors
from pipeline.limits import check_size
from pipeline.models import ImageArray
from tikernels.raw.pixel_format import Matrix, PixelFormat
from tikernels.raw.repeated_chroma import RepeatedChroma, luma_and_chroma, repeated_samples

_BRANDS = {b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1"}
_INSTALL = "it is a picture in HEIC: pip install 'colorphase[heic]' to read it, or save it as PNG, TIFF or JPEG"
# Pixels of a chroma sample, across and down.
_PAIRED = {420: (2, 2), 422: (2, 1)}
# A chroma sample differs between its two pixels by rounding, in 1/255; where a colour is cut off by more.
_ROUNDING, _MOST_CUT = 2, 0.1


def is_heic(data: bytes) -> bool:
    """Return whether a file that begins like this (12 bytes) is one."""
    return data[4:8] == b"ftyp" and data[8:12] in _BRANDS


def read_heic(data: bytes) -> tuple[tuple[ImageArray, ...], PixelFormat, PictureTags]:
    """Return a picture's planes, how they are stored, and what the file states of them.

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
    matrix = H273_MATRICES.get(marked.get("matrix_coefficients", 0), "bt601")  # as libheif takes
    return *_planes(levels, half, matrix), tags


def _planes(levels: npt.NDArray[Any], half: int, matrix: Matrix) -> tuple[tuple[ImageArray, ...], PixelFormat]:
    """Return luma and chroma, of 16 bits, of a picture in which chroma samples are repeated.

    Raises
    ------
    FootageError
        They are not in pairs, as in a part of a picture, and in 4:2:2 that is turned.
    """
    white, pixels = np.iinfo(levels.dtype).max, _PAIRED[half]
    chroma = luma_and_chroma(levels, white, matrix)[1:]
    if any(_unlike_pairs(part, axis) > _MOST_CUT for part in chroma for axis in range(2) if pixels[1 - axis] == 2):
        raise FootageError("its colours have half the resolution, and cannot be separated again: save it as PNG")
    # HEVC's 4:2:2 sits left; encoders of pictures average 4:2:0 in the middle.
    return repeated_samples(levels, white, RepeatedChroma(pixels, (0, 0), matrix, "centre" if half == 420 else "left"))


def _unlike_pairs(chroma: npt.NDArray[np.floating], axis: int) -> float:
    """Return the share of pairs of values along an axis that are not alike."""
    half = chroma.shape[axis] // 2
    first, second = (np.take(chroma, range(begin, 2 * half, 2), axis) for begin in (0, 1))
    return float(np.mean(np.abs(first - second) > _ROUNDING * 257)) if half else 0.0
