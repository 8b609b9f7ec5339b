"""Small footage whose frames decode, and runs of the command on it that are killed."""

import hashlib
import os
import random
import subprocess
import time
from pathlib import Path

import numpy as np
from support.command_line import command

from pipeline.batch.job import Job
from pipeline.calibration import Calibration
from pipeline.footage.footage import StoredAs
from pipeline.output.store import chosen_fields
from pipeline.recording.recorder import Recorder
from pipeline.settings import DecodeSettings
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels.raw.pixel_format import PixelFormat

#: Frames of footage that is worth more than one process.
N_FRAMES = 200

# Frames that are simulated; the rest of the footage are these, moved.
_DISTINCT = 6


def record(path: Path, n_frames: int, size_px: tuple[int, int] = (128, 96)) -> Calibration:
    """Record frames of a bust that moves, each unlike all others; return the rig's calibration."""
    rig = simulated_rig(size_px, period_px=2 * 768 / 44)
    images = [simulate_frame(rig, SimulationSettings(seed=i)).image for i in range(min(n_frames, _DISTINCT))]
    with Recorder(path, PixelFormat("rgb")) as recorder:
        for number in range(n_frames):
            recorder.add(np.roll(images[number % _DISTINCT], number // _DISTINCT, axis=1))
    return rig.model_copy(update={"crosstalk_matrix": SimulationSettings().crosstalk_matrix})


def job_of(folder: Path, store: Path) -> Job:
    """Return a job that decodes a folder's ``film.zarr``, without a calibration."""
    fields = chosen_fields(("mask", "unwrapped_phase", "phase_sigma"), in_mm=False)
    film = str(folder / "film.zarr")
    return Job(film, StoredAs(), DecodeSettings(), None, None, 1, 0, fields, str(store), "cpu")


def contents(folder: Path) -> dict[str, str]:
    """Return every file of a folder, with a hash of what is in it."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def run_and_kill(arguments: list[str], marks: Path, n_more: int, delay_s: float) -> bool:
    """Run a command and kill it a moment after `n_more` more marks are there; return whether it was still running."""
    with subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        target = _count(marks) + n_more
        while process.poll() is None and _count(marks) < target:
            time.sleep(0.001)
        time.sleep(delay_s)
        killed = process.poll() is None
        process.kill()
        process.wait()
    return killed


def kill_again_and_again(footage: Path, out: Path, kills: int, seed: int, *options: str) -> int:
    """Decode footage, killed at random moments; return how often it was still running.

    Raises
    ------
    AssertionError
        A frame that had a mark was written again.
    """
    rng = random.Random(seed)
    arguments = command("decode", footage, "--out", out, "--arch", "cpu", *options)
    marks, killed = out / "result.zarr" / "done", 0
    before: dict[str, int] = {}
    for _ in range(kills):
        # Sometimes while the store is being made, mostly while frames are written.
        killed += run_and_kill(arguments, marks, rng.choice((-1, 0, 1, 2, 3, 4, 5)), rng.uniform(0, 0.1))
        now = _times(marks)
        again = {name: (at, now.get(name)) for name, at in before.items() if now.get(name) != at}
        assert not again, f"frames that were done have been written again (ns, mark: before, now): {again}"
        before = now
    return killed


def _count(marks: Path) -> int:
    """Return how many marks there are; -1 where there is no store yet."""
    try:
        return sum(name.startswith("c.") for name in os.listdir(marks))
    except FileNotFoundError:
        return -1


def _times(marks: Path) -> dict[str, int]:
    names = os.listdir(marks) if marks.exists() else []
    whole = (name for name in names if name.startswith("c."))
    return {name: (marks / name).stat().st_mtime_ns for name in whole}
