"""Measure everything that this project says of speed, on the device that it finds, and print a dated table.

python tests/benchmarks/bench_decode.py [--arch auto] [--only frames hostile start footage]

frames   one frame, NumPy in and NumPy out: plain, and with calibration, code and the frame before; plain ones beside
         the same chain out of OpenCV, NumPy and scikit-image (`peer.py`)
hostile  frames that no surface makes, beside a plane of the same size
start    fresh processes: version, first frame, a picture with all its files, footage; kernels on the disk and not
footage  a recording of three fields to Zarr

Bodies take turns, and the best time of each counts: other programs take the cores. CPU times are of all threads.
"""

import argparse
import datetime
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _tests_path  # noqa: F401 - puts support on the path
import numpy as np
import numpy.typing as npt
from support.recorded_footage import record

from pipeline import Decoder, DecodeSettings
from pipeline.batch.executors import usable_cores
from pipeline.batch.job import Job
from pipeline.batch.run import decode_job
from pipeline.footage.footage import StoredAs
from pipeline.output.range_image import write_png
from pipeline.simulation import DEFAULT_PERIOD_PX, TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.traffic import traffic

Image = npt.NDArray[np.uint8]
SIZES = ((640, 480), (1920, 1440), (3840, 2160))
_ROUNDS, _PERIOD_PX, _FOOTAGE_FRAMES = 12, 12, 768
# Fringes of this part of the usual period: 4.6 px.
_FINE, _FINE_NAME = 0.38, "fringes of 4.6 px"
_FIRST_FRAME = """
import sys
import numpy as np
from pipeline import Decoder, DecodeSettings
from pipeline.simulation import TYPICAL_CROSSTALK
settings = DecodeSettings(crosstalk_matrix=np.array(TYPICAL_CROSSTALK))
Decoder(settings, arch=sys.argv[1]).decode(np.load(sys.argv[2])).mask
"""
_COMMAND = "from pipeline.cli.start import main; main()"


@dataclass(frozen=True)
class Times:
    """Of one body, ms."""

    best: float
    median: float
    cpu: float  # the median


def in_turns(bodies: dict[str, Callable[[], object]], rounds: int = _ROUNDS) -> dict[str, Times]:
    """Measure bodies in turns, each waited for, after two rounds of warming up."""
    clock, cpu = ({name: [] for name in bodies} for _ in range(2))  # type: ignore[var-annotated]
    for _ in range(rounds + 2):
        for name, body in bodies.items():
            start, cpu_start = time.perf_counter(), time.process_time()
            body()
            runtime.synchronize()
            clock[name].append(1e3 * (time.perf_counter() - start))
            cpu[name].append(1e3 * (time.process_time() - cpu_start))
    return {
        name: Times(min(clock[name][2:]), float(np.median(clock[name][2:])), float(np.median(cpu[name][2:])))
        for name in bodies
    }


def tiled(width: int, height: int) -> Image:
    """Return a simulated bust, tiled, so that every size has the same fringes and noise."""
    small = simulate_frame(simulated_rig(), SimulationSettings()).image
    tiles = -(-height // 480), -(-width // 640)
    # Every other tile is mirrored, so that surfaces go on across the seams; left and right keep the fringe whole.
    rows = np.concatenate([small[:, :: 1 - 2 * (i % 2)] for i in range(tiles[1])], axis=1)
    return np.ascontiguousarray(np.concatenate([rows] * tiles[0], axis=0)[:height, :width])


def frames(arch: str) -> None:
    """Measure one frame by size."""
    from peer import decode  # beside this file; scikit-image is needed here alone

    matrix, asked = np.array(TYPICAL_CROSSTALK), []
    print("\n| picture | plain: best; median; CPU, ms | peer, best | times as fast", end="")
    print(" | all known: best; median; CPU, ms | of plain |")
    print("|---|---|---|---|---|---|")
    for width, height in SIZES:
        image, plain = tiled(width, height), Decoder(DecodeSettings(crosstalk_matrix=matrix), arch=arch)
        rig = simulated_rig((width, height), code="contrast")
        coded = simulate_frame(rig, SimulationSettings()).image
        known = Decoder(DecodeSettings(crosstalk_matrix=matrix), rig, arch=arch)
        before = known.decode(coded)
        bodies: dict[str, Callable[[], object]] = {
            "plain": lambda decoder=plain, image=image: _results(decoder.decode(image)),  # type: ignore[misc]
            "known": lambda decoder=known, image=coded, before=before: _results(decoder.decode(image, before)),  # type: ignore[misc]
        }
        if height < 2000:
            bodies["peer"] = lambda image=image: decode(image, matrix, float(_PERIOD_PX))  # type: ignore[misc]
        found = in_turns(bodies, _ROUNDS if width < 1000 else 4)
        ours, all_known, peer = found["plain"], found["known"], found.get("peer")
        beside = "- | -" if peer is None else f"{peer.best:.0f} | {peer.best / ours.best:.1f}"
        print(
            f"| {width}x{height} | {ours.best:.1f}; {ours.median:.1f}; {ours.cpu:.1f} | {beside} "
            f"| {all_known.best:.1f}; {all_known.median:.1f}; {all_known.cpu:.1f} | {all_known.best / ours.best:.2f} |",
            flush=True,
        )
        traffic.clear()
        _results(plain.decode(image))
        asked.append(
            f"| {width}x{height} | {traffic.calls} | {traffic.copied_calls + traffic.reads} "
            f"| {traffic.sent_bytes / 1e6:.2f} | {traffic.read_bytes / 1e6:.2f} |"
        )
    print("\n| picture, plain | calls of kernels | waits | MB sent | MB read |\n|---|---|---|---|---|")
    print("\n".join(asked))


def _results(frame: Any) -> object:
    return frame.unwrapped_phase, frame.mask


def hostile_frames(plane: Image, moved: Callable[[int], Image]) -> Iterator[tuple[str, Image]]:
    """Yield frames that are hard to decode, given a plane and the same moved by rows."""
    rng = np.random.default_rng(0)
    yield "noise", rng.integers(0, 256, plane.shape).astype(np.uint8)
    yield "plane and noise of 15 levels", np.clip(plane + rng.normal(0, 15, plane.shape), 0, 255).astype(np.uint8)
    for name, cell, move in (
        ("squares of 40 px, whole cycles apart", 40, lambda: _PERIOD_PX * int(rng.integers(-5, 6))),
        ("squares of 40 px, anything apart", 40, lambda: int(rng.integers(-60, 60))),
        ("squares of 16 px, anything apart", 16, lambda: int(rng.integers(-60, 60))),
        ("squares of 8 px, anything apart", 8, lambda: int(rng.integers(-60, 60))),
    ):
        image = plane.copy()
        for top in range(0, plane.shape[0], cell):
            for left in range(0, plane.shape[1], cell):
                square = np.s_[top : top + cell, left : left + cell]
                image[square] = moved(move())[square]
        yield name, image


def hostile(arch: str) -> None:
    """Measure frames that no surface makes, 640x480."""
    print("\n| frame | plain, best ms | of the plane | coded, best ms | of the plane |\n|---|---|---|---|---|")
    columns = []
    for code in (None, "contrast"):
        rig = simulated_rig(code=code)
        plane = simulate_frame(rig, SimulationSettings(scene="plane")).image
        images = {"plane": plane}
        images.update(hostile_frames(plane, lambda rows, plane=plane: np.roll(plane, rows, axis=0)))  # type: ignore[misc]
        if code is None:
            fine = simulate_frame(simulated_rig(period_px=_FINE * DEFAULT_PERIOD_PX), SimulationSettings(scene="plane"))
            images[_FINE_NAME] = fine.image
        bodies = {}
        for name, image in images.items():
            decoder = Decoder(DecodeSettings(crosstalk_matrix=TYPICAL_CROSSTALK), rig, arch=arch)
            if name == _FINE_NAME:
                decoder = Decoder(DecodeSettings(crosstalk_matrix=TYPICAL_CROSSTALK), arch=arch)
            bodies[name] = lambda decoder=decoder, image=image: decoder.decode(image).mask
        columns.append(in_turns(bodies, 4))  # type: ignore[arg-type]
    for name in columns[0]:
        cells = [
            f"{column[name].best:.0f} | {column[name].best / column['plane'].best:.1f}" if name in column else "- | -"
            for column in columns
        ]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def start(arch: str) -> None:
    """Measure fresh processes, by the CPU time of all their threads: the first of each has no kernels on the disk."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        np.save(folder / "image.npy", tiled(640, 480))
        write_png(folder / "frame.png", tiled(640, 480))
        record(folder / "film.zarr", 1, (640, 480))
        decode = (_COMMAND, "decode", "--force", "--arch", arch, "--out")
        # A worker's kernels have one thread.
        bodies = {
            "`colorphase --version`": ((_COMMAND, "--version"), {}),
            "first frame": ((_FIRST_FRAME, arch, folder / "image.npy"), {}),
            "`colorphase decode picture.png`": ((*decode, folder / "picture", folder / "frame.png"), {}),
            "footage of one frame, one kernel thread": (
                (*decode, folder / "film", folder / "film.zarr", "--workers", "1"),
                {"TI_CPU_MAX_NUM_THREADS": "1", "QD_CPU_MAX_NUM_THREADS": "1"},
            ),
        }
        found: dict[str, list[float]] = {what: [] for what in bodies}
        for _ in range(5):
            for number, (what, ((program, *words), environment)) in enumerate(bodies.items()):
                shutil.rmtree(folder / "film", ignore_errors=True)
                cache = {
                    f"{language}_OFFLINE_CACHE_FILE_PATH": f"{folder}/kernels{number}" for language in ("TI", "QD")
                }
                paths = {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
                before = os.times()
                subprocess.run(
                    [sys.executable, "-c", program, *map(str, words)],
                    env={**os.environ, **cache, **paths, **environment},
                    stdout=subprocess.DEVNULL,
                    check=True,
                )
                after = os.times()
                found[what].append(sum(after[2:4]) - sum(before[2:4]))
    print("\n| fresh process, 640x480 | CPU s, without kernels on the disk | with, the least |\n|---|---|---|")
    for what, times in found.items():
        print(f"| {what} | {times[0]:.2f} | {min(times[1:]):.2f} |")


def footage(arch: str) -> None:
    """Measure a recording, between its first and its last fifth: starting takes as long whatever its length."""
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.zarr"
        rig = record(film, _FOOTAGE_FRAMES, (640, 480))
        fields, store = ("mask", "range_image", "phase_sigma"), f"{folder}/result.zarr"
        job = Job(str(film), StoredAs(), DecodeSettings(), rig, None, 1, 0, fields, store, arch)
        for workers in (None, 1):
            shutil.rmtree(store, ignore_errors=True)
            clocks: list[float] = []
            decode_job(job, workers=workers, notify=lambda done, of: clocks.append(time.perf_counter()))  # noqa: B023
            first, last = len(clocks) // 5, 4 * len(clocks) // 5
            rate = (last - first) / (clocks[last] - clocks[first])
            where = "a process for each core" if workers is None else "one process"
            print(f"\nFootage to Zarr, 640x480, three fields, {where}: {rate:.1f} frames/s.", flush=True)


def device(arch: str) -> str:
    """Return what computes, as the machine calls it."""
    name = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    told = f"{name}, {len(usable_cores())} cores"
    if arch == "cuda":
        query = ["nvidia-smi", "--query-gpu=name,power.limit,clocks.max.sm,clocks.max.mem", "--format=csv,noheader"]
        told = f"{subprocess.run(query, capture_output=True, text=True, check=True).stdout.strip()}; {told}"
    elif arch == "vulkan":
        told = f"{', '.join(found.name for found in runtime.vulkan_devices())}; {told}"
    return f"{arch}, {told}; {runtime.kernel_language()}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arch", default="auto")
    parts = {"frames": frames, "hostile": hostile, "start": start, "footage": footage}
    parser.add_argument("--only", nargs="*", choices=parts, default=list(parts))
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    arch = runtime.init(options.arch)
    print(f"{datetime.datetime.now(datetime.UTC).date()}: {device(arch)}")
    for name in options.only:
        parts[name](arch)


if __name__ == "__main__":
    main()
