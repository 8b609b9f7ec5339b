"""Check that each projector pulse showed the next picture: two pictures alternate, one of them dimmer.

A projector that misses a pulse keeps showing the old picture, and only the frame shows it. So the rig has it show the
same pattern bright and dim, alternating: the whole frame's brightness then steps at every pulse, wherever the object is
and however it moves, and dividing by brightness, as decoding does, leaves the phase as it is. Steps are ratios (their
logarithms): an object that comes nearer between two bursts makes both pictures brighter.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from hardware.pairing import Fault
from hardware.protocols import CameraFrame, Levels

#: Brightness of the dimmer picture relative to the other, by default: a step eight times the least that is visible, for
#: little of the light.
DIM = 0.85
# A step counts as one from this fraction of the usual step on: a moving object's own changes are a few per cent of the
# light within a period, and a lost pulse leaves no step at all.
_LEAST_STEP = 0.5
# Below this ratio's logarithm a step could be the flicker of lamps.
_LEAST_VISIBLE = 0.02
# Levels: a black frame has no logarithm.
_DARKEST = 1e-3
# How fast the usual step follows the scene.
_MEMORY = 0.9


class Alternation:
    """Follow the two pictures from burst to burst."""

    def __init__(self) -> None:
        self._step = 0.0  # how much brighter the bright picture is, the ratio's logarithm
        self._last: int | None = None  # the picture that the last frame showed: 0 the bright one; None: not known

    @property
    def known(self) -> bool:
        """True if the picture that the projector shows now is known."""
        return self._last is not None

    def forget(self) -> None:
        """Pulses were made that no frame shows."""
        self._last = None

    def start(self, frames: Sequence[CameraFrame]) -> list[Fault]:
        """Learn from some frames how the pictures differ, and which is shown; return what speaks against it."""
        steps = _steps(frames)
        self._step = float(np.abs(steps).max())
        if self._step < _LEAST_VISIBLE:
            reason = (
                "the frames show no two pictures in turns: check the projector's trigger cable, and that one of its "
                f"pictures is dimmer (colorphase pattern --brightness {DIM})"
            )
            return [Fault("no alternating pictures", reason)]
        return self._follow(steps, None, 0)

    def check(self, frames: Sequence[CameraFrame], first_pulse: int) -> list[Fault]:
        """Return where frames do not show the pictures alternating, beginning with the one that is due."""
        return self._follow(_steps(frames), None if self._last is None else 1 - self._last, first_pulse)

    def _follow(self, steps: npt.NDArray[np.float64], due: int | None, first_pulse: int) -> list[Fault]:
        self._last = None
        shown = None  # the picture of the frame before
        for i, step in enumerate(steps):
            if abs(step) < _LEAST_STEP * self._step:
                return [_lost(first_pulse + i + 1)]
            now = 0 if step > 0 else 1
            if shown is None and due is not None and 1 - now != due:
                return [_lost(first_pulse)]
            if shown is not None and now == shown:
                reason = "the brightness jumps twice the same way: keep the light even"
                return [Fault("light changed", reason, first_pulse + i + 1)]
            shown = now
        if shown is not None:
            self._step = _MEMORY * self._step + (1 - _MEMORY) * float(np.median(np.abs(steps)))
            self._last = shown
        return []


def _steps(frames: Sequence[CameraFrame]) -> npt.NDArray[np.float64]:
    """Return how much brighter each frame is than the one before, the ratios' logarithms."""
    levels = [mean_level(frame.image) for frame in frames if frame.image is not None]
    return np.diff(np.log(np.maximum(levels, _DARKEST)))


def _lost(pulse: int) -> Fault:
    return Fault("picture missing", "its frame shows the picture before: check the projector's trigger cable", pulse)


def mean_level(image: Levels) -> float:
    """Return a frame's mean level: that of every eighth 2x2 pixels both ways, which a mosaic repeats."""
    samples = [image[y::8, x::8] for y in range(2) for x in range(2)]
    return float(np.mean([sample.mean() for sample in samples]))
