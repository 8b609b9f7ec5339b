"""What a recording in Matroska says of itself (`docs/footage.md`)."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from pipeline.errors import FootageError
from pipeline.footage.source import StoredAs
from tikernels.errors import ShapeError
from tikernels.raw.linearization import TRANSFERS

_PREFIX = "COLORPHASE_"
#: Of the format of recordings, in Matroska and in Zarr.
VERSION = "1"
# Matroska counts in ms: above this, two frames could share one.
MOST_FRAMES_A_SECOND = 500


def rate_of(text: str) -> Fraction:
    """Return frames a second, from how a recording writes them.

    Raises
    ------
    ValueError
        It is no fraction.
    """
    # Of 1e999999999 Fraction would make a number of that many digits; cameras' rates have ten.
    if re.fullmatch(r"[0-9]{1,20}(/0{0,20}[1-9][0-9]{0,20})?", text) is None:
        raise ValueError(f"rate {text[:40]!r} is no fraction")
    return Fraction(text)


@dataclass(frozen=True)
class RecordingTags:
    """Tags of the file, all of them texts that begin with COLORPHASE_.

    Raises
    ------
    ShapeError
        The rate or the transfer is none that a recording can have.
    """

    rate_hz: Fraction  # frames a second
    transfer: str | None
    bayer: str | None  # None: RGB
    bits: int

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= MOST_FRAMES_A_SECOND:
            raise ShapeError(f"rate_hz is {self.rate_hz}: give one above 0 and up to {MOST_FRAMES_A_SECOND}")
        if self.transfer not in (None, *TRANSFERS):
            raise ShapeError(f"transfer is {self.transfer!r}: choose {', '.join(TRANSFERS)}")

    @classmethod
    def read(cls, metadata: Mapping[str, str]) -> "RecordingTags | None":
        """Return the tags of a recording, or None if it is another video.

        Raises
        ------
        FootageError
            It is of a later version, or a tag is wrong.
        """
        tags = {key.upper(): value for key, value in metadata.items()}
        version = tags.get(f"{_PREFIX}RECORDING")
        if version is None:
            return None
        if version != VERSION:
            raise FootageError(f"it is a recording of version {version}, this program reads {VERSION}: update it")
        try:
            rate_hz, bits = rate_of(tags[f"{_PREFIX}RATE"]), tags[f"{_PREFIX}BITS"]
            if not re.fullmatch("[0-9]{1,2}", bits):
                raise ValueError(f"bits {bits[:40]!r} is no number of bits")
            return cls(rate_hz, tags.get(f"{_PREFIX}TRANSFER"), tags.get(f"{_PREFIX}BAYER"), int(bits))
        except (KeyError, ValueError) as error:
            raise FootageError(f"its tags are not those of a recording ({error}): remux it with all its tags") from None

    def write(self) -> dict[str, str]:
        """Return the tags to write."""
        values = {"RECORDING": VERSION, "RATE": self.rate_hz, "TRANSFER": self.transfer, "BAYER": self.bayer}
        return {
            _PREFIX + name: str(value) for name, value in {**values, "BITS": self.bits}.items() if value is not None
        }

    def stamp(self, number: int) -> int:
        """Return a frame's time stamp, ms, which is Matroska's unit."""
        return round(number * 1000 / self.rate_hz)

    def n_frames(self, duration_us: int) -> int:
        """Return how many frames a recording of a certain length holds."""
        return round(duration_us * self.rate_hz / 1_000_000)

    def completing(self, says: StoredAs) -> StoredAs:
        """Return what the user says, and these tags where the user says nothing."""
        known: dict[str, Any] = {"bayer": self.bayer, "bits": self.bits}
        return replace(says, **{name: value for name, value in known.items() if getattr(says, name) is None})
