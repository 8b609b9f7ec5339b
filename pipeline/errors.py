"""What can go wrong between an image and a mesh; each message is one line that says what to do."""

from tikernels.errors import Error


class SettingsError(Error, ValueError):
    """A setting is unknown, out of range, or contradicts another."""


class CalibrationError(Error, ValueError):
    """A calibration is incomplete, inconsistent, or of another image size."""


class FootageError(Error, OSError):
    """An image or a video cannot be read, or holds no values that can be decoded."""


class OutputError(Error, OSError):
    """A result cannot be written where it was asked for."""


class DamageError(Error, OSError):
    """What is stored is not as it was written."""


class RenderError(Error, RuntimeError):
    """The machine cannot draw: a graphics library is missing or broken."""


class ClusterError(Error, ConnectionError):
    """A cluster cannot be reached, or its workers fail."""


class DecodeWarning(UserWarning):
    """A frame decoded, but not as its user will have hoped."""
