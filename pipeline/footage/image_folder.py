"""Frames from image files: a folder of them in their natural order, a single one, or the pages of one."""

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import cv2

from pipeline.errors import FootageError
from pipeline.footage.ffmpeg_frames import stored_planes
from pipeline.footage.footage import GREY, BadFrame, Footage, Frames, StoredAs, StoredFrame, other_than_first, turned
from pipeline.footage.heic_file import is_heic, read_heic
from pipeline.footage.image_file import PlaneDecoder, decode_levels, read_bytes, read_picture, tiff_pages
from pipeline.footage.picture_tags import (
    TRANSPARENT,
    PictureTags,
    is_transparent,
    other_orientation,
    picture_end,
    plane_codec,
    read_tags,
    stored_bits,
    unfit_colors,
)
from pipeline.footage.tiff_file import TIFF_MARKS, Tag, read_directory, select_page
from pipeline.limits import open_plain
from pipeline.models import ImageArray, SensorPart
from tikernels.errors import ShapeError
from tikernels.raw.pixel_format import FLOAT_BITS, PixelFormat

#: How the names of image files end.
IMAGE_SUFFIXES = tuple(".png .tif .tiff .bmp .ppm .pgm .pnm .webp .heic .heif .jpg .jpeg .jpe".split())
_DIGITS = re.compile(r"(\d+)")
# Full scale of most cameras with more than 8 bits, levels.
_PART_SCALES = tuple(2**bits - 1 for bits in range(9, 16))


def natural_key(name: str) -> tuple[list[int | str], str]:
    """Return what sorts names as people do: frame2 before frame10."""
    # Digits are at every odd place, so numbers never meet letters; the name itself settles 1 and 01.
    parts: list[int | str] = [int(part) if i % 2 else part.casefold() for i, part in enumerate(_DIGITS.split(name))]
    return (parts, name)


class ImageFolder(Footage):
    """Image files of one folder, each read when its turn comes.

    Parameters
    ----------
    name : str
        As the user gave it.
    folder : Path
        Their folder.
    names : sequence of str
        Names of the files, in order.
    says : StoredAs
        The user's description of the pixels.
    stack : _Stack, optional
        The pages of a single file, in place of files.

    Raises
    ------
    FootageError
        None of them can be read.
    """

    def __init__(
        self, name: str, folder: Path, names: Sequence[str], says: StoredAs, stack: "_Stack | None" = None
    ) -> None:
        self.name = name
        self.sensor: SensorPart | None = None
        self._folder = folder
        self.names = names
        self._says = says
        self._stack = stack
        self._decoders = {codec: PlaneDecoder(codec) for codec in ("mjpeg", "webp")}
        reason = ""
        for number in range(len(names)):
            try:
                planes, self.format, self._tags = self._read(number)
            except FootageError as error:
                reason = reason or str(error)
                continue
            self.transfer, self.transfer_because = self._tags.transfer, self._tags.because
            self.notes = self._tags.notes
            self.size_px = (planes[0].shape[1], planes[0].shape[0])
            return
        if len(names) > 1:
            reason = f"cannot read {name}: none of its {len(names)} pictures can be read; the first: {reason}"
        raise FootageError(reason)

    @classmethod
    def in_folder(cls, folder: Path, says: StoredAs, listed: Sequence[str] | None = None) -> "ImageFolder":
        """Take every image file of a folder, in the natural order of their names; or those that were listed before.

        Raises
        ------
        FootageError
            There is none, or none can be read.
        """
        # Names alone: querying the file system about each of 100,000 files takes longer than reading the list.
        names = listed or sorted(
            (name for name in os.listdir(folder) if name.lower().endswith(IMAGE_SUFFIXES) and name[0] != "."),
            key=natural_key,
        )
        if not names:
            raise FootageError(f"{folder} holds no pictures: give a folder of PNG, TIFF or JPEG files, or a video")
        return cls(str(folder), folder, names, says)

    @classmethod
    def of_file(cls, path: Path, says: StoredAs) -> "ImageFolder":
        """Take a single picture, or each page of a TIFF file.

        Raises
        ------
        FootageError
            It cannot be read.
        """
        stack = _stack_of(path)
        return cls(str(path), path.parent, [path.name] * (1 if stack is None else len(stack.places)), says, stack)

    def __len__(self) -> int:
        return len(self.names)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Frames:
        """Yield frames by number; see `Footage`."""
        for number in range(len(self))[start:stop:step]:
            try:
                planes, format, tags = self._read(number)
            except FootageError as error:
                yield BadFrame(number, str(error))
                continue
            size_px = (planes[0].shape[1], planes[0].shape[0])
            reason = _other_tags(tags, self._tags) or other_than_first(format, size_px, self)
            if reason is not None:
                yield BadFrame(number, f"{self.names[number]}: {reason}")
            else:
                yield StoredFrame(number, planes, format)

    def files(self) -> list[Path]:
        """Return the pictures' files; see `Footage`."""
        return [self._folder / name for name in (self.names if self._stack is None else self.names[:1])]

    def _read(self, number: int) -> tuple[tuple[ImageArray, ...], PixelFormat, PictureTags]:
        """Return a picture's planes as it is to be seen, how they are stored, and what its file states."""
        path = self._folder / self.names[number]
        try:
            data = read_picture(path) if self._stack is None else self._stack.page(number)
            if is_heic(data[:12]):
                planes, format, tags = read_heic(data)
                return planes, self._says.applied_to(format), tags
            if (unfit := unfit_colors(data)) is not None:
                raise FootageError(unfit)
            if (codec := plane_codec(data)) is None:
                planes, format, tags = self._read_levels(path, data)
            else:  # libraries' RGB costs more (see `tikernels.raw.chroma_upsampling`)
                planes, format, _ = stored_planes(self._decoders[codec].decode(data), codec, self._says)
                tags = read_tags(data)
            return (*turned(planes, format, tags.orientation), tags)
        except (FootageError, ShapeError) as error:
            text = str(error)
            raise FootageError(text if str(path) in text else f"{path}: {text}") from None

    def _read_levels(self, path: Path, data: bytes) -> tuple[tuple[ImageArray, ...], PixelFormat, PictureTags]:
        image, tags = decode_levels(path, data), read_tags(data)
        bits, shift = {"uint8": 8, "uint16": 16}.get(image.dtype.name, FLOAT_BITS), 0
        if data[:4] in TIFF_MARKS and (fewer := read_directory(data).first(Tag.BITS, 1)) in range(9, 16):
            bits, shift = fewer, 16 - fewer  # OpenCV shifts them up
        bits = stored_bits(data) or bits
        if bits == 16 and self._says.bits is None:
            # TIFF's largest level is no full scale, but a camera's own of fewer bits is seldom anything else.
            most = read_directory(data).first(Tag.MOST, 0) if data[:4] in TIFF_MARKS else 0
            fewer = most.bit_length() if most in _PART_SCALES else 12
            if image.max(initial=0) < 2**fewer:
                words = "none of its levels, of 16 bits, is above"
                note = f"{words} {2**fewer - 1}: if the camera gives {fewer}, add --bits {fewer}"
                tags = replace(tags, notes=(*tags.notes, note))
        if image.ndim == 2:
            if self._says.bayer is None:
                raise FootageError(GREY)
            return (image,), self._says.applied_to(PixelFormat("bayer", bits, shift)), tags
        if is_transparent(image):
            tags = replace(tags, notes=(*tags.notes, TRANSPARENT))
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB)
        return (image,), self._says.applied_to(PixelFormat("rgb", bits, shift)), tags


@dataclass(frozen=True)
class _Stack:
    """A TIFF file of several pages, which is read once."""

    path: Path
    data: bytearray
    places: list[int]  # where each page's directory begins

    def page(self, number: int) -> bytes:
        """Return a file whose first page is this one, until the next call.

        Raises
        ------
        FootageError
            It is truncated.
        """
        select_page(self.data, self.places[number])
        page = cast(bytes, self.data)  # a copy for each page would take longer than decoding it
        if picture_end(page) is None:
            raise FootageError(f"page {number + 1} of {self.path} is truncated: copy it again")
        return page


def _stack_of(path: Path) -> _Stack | None:
    """Return the pages of a TIFF file that has several; None: it is another file, or cannot be read.

    Raises
    ------
    FootageError
        One of its pages is damaged.
    """
    with open_plain(path) as file:
        if file.read(4) not in TIFF_MARKS:
            return None
    data = read_bytes(path)
    places = tiff_pages(path, data)
    return _Stack(path, bytearray(data), places) if len(places) > 1 else None


def is_footage(path: Path) -> bool:
    """Return whether a path is that of several pictures, or of no picture."""
    if path.suffix.lower() not in IMAGE_SUFFIXES or path.is_dir():
        return True
    with suppress(OSError):  # it is read again, and then reports it
        return path.is_file() and _stack_of(path) is not None
    return False


def _other_tags(tags: PictureTags, first: PictureTags) -> str | None:
    """Say how a picture's file describes it otherwise than the first; None: alike."""
    if (turned_otherwise := other_orientation(tags.orientation, first.orientation)) is not None:
        return turned_otherwise
    if tags.transfer != first.transfer:
        return (
            f"its light is {tags.transfer or 'linear'} ({tags.because}), the first is {first.transfer or 'linear'} "
            f"({first.because}): save all alike"
        )
    return None
