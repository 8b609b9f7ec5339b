"""How many frames a second are done, counted from when they were: not from before, and not all at once."""

import time
from collections import deque
from collections.abc import Callable

# Frames are reported some at a time, twice a second by each process that decodes: what comes within this time was
# done since the report before.
_TOGETHER_S = 0.2
# A rate over less is none.
_LEAST_S = 1.0
# What was done before says nothing of now: frames of one film take longer than others.
_LONGEST_S = 30.0


class FrameRate:
    """The rate at which a count grows, over the last half minute.

    The first frames that are reported only begin it: they took what the start took, or were done before.

    Parameters
    ----------
    clock : callable, optional
        Returns the time, s; left out, `time.monotonic`.
    """

    def __init__(self, clock: Callable[[], float] | None = None) -> None:
        self._clock = clock or time.monotonic
        self._reports: deque[tuple[float, int]] = deque()  # the time of each, and how many were done then

    def note(self, done: int) -> None:
        """Note how many are done now."""
        now_s = self._clock()
        if self._reports and now_s - self._reports[-1][0] < _TOGETHER_S:
            self._reports[-1] = self._reports[-1][0], done
            return
        self._reports.append((now_s, done))
        while self._reports[-1][0] - self._reports[0][0] > _LONGEST_S and len(self._reports) > 2:
            self._reports.popleft()

    def per_s(self) -> float | None:
        """Return how many a second; None: it is not known yet."""
        if not self._reports:
            return None
        (first_s, before), (last_s, done) = self._reports[0], self._reports[-1]
        return (done - before) / (last_s - first_s) if last_s - first_s >= _LEAST_S else None
