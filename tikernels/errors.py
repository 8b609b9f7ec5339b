"""What can go wrong in the kernels."""


class DeviceNotReady(RuntimeError):
    """The device asked for is missing, or none has been started."""


class ShapeError(ValueError):
    """An array has the wrong shape, dtype, or cannot be written."""


class SlowStart(UserWarning):
    """Kernels are compiled at each start, which could be avoided."""
