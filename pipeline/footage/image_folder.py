"""Frames from image files: a folder of them in their natural order, or a single one."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import FootageError
from pipeline.footage.ffmpeg_frames import stored_planes
from pipeline.footage.image_file import JpegDecoder, check_whole, decode_levels, is_heic, read_bytes, read_heic
from pipeline.footage.picture_tags import PictureTags, read_tags, unfit_colors
from pipeline.footage.source import GREY, BadFrame, Frames, StoredAs, StoredFrame, other_than_first, turned
from pipeline.models import ImageArray
from tikernels.errors import ShapeError
from tikernels.raw.pixel_format import FLOAT_BITS, PixelFormat

_JPEG_SUFFIXES = (".jpg", ".jpeg", ".jpe")
#: How the names of image files end.
IMAGE_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".pnm", ".webp", ".heic", ".heif", *_JPEG_SUFFIXES)
_DIGITS = re.compile(r"(\d+)")


def natural_key(name: str) -> tuple[list[int | str], str]:
    """Return what sorts names as people do: frame2 before frame10."""
    # Digits stand at every odd place, so numbers never meet letters; the name itself settles 1 and 01.
    parts: list[int | str] = [int(part) if i % 2 else part.casefold() for i, part in enumerate(_DIGITS.split(name))]
    return (parts, name)


class ImageFolder:
    """Image files of one folder, each read when its turn comes; a `Source`.

    Parameters
    ----------
    name : str
        What the user gave.
    folder : Path
        Where they are.
    names : sequence of str
        Which files, in order.
    says : StoredAs
        What the user says of the pixels.

    Raises
    ------
    FootageError
        None of them can be read.
    """

    def __init__(self, name: str, folder: Path, names: Sequence[str], says: StoredAs) -> None:
        self.name = name
        self._folder = folder
        self.names = names
        self._says = says
        self._jpeg_decoder = JpegDecoder()
        self.notes: tuple[str, ...] = ()
        reason = ""
        self.transfer: str | None = None
        self.transfer_because = ""
        for number in range(len(names)):
            try:
                planes, self.format, tags = self._read(number)
            except FootageError as error:
                reason = reason or str(error)
                continue
            self.transfer, self.transfer_because = tags.transfer, tags.because
            self.size_px = (planes[0].shape[1], planes[0].shape[0])
            return
        if len(names) > 1:
            reason = f"cannot read {name}: none of its {len(names)} pictures can be read; the first: {reason}"
        raise FootageError(reason)

    @classmethod
    def in_folder(cls, folder: Path, says: StoredAs) -> "ImageFolder":
        """Take every image file of a folder, in the natural order of their names.

        Raises
        ------
        FootageError
            There is none, or none can be read.
        """
        # Names alone: asking the file system about each of 100,000 files takes longer than reading the list.
        names = [name for name in os.listdir(folder) if name.lower().endswith(IMAGE_SUFFIXES) and name[0] != "."]
        if not names:
            raise FootageError(f"{folder} holds no pictures: give a folder of PNG, TIFF or JPEG files, or a video")
        return cls(str(folder), folder, sorted(names, key=natural_key), says)

    def __len__(self) -> int:
        return len(self.names)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Frames:
        """Yield frames by number; see `Source`."""
        for number in range(len(self))[start:stop:step]:
            try:
                planes, format, _ = self._read(number)
            except FootageError as error:
                yield BadFrame(number, str(error))
                continue
            size_px = (planes[0].shape[1], planes[0].shape[0])
            reason = other_than_first(format, size_px, self)
            if reason is not None:
                yield BadFrame(number, f"{self.names[number]}: {reason}")
            else:
                yield StoredFrame(number, planes, format)

    def close(self) -> None:
        """Do nothing: no file is open between two frames."""

    def _read(self, number: int) -> tuple[tuple[ImageArray, ...], PixelFormat, PictureTags]:
        """Return a picture's planes as it is to be seen, how they are stored, and what its file says."""
        path = self._folder / self.names[number]
        data = read_bytes(path)
        check_whole(path, data)
        if is_heic(data[:12]):
            try:
                levels, tags = read_heic(data)
            except FootageError as error:
                raise FootageError(f"{path}: {error}") from None
            bits = 8 if levels.dtype == np.uint8 else 16
            return (levels,), self._says.applied_to(PixelFormat("rgb", bits)), tags
        tags = read_tags(data)
        planes, format = self._read_stored(path, data)
        return (*turned(planes, format, tags.orientation), tags)

    def _read_stored(self, path: Path, data: bytes) -> tuple[tuple[ImageArray, ...], PixelFormat]:
        try:
            if data.startswith(b"\xff\xd8\xff"):
                return self._read_jpeg(data)
            if (unfit := unfit_colors(data)) is not None:
                raise FootageError(unfit)
            image = decode_levels(path, data)
            bits = {"uint8": 8, "uint16": 16}.get(image.dtype.name, FLOAT_BITS)
            if image.ndim == 2:
                if self._says.bayer is None:
                    raise FootageError(GREY)
                return (image,), self._says.applied_to(PixelFormat("bayer", bits))
            image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB)
            return (image,), self._says.applied_to(PixelFormat("rgb", bits))
        except (FootageError, ShapeError) as error:
            text = str(error)
            raise FootageError(text if text.startswith(str(path)) else f"{path}: {text}") from None

    def _read_jpeg(self, data: bytes) -> tuple[tuple[ImageArray, ...], PixelFormat]:
        """Read a JPEG's planes: libraries' RGB costs more (see `tikernels.raw.chroma_upsampling`)."""
        planes, format, _ = stored_planes(self._jpeg_decoder.decode(data), "mjpeg", self._says)
        return planes, format
