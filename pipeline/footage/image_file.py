"""Read a colour image, or say in one line why it is none.

JPEG is decoded by FFmpeg, which says what is wrong with a picture where other decoders fill it up with grey; HEIC, as
phones store pictures, by libheif, which the extra `heic` brings; all else by OpenCV.

References
----------
ISO/IEC 23008-12 (HEIF), 6.5.10 for how a picture is turned, and 10.2 for the brands.
"""

import errno
import io
import struct
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import FootageError
from pipeline.footage.ffmpeg_frames import caught_messages
from pipeline.footage.picture_tags import (
    CMYK,
    PictureTags,
    picture_size,
    read_tags,
    unfit_colors,
    upright,
    with_colors,
)
from pipeline.limits import BYTES_A_PIXEL, MAX_PIXELS, check_size, ffmpeg_limits, max_pixels, read_plain
from pipeline.models import ImageArray

_BRANDS = {b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1"}
_INSTALL = "it is a picture in HEIC: pip install 'colorphase[heic]' to read it, or save it as PNG, TIFF or JPEG"
# What FFmpeg makes of a JPEG in cyan, magenta, yellow and black.
_FOUR_COLOURS = ("gbrap", "yuva444p", "cmyk")
# How each kind of file begins and how a whole one ends; OpenCV decodes the rest of a truncated one as grey.
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_ENDS = {_PNG: b"IEND\xaeB`\x82", _JPEG: b"\xff\xd9"}


def read_bytes(path: Path) -> bytes:
    """Return what a file holds.

    Raises
    ------
    FootageError
        It cannot be read, or is larger than a picture with as many pixels as are read.
    """
    most = BYTES_A_PIXEL * max_pixels()
    try:
        return read_plain(path, most)
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise FootageError(
                f"{path} is larger than a picture of {max_pixels()} pixels, which are read at most: "
                f"set {MAX_PIXELS} to a larger number if your camera has that many"
            ) from None
        raise FootageError(f"cannot read {path}: {error.strerror or error}") from None


def check_whole(path: Path, data: bytes) -> None:
    """Check that an image file's end is there.

    Raises
    ------
    FootageError
        It is not.
    """
    for start, end in _ENDS.items():
        if data.startswith(start) and end not in data[-1024:]:
            raise FootageError(f"{path} is truncated: copy it again")


def decode_levels(path: Path, data: bytes) -> npt.NDArray[Any]:
    """Return an image's levels as they are stored: (H, W) grey, or (H, W, 3 or 4) blue, green, red and alpha.

    Raises
    ------
    FootageError
        It is no image, or its values are neither of 8 or 16 bits nor float32.
    """
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    image: npt.NDArray[Any] | None = None
    size_px = picture_size(data)
    if size_px is not None:
        check_size(str(path), *size_px)
        if data.startswith(_PNG):
            data = _only_pixels(path, data)
        elif data.startswith(_JPEG):
            _check_jpeg(path, data)
        with suppress(cv2.error):  # the message below says it in one line
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or size_px is None:
        raise FootageError(f"{path} is not a picture that can be read: give a PNG, TIFF or JPEG file")
    # OpenCV turns TIFF by its orientation.
    turned = size_px[::-1] if data[:2] in (b"II", b"MM") else size_px
    if image.shape[1::-1] not in (size_px, turned):
        raise FootageError(f"{path} is damaged: copy it again")
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise FootageError(f"{path} holds {image.dtype} values: save it with 8 or 16 bits")
    levels: npt.NDArray[Any] = image
    return levels


def _check_jpeg(path: Path, data: bytes) -> None:
    """Check a JPEG for damage, which OpenCV only prints, past everything that could catch it."""
    try:
        JpegDecoder().decode(data)
    except FootageError as error:
        raise FootageError(f"{path}: {error}") from None


def _only_pixels(path: Path, data: bytes) -> bytes:
    """Return a PNG with nothing but the chunks that make its levels, each checked.

    OpenCV decodes damaged chunks as far as it can, and libpng prints warnings of them, and of colour profiles and
    texts, past everything that could catch them.

    Raises
    ------
    FootageError
        A checksum is wrong.
    """
    kept: list[bytes | memoryview] = [_PNG]
    begin, kind = len(_PNG), b""
    view = memoryview(data)
    while kind != b"IEND" and begin + 12 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, begin)
        end = begin + 12 + size
        if end > len(data) or zlib.crc32(view[begin + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise FootageError(f"{path} is damaged: copy it again")
        if kind[:1].isupper() or kind == b"tRNS":
            kept.append(view[begin:end])
        begin = end
    return b"".join(kept)


def read_codes(path: str | Path) -> npt.NDArray[np.uint8]:
    """Read a PNG as the codes that a projector is to show.

    Returns
    -------
    (H, W, 3) uint8
        Codes of R, G, B; of a grey image three times the same.

    Raises
    ------
    FootageError
        The file cannot be read, is truncated, is no PNG, or is none of 8 bits without transparency.
    """
    path = Path(path)
    data = read_bytes(path)
    if not data.startswith(_PNG):
        raise FootageError(f"{path} is no PNG: make one with colorphase pattern; other formats change colours")
    check_whole(path, data)
    image = decode_levels(path, data)
    if image.dtype != np.uint8:
        raise FootageError(f"{path} has 16 bits a colour, and displays take 8: save it with 8 bits")
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    if image.shape[2] != 3:
        raise FootageError(f"{path} has {image.shape[2]} channels: save it without transparency")
    return np.ascontiguousarray(image[..., ::-1])


def read_image(path: str | Path) -> ImageArray:
    """Read an image file as RGB.

    Returns
    -------
    (H, W, 3) uint8, uint16 or float32
        The levels as they are stored, turned as the camera was held (Exif).

    Raises
    ------
    FootageError
        The file cannot be read, is truncated, is no image, or has no three colours.
    """
    path = Path(path)
    data = read_bytes(path)
    check_whole(path, data)
    if is_heic(data[:12]):
        try:
            return cast(ImageArray, read_heic(data)[0])
        except FootageError as error:
            raise FootageError(f"{path}: {error}") from None
    if (unfit := unfit_colors(data)) is not None:
        raise FootageError(f"{path}: {unfit}")
    image = decode_levels(path, data)
    if image.ndim == 2:
        raise FootageError(f"{path} is grey: the phase is in the colours, give a colour picture")
    if image.shape[2] != 3:
        raise FootageError(f"{path} has {image.shape[2]} channels: save it without transparency")
    upright_image = upright(image[..., ::-1], read_tags(data).orientation)
    return cast(ImageArray, np.ascontiguousarray(upright_image))


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
