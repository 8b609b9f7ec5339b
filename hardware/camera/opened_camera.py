"""Common parts of all cameras once they are opened and set up: what they report, and how they are closed."""

from collections.abc import Callable
from dataclasses import dataclass
from threading import Thread

from hardware.protocols import CameraLimits, Identity


@dataclass(frozen=True)
class Setup:
    """A camera as it was set up and read back."""

    limits: CameraLimits
    exposure_s: float
    unlocked: tuple[str, ...]
    swapped: bool = False  # blue comes first


class OpenedCamera:
    """A camera whose driver has found out what it is, and has set it up."""

    _identity: Identity
    _setup: Setup

    @property
    def identity(self) -> Identity:
        """Identity found when it was opened."""
        return self._identity

    @property
    def limits(self) -> CameraLimits:
        """Limits as it is set up."""
        return self._setup.limits

    @property
    def exposure_s(self) -> float:
        """The exposure as read back, where it can be."""
        return self._setup.exposure_s

    @property
    def unlocked(self) -> tuple[str, ...]:
        """Settings that it may still change by itself, or that could not be read back, one sentence each."""
        return self._setup.unlocked


def let_go_within(seconds: float, let_go: Callable[[], None]) -> None:
    """Let go of a camera; a library that hangs continues in the background after these seconds."""
    closing = Thread(target=let_go, name="close camera", daemon=True)
    closing.start()
    closing.join(seconds)
