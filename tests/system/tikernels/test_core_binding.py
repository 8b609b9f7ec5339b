"""Kernels' threads and the cores that they run on."""

import os
import subprocess
import sys

import pytest

from tikernels import runtime

PROGRAM = """
import contextlib
import os
import numpy as np
import tikernels
from tikernels.transposing import transpose

def bound_threads():
    found = {}
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(OSError), open(f"/proc/self/task/{thread}/status") as status:  # some have just ended
            if len(cores := os.sched_getaffinity(int(thread))) == 1:
                woken = next(int(line.split()[1]) for line in status if line.startswith("voluntary"))
                found[int(thread)] = cores, woken
    return found

tikernels.init("cpu")
image = np.zeros((300, 300, 3), np.uint8)
transpose(image)
before = bound_threads()
for _ in range(200):
    transpose(image)
after = bound_threads()
# They are those that kernels wake, and no other ones of the language.
assert all(after[thread][1] > woken for thread, (_, woken) in before.items()), (before, after)
print(sorted(core for cores, _ in after.values() for core in cores))
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="threads cannot be bound to cores here")
@pytest.mark.parametrize("threads", [1, 2])
def test_kernels_threads_have_a_core_each(threads):
    cores = sorted(os.sched_getaffinity(0))[:2]
    if len(cores) < 2:
        pytest.skip("one core alone")
    settings = dict.fromkeys(runtime.THREAD_VARIABLES, str(threads))
    program = f"import os; os.sched_setaffinity(0, {cores})\n" + PROGRAM
    run = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | settings,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    # One thread alone is left to the scheduler.
    assert run.stdout.strip() == str(cores if threads == 2 else [])
