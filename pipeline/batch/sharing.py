"""In how many processes footage is decoded the soonest, and when more of them do not help."""

import os
from collections.abc import Sequence

from pipeline.batch.job import CHAIN_FRAMES, Job
from pipeline.batch.worker import Chain
from tikernels import runtime

# A process starts in the time that it takes to decode about as many frames.
_FRAMES_A_START = 128


def usable_cores() -> list[int]:
    """Return the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def worthwhile_processes(job: Job, todo: Sequence[Chain]) -> int:
    """Return in how many processes frames are decoded the soonest."""
    if _on_gpu(job):
        return 1  # one GPU does all the work
    n_frames = sum(len(missing) for _, missing in todo)
    return max(1, min(len(usable_cores()), len(todo), n_frames // _FRAMES_A_START))


def idle_processes(job: Job, todo: Sequence[Chain], count: int) -> str | None:
    """Say that so many processes are more than help, and how many do; None: each of them helps.

    Parameters
    ----------
    job : Job
        What is decoded.
    todo : sequence of (range, frozenset)
        The chains of frames that are to be decoded.
    count : int
        How many processes are asked for.
    """
    n_cores = len(usable_cores())
    if count > 1 and _on_gpu(job):
        return f"note: --workers {count}: one GPU does all the work, and --workers 1 is as fast"
    if count <= min(n_cores, len(todo)):
        return None
    if len(todo) < n_cores:
        chains = "one chain" if len(todo) == 1 else f"{len(todo)} chains"
        why = f"frames lean on the one before in chains of {CHAIN_FRAMES}, and what is left to decode is {chains}"
    else:
        why = "this machine has one core" if n_cores == 1 else f"this machine has {n_cores} cores for it"
    return f"note: --workers {count}: {why}: --workers {min(n_cores, len(todo))} is as fast"


def _on_gpu(job: Job) -> bool:
    return job.arch != "cpu" and (job.arch != "auto" or runtime.init("auto") != "cpu")
