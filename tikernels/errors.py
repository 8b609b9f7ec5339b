"""The base class of all errors, and what can go wrong in the kernels."""

import logging

# Loggers are silent until a program configures them; every module that logs imports this one, if not directly.
logging.getLogger("colorphase").addHandler(logging.NullHandler())


class Error(Exception):
    """Base class of every error of colorphase; its message is one line that says what to do.

    Examples
    --------
    >>> try:
    ...     colorphase.DecodeSettings(smoothing_px=4)
    ... except colorphase.Error as error:
    ...     print(error)
    smoothing_px: must be 0 or odd, got 4
    """


class DeviceNotReady(Error, RuntimeError):
    """The device asked for is missing, or none has been started.

    Examples
    --------
    >>> colorphase.init("cpu", cpu_threads=0)
    Traceback (most recent call last):
        ...
    tikernels.errors.DeviceNotReady: cpu_threads is 0: give a number from 1 to 1024
    """


class ShapeError(Error, ValueError):
    """An array has the wrong shape, dtype, or cannot be written.

    Examples
    --------
    >>> colorphase.Decoder(arch="cpu").decode(np.zeros((480, 640), np.uint8))
    Traceback (most recent call last):
        ...
    tikernels.errors.ShapeError: image is grey (640x480): the phase is in the colours, pass (H, W, 3) RGB
    """


class SlowStart(UserWarning):
    """Kernels are compiled at each start, which could be avoided."""
