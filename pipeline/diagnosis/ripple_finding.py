"""What a diagnosis of ripple finds, and the bounds that all its parts share."""

from dataclasses import dataclass

CHANNELS = "RGB"
#: Tiles at least: fewer have no scatter that tells how sure a cause is.
MIN_TILES = 20
#: A fault must exceed its own standard error by this factor: noise does so once in two million times.
SIGMAS = 5.0
#: Chi square by which one explanation beats another: three standard deviations.
DECISIVE = 9.0


@dataclass(frozen=True)
class RippleFinding:
    """One thing that is wrong, or the smallest set of things that this frame cannot tell apart."""

    causes: tuple[str, ...]
    size: str  # in the fault's own unit
    ripple_rad: dict[int, float]  # by harmonic of the phase: what it does to a balanced, plain arctangent
    confidence: float  # 0..1 that the cause is one of `causes`
    advice: str
