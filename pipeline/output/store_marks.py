"""Marks of a store's frames: who has one is whole. A mark names the checksum of each of its frame's chunks.

So a chunk that is missing, changed, or another frame's is noticed, and so is a frame that was decoded otherwise than
its store says.
"""

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.decoding.frame import FIELDS, DecodedFrame
from pipeline.errors import DamageError
from pipeline.output.store_files import StoreFiles
from pipeline.output.store_metadata import DONE, MARK_BYTES
from pipeline.zarr_chunks import chunk_key, with_checksum, without_checksum

#: The attributes that footage itself has told, and tells again, and what follows from others; the rest are what its
#: frames depend on.
LEARNT = ("light", "rims", "camera")

_KEY = re.compile(r"c\.(\d{1,18})\.0")
# Bytes of a chunk's checksum, at its end.
_CHECKSUM = slice(-4, None)
_STORED_BYTES = len(with_checksum(bytes(MARK_BYTES)))


class OtherFrame(DamageError):
    """A frame was decoded otherwise than its store says."""


@dataclass(frozen=True)
class FrameMark:
    """What is known of a frame as a whole."""

    period_px: float | None
    noise_levels: float
    constant_known: bool
    warnings: list[str]
    identity: str  # see `identity_digest`
    chunks: dict[str, str]  # the checksum of each field's chunk, in hexadecimal

    @classmethod
    def of(cls, frame: DecodedFrame, identity: str, chunks: dict[str, bytes]) -> "FrameMark":
        """Return a decoded frame's mark."""
        return cls(
            None if frame.period_px is None else float(frame.period_px),
            float(frame.noise_levels),
            bool(frame.constant_known),
            list(frame.warnings),
            identity,
            {name: chunk[_CHECKSUM].hex() for name, chunk in chunks.items()},
        )

    def encoded(self) -> bytes:
        """Return what is stored: JSON, without the warnings that do not fit, padded with blanks; and its checksum."""
        warnings = list(self.warnings)
        while len(text := json.dumps({**vars(self), "warnings": warnings}).encode()) > MARK_BYTES:
            warnings.pop()
        return with_checksum(text.ljust(MARK_BYTES))


def identity_digest(attributes: dict[str, Any]) -> str:
    """Return a short name of all that a frame's result depends on, except its number."""
    given = {name: value for name, value in attributes.items() if name not in LEARNT}
    return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:16]


def marked_frames(files: StoreFiles) -> set[int]:
    """Return the numbers of a store's frames that have a mark, which is not read.

    Raises
    ------
    OSError
        The store cannot be read.
    """
    keys = (_KEY.fullmatch(name) for name, size in files.sizes(DONE).items() if size == _STORED_BYTES)
    return {int(key[1]) for key in keys if key is not None}


def read_mark(files: StoreFiles, number: int, identity: str) -> FrameMark:
    """Return a frame's mark.

    Raises
    ------
    DamageError
        It is not there, is not as it was written, or is that of a frame that was decoded otherwise.
    """
    try:
        mark = FrameMark(**json.loads(without_checksum(files.read(f"{DONE}/{chunk_key(number, 1)}"))))
    except DamageError as error:
        raise DamageError(f"its mark is damaged: {error}") from None
    except FileNotFoundError:
        raise DamageError("it has no mark, and so is not whole") from None
    except OSError as error:
        raise DamageError(f"its mark cannot be read: {error.strerror or error}") from None
    except (ValueError, TypeError):
        raise DamageError("its mark is of another program, or of a newer version of this one") from None
    if mark.identity != identity:
        raise OtherFrame("it was decoded otherwise than its store says")
    return mark


def read_chunk(files: StoreFiles, number: int, name: str, mark: FrameMark) -> bytes:
    """Return the chunk of a frame's field.

    Raises
    ------
    DamageError
        It is not as it was written, or not there.
    """
    try:
        chunk = files.read(f"{name}/{chunk_key(number, len(FIELDS[name].axes))}")
    except FileNotFoundError:
        raise DamageError(f"{name} is missing") from None
    except OSError as error:
        raise DamageError(f"{name} cannot be read: {error.strerror or error}") from None
    try:
        without_checksum(chunk)
    except DamageError as error:
        raise DamageError(f"{name} is damaged: {error}") from None
    if chunk[_CHECKSUM].hex() != mark.chunks.get(name):
        raise DamageError(f"{name} is another frame's, or of another run")
    return chunk


def frame_fault(files: StoreFiles, number: int, fields: Sequence[str], identity: str) -> str | None:
    """Return what is wrong with a frame that has a mark; None: all of it is as it was written."""
    try:
        mark = read_mark(files, number, identity)
        for name in fields:
            read_chunk(files, number, name, mark)
    except DamageError as error:
        return str(error)
    return None
