"""Linear algebra in one thread.

A second thread of NumPy's BLAS spins while it waits: equations of a hundred unknowns then take up to a thousand times
as long, most of all on a busy machine.
"""

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _libraries() -> ThreadpoolController:
    # To find them takes as long as 200 calls of their limits.
    return ThreadpoolController().select(user_api="blas")


def one_thread() -> AbstractContextManager[object]:
    """Give the BLAS libraries of NumPy and OpenCV one thread in the body."""
    limited: AbstractContextManager[object] = _libraries().limit(limits=1)
    return limited
