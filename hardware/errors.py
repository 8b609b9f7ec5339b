"""Errors of the rig; each message is one line that says what to do."""

from tikernels.errors import Error


class TriggerError(Error, ConnectionError):
    """The trigger source cannot be reached, is another one, or refuses."""


class CameraError(Error, ConnectionError):
    """The camera cannot be reached, or refuses."""


class ProjectorError(Error, ConnectionError):
    """The projector, or the display that it is, cannot be reached, or refuses."""


class BurstError(Error, ConnectionError):
    """A burst could not be captured whole; the message names the pulse and the likely cable."""


class RigError(Error, ValueError):
    """The rig cannot do what is requested: its file is wrong, or its times contradict each other.

    Examples
    --------
    >>> timing = dict(period_s=0.02, frames=4, camera_delay_s=0.001)
    >>> parts = dict(trigger=dict(driver="simulated"), camera=dict(driver="simulated", exposure_s=-0.008))
    >>> colorphase.RigSettings(timing=timing, **parts)
    Traceback (most recent call last):
        ...
    hardware.errors.RigError: camera.exposure_s: must be a number above 0 and at most 3600, got -0.008
    """
