"""What can go wrong between an image and a mesh; each message is one line that says what to do."""

from typing import Self


class Cause(str):
    """A message that names a cause that was looked for, with a key by which programs and tests know the cause."""

    __slots__ = ("key",)
    key: str

    def __new__(cls, key: str, words: str) -> Self:
        """Return the words, with the key."""
        made = super().__new__(cls, words)
        made.key = key
        return made

    def __reduce__(self) -> tuple[type["Cause"], tuple[str, str]]:
        """Keep the key: frames' warnings travel between processes."""
        return Cause, (self.key, str(self))


class SettingsError(ValueError):
    """A setting is unknown, out of range, or contradicts another."""


class CalibrationError(ValueError):
    """A calibration is incomplete, inconsistent, or of another image size."""


class FootageError(OSError):
    """An image or a video cannot be read, or holds no values that can be decoded."""


class OutputError(OSError):
    """A result cannot be written where it was asked for."""


class DamageError(OSError):
    """What is stored is not as it was written."""


class RenderError(RuntimeError):
    """The machine cannot draw: a graphics library is missing or broken."""


class ClusterError(ConnectionError):
    """A cluster cannot be reached, or its workers fail."""


class DecodeWarning(UserWarning):
    """A frame decoded, but not as its user will have hoped."""
