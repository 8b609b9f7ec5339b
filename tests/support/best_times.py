"""Times of calls on a machine that others use, too."""

import time
from collections.abc import Callable

import numpy as np

from tikernels import runtime


def best_ms(bodies: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Return each call's best time, the calls taking turns, so that all see the same machine."""
    best = dict.fromkeys(bodies, np.inf)
    for _ in range(rounds):
        for name, body in bodies.items():
            start = time.perf_counter()
            body()
            runtime.synchronize()
            best[name] = min(best[name], 1e3 * (time.perf_counter() - start))
    return best
