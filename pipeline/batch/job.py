"""A decoding job: all that a process needs in order to do a part of it, the same everywhere."""

import hashlib
import math
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibration import Calibration
from pipeline.decoder import Decoder
from pipeline.decoding.doubts import CODE_SHOWN
from pipeline.decoding.footage_light import with_transfer_of
from pipeline.decoding.labels import result_attributes
from pipeline.decoding.rig_state import RigState
from pipeline.errors import DecodeWarning, FootageError, SettingsError
from pipeline.footage.footage import Footage, StoredAs, StoredFrame
from pipeline.footage.image_folder import ImageFolder
from pipeline.footage.opening import open_footage
from pipeline.limits import BYTES_A_PIXEL, max_pixels
from pipeline.models import ImageArray
from pipeline.output.folder import file_digest
from pipeline.output.store import ResultStore, camera_attribute, frame_bytes
from pipeline.settings import DecodeSettings
from pipeline.text import one_line
from tikernels.arrays import LevelsImage
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat

#: Frames a chain. In a chain each frame is decoded with the one before, the first one without: so a missing frame is
#: decoded anew from the beginning of its chain.
CHAIN_FRAMES = 64
# Frames, evenly spaced, that are checked for the light before it counts as unknown, and for the side in front.
_MOST_ASKED, _ASKED_FOR_SIDE = 64, 16
# The digest of a file that cannot be read, or may be another one by now.
_UNKNOWN = bytes(16)


@dataclass(frozen=True)
class Crop:
    """The part of every frame that is decoded, px: a region of interest.

    Examples
    --------
    >>> part = colorphase.Crop(x=64, y=48, width=320, height=240)
    >>> part.width * part.height
    76800
    """

    x: int
    y: int
    width: int
    height: int

    def of(self, planes: tuple[ImageArray, ...], format: PixelFormat) -> tuple[tuple[ImageArray, ...], PixelFormat]:
        """Return this part of a frame's planes, as views, and how they are stored."""
        cut = []
        for plane, chroma in zip(planes, (False, True, True), strict=False):
            (across, down), (left, above) = (format.subsampling, format.origin) if chroma else ((1, 1), (0, 0))
            x, y = self.x + left, self.y + above
            cut.append(plane[y // down : -(-(y + self.height) // down), x // across : -(-(x + self.width) // across)])
        (across, down), (left, above) = format.subsampling, format.origin
        origin = ((self.x + left) % across, (self.y + above) % down)
        return tuple(cut), replace(format, origin=origin)

    def check(self, size_px: tuple[int, int], format: PixelFormat) -> None:
        """Refuse a part that is not one.

        Raises
        ------
        SettingsError
            It sticks out of the frame, or begins within a cell of a mosaic.
        """
        width, height = size_px
        if min(self.x, self.y) < 0 or self.x + self.width > width or self.y + self.height > height:
            raise SettingsError(f"the region of interest sticks out of the {width}x{height} frame: make it smaller")
        if format.layout == "bayer" and (self.x % 2 or self.y % 2):
            raise SettingsError(
                f"the region of interest begins at {self.x},{self.y}, within a cell of this footage's mosaic: "
                "begin at a multiple of 2,2"
            )


@dataclass(frozen=True)
class Learnt:
    """Properties of footage that are estimated before its frames are decoded for good."""

    state: RigState = field(default_factory=RigState)
    notes: tuple[str, ...] = ()  # what the user should know of the light and of a code that frames show
    frame_bytes: int | None = None  # of the last frame that was checked, in the store; None: none can be decoded


_NOTHING = Learnt()


@dataclass(frozen=True)
class Job:
    """Footage, and how its frames are decoded.

    A frame's result depends on this and on its number alone, not on what was decoded before or where.
    """

    footage: str
    says: StoredAs
    settings: DecodeSettings
    calibration: Calibration | None  # of the whole frame
    crop: Crop | None
    step: int  # from one frame that is decoded to the next
    first: int  # the first frame that is decoded, below the step
    fields: tuple[str, ...]
    store: str
    arch: str
    listed: tuple[str, ...] | None = None  # names of a folder's pictures; None: all that are there
    digests: tuple[bytes, ...] = ()  # of each frame's file, or of the one that holds all
    stamps: tuple[tuple[int, ...], ...] = ()  # of the same files, before they were read; (): they are not watched

    def open(self) -> Footage:
        """Open the footage.

        Raises
        ------
        FootageError, CalibrationError, SettingsError
            It cannot be read, or the calibration or the region of interest does not fit it.
        """
        source = open_footage(self.footage, listed=self.listed, **vars(self.says))
        self._calibration_of(source)
        if self.crop is not None:
            self.crop.check(source.size_px, source.format)
        return source

    def size_px(self, source: Footage) -> tuple[int, int]:
        """Return width and height of what is decoded of a frame."""
        return source.size_px if self.crop is None else (self.crop.width, self.crop.height)

    def pinned(self, source: Footage) -> "Job":
        """Return the same for the footage as it is now: which pictures, what they hold, and how light is encoded.

        All of it is read. The light is encoded as the footage states where neither settings nor calibration do; the
        calibration is that of the part of the sensor that frames are.
        """
        files = source.files()
        most_bytes = BYTES_A_PIXEL * max_pixels() if len(files) > 1 else math.inf  # a longer picture is bad
        return replace(
            self,
            calibration=self._calibration_of(source),
            settings=with_transfer_of(source, self.settings, self.calibration)[0],
            listed=tuple(source.names) if isinstance(source, ImageFolder) else None,
            stamps=tuple(map(_stamp, files)),
            digests=tuple(_digest(file, most_bytes) for file in files),
        )

    def pins(self, number: int, files: Sequence[Path]) -> bool:
        """Return whether a frame's file, of the footage's files, is surely the one that was pinned."""
        place = min(number, len(files) - 1)
        return not self.stamps or _stamp(files[place]) == self.stamps[place]

    def without(self, number: int) -> "Job":
        """Return the same for footage of which it is not known what a frame is: what leans on it is decoded again."""
        place = min(number, len(self.digests) - 1)
        return replace(self, digests=(*self.digests[:place], _UNKNOWN, *self.digests[place + 1 :]))

    def made_of(self, number: int) -> str:
        """Return a digest of what a frame is decoded from: its file, and those before it in its chain."""
        if len(self.digests) < 2:
            return b"".join(self.digests).hex()
        length = CHAIN_FRAMES * self.step
        begin = self.first + (number - self.first) // length * length
        return hashlib.sha256(b"".join(self.digests[begin : number + 1 : self.step])).hexdigest()[:32]

    def identity(self, source: Footage) -> dict[str, Any]:
        """Return all that a frame's result depends on, except its number, as JSON."""
        return {
            **result_attributes(self.settings, self.calibration),
            "footage": {
                "name": one_line(Path(self.footage).name),
                "frames": len(source),
                "size_px": list(source.size_px),
                "stored_as": asdict(source.format),
                "first_frame_sha256": _fingerprint(source),
            },
            "region_of_interest": None if self.crop is None else asdict(self.crop),
            "step": self.step,
            "first": self.first,
            "chain_frames": CHAIN_FRAMES,
        }

    def open_store(self, source: Footage) -> ResultStore:
        """Open the store.

        Raises
        ------
        OutputError
            It is not there, or holds something else.
        """
        return ResultStore(self.store, self.identity(source), self.fields)

    def make_store(self, source: Footage, learnt: Learnt = _NOTHING) -> ResultStore:
        """Make what is missing of the store, with what has been learnt of its footage.

        Raises
        ------
        OutputError
            It holds something else, or cannot be written.
        """
        also = {
            "light": None if learnt.state.light is None else learnt.state.light.model_dump(mode="json"),
            "code": learnt.state.code,
            "rims": asdict(learnt.state.rims),
            **camera_attribute(self._calibration_of_part()),
        }
        identity, size_px = self.identity(source), self.size_px(source)
        return ResultStore.make(self.store, identity, self.fields, len(source), size_px, also, times=source.times)

    def decoder(self) -> Decoder:
        """Return a decoder of such frames."""
        settings = self.settings
        if settings.fields is not None and settings.row_s > 0 and self.crop is not None and self.crop.y > 0:
            fields = settings.fields.model_copy(update={"locked": False})  # these rows start later in the cycle
            settings = settings.model_copy(update={"fields": fields})
        return Decoder(settings, self._calibration_of_part(), arch=self.arch)

    def _calibration_of(self, source: Footage) -> Calibration | None:
        """Return the calibration of the footage's whole frames; see `Calibration.as_read_out`."""
        if self.calibration is None:
            return None
        return self.calibration.as_read_out(source.size_px, source.sensor, source.name)

    def _calibration_of_part(self) -> Calibration | None:
        """Return the calibration of what is decoded of a frame."""
        if self.calibration is None or self.crop is None:
            return self.calibration
        return self.calibration.cropped(self.crop.x, self.crop.y, (self.crop.width, self.crop.height))

    def develop(self, stored: StoredFrame, out: LevelsImage | None) -> LevelsImage:
        """Return what is decoded of a frame, as RGB, in a buffer that can be passed as `out` again."""
        planes, format = stored.planes, stored.format
        if self.crop is not None:
            planes, format = self.crop.of(planes, format)
        image: LevelsImage = develop(planes, format, stripes=self.settings.stripes, out=out)
        return image

    def learn(self, source: Footage) -> Learnt:
        """Learn the light, a code, and which side is in front from the footage, where nothing else states them.

        Of 64 evenly spaced frames, the first with fringes shows whether there is a code, and the first whose light can
        be estimated its light; of 16, the first that shows the side clearly.
        """
        state = RigState()
        size: int | None = None
        notes: tuple[str, ...] = ()
        asked = range(0, len(source), -(-len(source) // _MOST_ASKED))
        for turn, number in enumerate(asked):
            if "light" not in state.asks and turn % -(-len(asked) // _ASKED_FOR_SIDE):
                continue
            stored = next(iter(source.frames(number, number + 1)))
            if not isinstance(stored, StoredFrame):
                continue
            decoder = self.decoder()
            decoder.state = state
            known = "light" not in decoder.state.asks
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", DecodeWarning)  # its frame is decoded again, and then warns
                    frame = decoder.decode(self.develop(stored, None))
            except FootageError:
                continue
            estimated = decoder.state
            state = replace(state, rims=estimated.rims)
            size = frame_bytes(frame, self.fields)
            if frame.period_px is not None and "code" in state.asks:
                state = replace(state, code=estimated.code, asks=state.asks - {"code"})
                notes = tuple(note for note in frame.warnings if note == CODE_SHOWN)
            shows_light = known or (estimated.light is not None and estimated.light.reliable)
            if frame.period_px is not None and shows_light and "light" in state.asks:
                state = replace(state, light=estimated.light, asks=state.asks - {"light"})
                notes += tuple(note for note in frame.warnings if note not in notes)
            if "light" not in state.asks and "rims" not in estimated.asks:
                break
        return Learnt(state, notes, size)


def chains(wanted: range, missing: set[int]) -> Iterator[tuple[range, frozenset[int]]]:
    """Yield what is to be decoded for the missing ones of some frames: ranges, and which of them are missing.

    A range begins where its chain does and ends with the last missing frame.
    """
    step, first = wanted.step, wanted.start % wanted.step
    length = CHAIN_FRAMES * step
    lacking: dict[int, list[int]] = {}
    for number in wanted:
        if number in missing:
            lacking.setdefault((number - first) // length, []).append(number)
    for chain, numbers in lacking.items():
        yield range(first + chain * length, numbers[-1] + 1, step), frozenset(numbers)


def join_ranges(ranges: Sequence[range]) -> Iterator[range]:
    """Join ranges that follow on each other, so that footage is read in one go."""
    joined: range | None = None
    for following in ranges:
        if joined is not None and following.start == joined[-1] + joined.step:
            joined = range(joined.start, following.stop, joined.step)
            continue
        if joined is not None:
            yield joined
        joined = following
    if joined is not None:
        yield joined


def _fingerprint(source: Footage) -> str | None:
    """Return a SHA-256 of the first good frame's values."""
    for stored in source.frames():
        if isinstance(stored, StoredFrame):
            digest = hashlib.sha256()
            for plane in stored.planes:
                digest.update(np.ascontiguousarray(plane).tobytes())
            return digest.hexdigest()
    return None


def _digest(path: Path, most_bytes: float) -> bytes:
    """Return a digest of a file, of 16 bytes; of one that cannot be read, whose frame is bad, zeros."""
    digest = file_digest(path, most_bytes)
    return _UNKNOWN if digest is None else bytes.fromhex(digest)[:16]


def _stamp(path: Path) -> tuple[int, ...]:
    """Return what changes when a file does, even where its time is set back; nothing of one that is not there."""
    try:
        about = os.stat(path)
    except OSError:
        return ()
    return about.st_size, about.st_mtime_ns, about.st_ctime_ns
