"""Mean times at which a camera sees the colours that a projector shows one after another.

An exposure of whole colour cycles sees every colour equally long wherever it starts, but not at the same mean time. A
colour is on for the part w of a cycle, and the exposure starts x cycles after the middle of that, -1/2 < x < 1/2. Then
the colour's mean time is

    x (1 / w - 1)          for |x| < w / 2, where the exposure's start and end share it,
    sign(x) / 2 - x        elsewhere

cycles after the middle of the exposure, however many cycles that has. With a rolling shutter x grows from row to row;
with a camera that runs freely it is another one in every frame, and only its advance is known, roughly.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

# Possible starts of the exposure in a cycle: the mean times of two neighbours differ by 1/32 cycle at most.
_STARTS = 64
# From one frame to the next the start strays from its nominal advance by this standard deviation, in times from frame
# to frame: video at 29.97 instead of 30 Hz moves it by a tenth of that, and a dozen frames are averaged.
_STRAYS = 0.01
# Probability that a frame has been dropped, or the film cut, so that nothing holds any more.
_CUT = 0.001
# Probability from which an order counts as shown; and the part of a cycle that the rows must run through, for where all
# see the same colour first, both orders fit nearly as well.
_CLEAR, _RUN = 0.99, 1 / 3
# Red, green and blue in their two orders, a third of a cycle each, as starts in thirds.
_ORDERS = ((0, 1, 2), (0, 2, 1))


@dataclass(frozen=True, eq=False)
class ColorFields:
    """Times at which a projector's colours are on and exposures may start; each pair of both is a hypothesis.

    Hypotheses are numbered order by order, and in an order by the exposure's start.
    """

    cycle: float
    """Length of a colour cycle, in times from frame to frame."""
    row: float = 0.0
    """From one row's exposure to the next one's, in cycles; 0: all rows at once."""
    shown: Floats | None = None
    """(3, 2) cycles, when red, green and blue go on and off; None: a third of a cycle each, in either order."""
    start: float | None = None
    """Start of every frame's exposure, in cycles; None: it is found in the frames."""

    @cached_property
    def _hypotheses(self) -> tuple[Floats, Floats]:
        """Times that colours are on, (orders, 3, 2) cycles, and starts of the exposure, (starts,) cycles."""
        thirds = np.array(_ORDERS)[..., None] / 3 + np.array([0, 1 / 3])
        shown = thirds if self.shown is None else np.asarray(self.shown, np.float64)[None]
        return shown, np.arange(_STARTS) / _STARTS if self.start is None else np.array([self.start])

    def times(self, rows: int) -> Floats:
        """Return (hypotheses, rows, 3) when colours are seen, after the middle of a row's exposure, frame to frame."""
        shown, starts = self._hypotheses
        exposed = starts[:, None] + self.row * np.arange(rows)
        share = np.diff(shown)[:, None, None, :, 0]
        after = (exposed[..., None] - shown.mean(axis=-1)[:, None, None] + 0.5) % 1 - 0.5
        split = after * (1 / share - 1)
        seen = np.where(np.abs(after) < share / 2, split, np.sign(after) / 2 - after)
        return np.asarray(self.cycle * seen.reshape(-1, rows, 3))

    def expect(self, before: Floats | None) -> Floats:
        """Return each hypothesis's probability, given those of the frame before; None: nothing is known."""
        shown, starts = self._hypotheses
        even = np.full(len(shown) * len(starts), 1 / (len(shown) * len(starts)))
        if before is None or self.start is not None:
            return even
        waves = np.fft.rfftfreq(len(starts), 1 / len(starts))
        moved = np.exp(-2j * np.pi * waves / self.cycle - 2 * (np.pi * waves * _STRAYS / self.cycle) ** 2)
        spectrum = np.fft.rfft(before.reshape(len(shown), -1)) * moved
        expected = np.maximum(np.fft.irfft(spectrum, len(starts)), 0).ravel()
        return np.asarray(_CUT * even + (1 - _CUT) * expected / expected.sum())

    def found_order(self, shares: Floats, rows: int) -> str | None:
        """Return "RGB" or "RBG" where the order is not stated, and probabilities, by so many rows, make it clear."""
        orders = shares.reshape(len(self._hypotheses[0]), -1).sum(axis=1)
        clear = self.shown is None and self.row * rows > _RUN and orders.max() > _CLEAR
        return ("RGB", "RBG")[int(orders.argmax())] if clear else None
