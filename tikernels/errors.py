"""The base class of all errors, and what can go wrong in the kernels."""

import logging

# Loggers are silent until a program configures them; every module that logs imports this one, if not directly.
logging.getLogger("colorphase").addHandler(logging.NullHandler())


class Error(Exception):
    """Base class of every error of colorphase; its message is one line that says what to do."""


class DeviceNotReady(Error, RuntimeError):
    """The device asked for is missing, or none has been started."""


class ShapeError(Error, ValueError):
    """An array has the wrong shape, dtype, or cannot be written."""


class SlowStart(UserWarning):
    """Kernels are compiled at each start, which could be avoided."""
