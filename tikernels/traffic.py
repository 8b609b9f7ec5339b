"""Count a device's work: calls, copies each way, and the host's waits.

On the CPU buffers are NumPy arrays, which nobody copies, and only calls are counted. On a GPU every NumPy array that is
passed to a kernel is copied there, and the host waits until what the kernel writes to one has come back.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np


@dataclass
class Traffic:
    """Counts since `clear` was called."""

    calls: int = 0
    """Of kernels."""
    copied_calls: int = 0
    """Those with NumPy arrays on a GPU: what they write to one is waited for."""
    reads: int = 0
    """Buffers that were read, each after a wait."""
    sent_bytes: int = 0
    """To the device; what kernels write to NumPy arrays goes there, too."""
    read_bytes: int = 0
    """From the device, by reads."""
    on_device: bool = False
    """True if buffers are on a GPU."""

    def clear(self) -> None:
        """Begin to count anew."""
        self.calls = self.copied_calls = self.reads = self.sent_bytes = self.read_bytes = 0

    def count_call(self, arguments: Iterable[object]) -> None:
        """Count the call of a kernel."""
        self.calls += 1
        if self.on_device:
            copied = [argument.nbytes for argument in arguments if isinstance(argument, np.ndarray)]
            self.copied_calls += bool(copied)
            self.sent_bytes += sum(copied)


#: Of the device that runs.
traffic = Traffic()
