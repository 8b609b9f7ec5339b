"""Read a colour image, or explain in one line why it is none.

JPEG is decoded by FFmpeg, which reports what is wrong with a picture where other decoders fill it up with grey, and so
are the planes of WebP; HEIC by libheif; all else by OpenCV.
"""

import errno
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import FootageError
from pipeline.footage.ffmpeg_frames import caught_messages
from pipeline.footage.heic_file import is_heic, read_heic
from pipeline.footage.picture_tags import (
    JPEG,
    PNG,
    picture_end,
    picture_size,
    png_chunks,
    read_tags,
    stored_bits,
    unfit_colors,
    upright,
)
from pipeline.footage.tiff_file import (
    TIFF_MARKS,
    as_stored,
    first_page_place,
    is_damaged,
    page_places,
    pages_elsewhere,
    read_directory,
    select_page,
)
from pipeline.limits import ALLOW_MORE, BYTES_A_PIXEL, check_size, ffmpeg_limits, max_pixels, read_plain
from pipeline.models import ImageArray

_NONSENSE = (struct.error, ValueError)


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
        if error.errno == errno.EOVERFLOW:
            raise FootageError(
                f"{path} is larger than a picture of {max_pixels()} pixels, which are read at most: {ALLOW_MORE}"
            ) from None
        raise FootageError(f"cannot read {path}: {error.strerror or error}") from None


def read_picture(path: Path) -> bytes:
    """Return a file's picture: what holds one that is complete, without what other programs put behind it.

    Raises
    ------
    FootageError
        It cannot be read, is truncated, or has several pages.
    """
    data = read_bytes(path)
    end = picture_end(data)
    if end is None:
        raise FootageError(f"{path} is truncated: copy it again")
    pages = tiff_pages(path, data)
    if len(pages) > 1:
        raise FootageError(
            f"{path} has {len(pages)} pages: save each as a file of its own, or decode the file by itself"
        )
    if pages and pages != [first_page_place(data)]:  # behind a smaller version
        file = bytearray(data)
        select_page(file, pages[0])
        return bytes(file)
    return data[:end]


def tiff_pages(path: Path, data: bytes) -> list[int]:
    """Return where the directories of a TIFF file's pages begin; of another file none.

    Raises
    ------
    FootageError
        It is damaged, or not all of its pages can be found.
    """
    if data[:4] not in TIFF_MARKS:
        return []
    try:
        places = page_places(data)
        lost = pages_elsewhere(read_directory(data), len(places))
    except _NONSENSE:
        raise FootageError(f"{path} is truncated or damaged: copy it again") from None
    if lost:
        raise FootageError(
            f"{path} is a stack by ImageJ, {lost} of whose pages are not listed: save it in parts of less than 4 GB"
        )
    return places


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
        if data.startswith(PNG):
            data = _only_pixels(path, data)
        elif data.startswith(JPEG):
            with _named(path):  # OpenCV only prints damage, past everything that could catch it
                PlaneDecoder("mjpeg").decode(data)
        elif data[:4] in TIFF_MARKS:
            data = _checked_page(path, data)
        with suppress(cv2.error):  # the message below reports it in one line
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or size_px is None:
        raise FootageError(f"{path} is not a picture that can be read: give a PNG, TIFF or JPEG file")
    if image.shape[1::-1] != size_px:
        raise FootageError(f"{path} is damaged: copy it again")
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise FootageError(f"{path} holds {image.dtype} values: save it with 8 or 16 bits")
    levels: npt.NDArray[Any] = image
    return levels


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Name the file whose picture is damaged."""
    try:
        yield
    except FootageError as error:
        raise FootageError(f"{path}: {error}") from None


def _checked_page(path: Path, data: bytes) -> bytes:
    """Return a TIFF whose page OpenCV decodes as it is stored; of what is damaged there it makes black."""
    with suppress(*_NONSENSE):
        if not is_damaged(data, read_directory(data)):
            return as_stored(data)
    raise FootageError(f"{path} is damaged: copy it again")


def _only_pixels(path: Path, data: bytes) -> bytes:
    """Return a PNG with nothing but the chunks that make its levels, each with a right checksum.

    OpenCV decodes damaged chunks as far as it can, and libpng prints warnings of them, and of colour profiles and
    texts, past everything that could catch them.
    """
    kept: list[bytes | memoryview] = [PNG]
    view = memoryview(data)
    for kind, begin, end in png_chunks(data):
        if end > len(data) or zlib.crc32(view[begin - 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise FootageError(f"{path} is damaged: copy it again")
        if kind[:1].isupper() or kind == b"tRNS":
            kept.append(view[begin - 8 : end])
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
    data = read_picture(path)
    if not data.startswith(PNG):
        raise FootageError(f"{path} is no PNG: make one with colorphase pattern; other formats change colours")
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
        The file cannot be read, is truncated, is no image, or has no three colours, or these are HEIC's of half the
        resolution.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> import cv2
    >>> _ = cv2.imwrite("picture.png", colorphase.simulate_frame(rig).image[..., ::-1])
    >>> colorphase.read_image("picture.png").shape
    (120, 160, 3)
    """
    return read_turned(Path(path))[0]


def read_turned(path: Path) -> tuple[ImageArray, int]:
    """Return an image file as `read_image` does, and the orientation (Exif) by which it was turned."""
    data = read_picture(path)
    if is_heic(data[:12]):
        with _named(path):
            planes, format, tags = read_heic(data)
        if format.layout != "rgb":
            raise FootageError(
                f"{path}: its colours have half the resolution: open_footage and develop interpolate them"
            )
        return planes[0], tags.orientation
    if (unfit := unfit_colors(data)) is not None:
        raise FootageError(f"{path}: {unfit}")
    image = decode_levels(path, data)
    if image.ndim == 2:
        raise FootageError(f"{path} is grey: the phase is in the colours, give a colour picture")
    if image.shape[2] != 3:
        raise FootageError(f"{path} has {image.shape[2]} channels: save it without transparency")
    if (bits := stored_bits(data)) is not None:  # full scale is that of their type
        image = image << (8 * image.itemsize - bits)
    orientation = read_tags(data).orientation
    return cast(ImageArray, np.ascontiguousarray(upright(image[..., ::-1], orientation))), orientation


class PlaneDecoder:
    """Decode pictures one after another, by a codec of FFmpeg; see `plane_codec`."""

    def __init__(self, codec: str) -> None:
        self._codec = codec
        self._context: Any = None

    def decode(self, data: bytes) -> Any:
        """Return FFmpeg's frame of a file.

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
            self._context = av.CodecContext.create(self._codec, "r")
            self._context.options = ffmpeg_limits()
        frames = []
        with caught_messages() as said, suppress(av.error.FFmpegError):
            frames = self._context.decode(av.Packet(data))
        if said or not frames:
            self._context = None  # what it made of this one may stay in its state
            raise FootageError(f"it is damaged ({said[0] if said else 'nothing can be decoded'}): copy it again")
        return frames[0]
