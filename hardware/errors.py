"""What can go wrong at the rig; each message is one line that says what to do."""


class TriggerError(ConnectionError):
    """The trigger source cannot be reached, is another one, or refuses."""


class CameraError(ConnectionError):
    """The camera cannot be reached, or refuses."""


class ProjectorError(ConnectionError):
    """The projector, or the display that it is, cannot be reached, or refuses."""


class BurstError(ConnectionError):
    """A burst could not be captured whole; the message names the pulse and the likely cable."""


class RigError(ValueError):
    """What the rig is asked for is impossible: its file is wrong, or its times contradict each other."""
