"""Errors between an image and a mesh; each message is one line that states what to do."""

from tikernels.errors import Error


class SettingsError(Error, ValueError):
    """A setting is unknown, out of range, or contradicts another.

    Examples
    --------
    >>> colorphase.DecodeSettings(smoothing_px=4)
    Traceback (most recent call last):
        ...
    pipeline.errors.SettingsError: smoothing_px: must be 0 or odd, got 4
    """


class CalibrationError(Error, ValueError):
    """A calibration is incomplete, inconsistent, or of another image size.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120))
    >>> colorphase.Decoder(calibration=rig, arch="cpu").decode(np.zeros((480, 640, 3), np.uint8))
    Traceback (most recent call last):
        ...
    pipeline.errors.CalibrationError: frame is 640x480 but the calibration is for 160x120...
    """


class FootageError(Error, OSError):
    """An image or a video cannot be read, or holds no values that can be decoded.

    Examples
    --------
    >>> colorphase.open_footage("none.mkv")
    Traceback (most recent call last):
        ...
    pipeline.errors.FootageError: cannot read none.mkv: there is no such file
    """


class OutputError(Error, OSError):
    """A result cannot be written to its destination.

    Examples
    --------
    >>> colorphase.simulated_rig().write("none/rig.json")
    Traceback (most recent call last):
        ...
    pipeline.errors.OutputError: cannot write none/rig.json: its folder does not exist: create the folder first
    """


class DamageError(Error, OSError):
    """Stored data is not as it was written."""


class RenderError(Error, RuntimeError):
    """The machine cannot draw: a graphics library is missing or broken."""


class ClusterError(Error, ConnectionError):
    """A cluster cannot be reached, or its workers fail."""


class DecodeWarning(UserWarning):
    """A frame decoded, but not as its user will have hoped."""
