"""How fast footage is decoded, end to end, and what limits it: python tests/benchmarks/throughput.py --help.

Each stage runs alone first, in one thread: reading, decoding, writing. What the cores allow is their number over the
stages' summed CPU seconds a frame; the goal is 85 % of it. Rounds alternate between the stages, and the best of each
counts, because other programs take the cores. Then all run together, in a process for each core.
"""

import argparse
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

# One kernel thread, as in each of the processes; read when a device starts.
os.environ.setdefault("TI_CPU_MAX_NUM_THREADS", "1")

import _tests_path  # noqa: F401 - puts support on the path
from support.recorded_footage import record

from pipeline import DecodeSettings
from pipeline.batch.executors import usable_cores
from pipeline.batch.job import Job
from pipeline.batch.run import decode_job
from pipeline.batch.worker import _WRITERS
from pipeline.decoding.frame import read_back
from pipeline.decoding.rig_state import RigState
from pipeline.footage.footage import StoredAs
from pipeline.output.store import chosen_fields
from tikernels import runtime

_ALONE = 100  # frames that each stage is measured with


def measure(n_frames: int, run: Callable[[], object]) -> float:
    """Return CPU seconds a frame, of all threads."""
    begin = time.process_time()
    run()
    runtime.synchronize()
    return (time.process_time() - begin) / n_frames


def stages(job: Job, n_frames: int, rounds: int) -> None:
    """Measure each stage alone, and all together."""
    warm = replace(job, store=f"{job.store}.warm")
    decode_job(warm, stop=8)  # compiles the kernels, and makes a store
    source, decoder = job.open(), job.decoder()
    store = warm.pinned(source).open_store(source)
    decoder.state = RigState(asks=frozenset({"code"}))
    read = list(source.frames(0, min(n_frames, 32)))
    image = runtime.empty((*reversed(source.size_px), 3), source.format.rgb_dtype)
    results = [decoder.decode(job.develop(read[0], image)) for _ in range(4)]
    written = [decoder.decode(job.develop(read[k], image)) for k in range(_WRITERS)]

    def decode() -> None:
        for k in range(n_frames):
            previous = results[(k - 1) % 4]
            results[k % 4] = decoder.decode(job.develop(read[k % len(read)], image), previous, results[k % 4])
            read_back(results[k % 4], job.fields)

    def write_some(first: int) -> None:
        frame = written[first]
        read_back(frame, job.fields)
        fetched = dict(vars(frame))
        for k in range(first, n_frames, _WRITERS):
            store.commit([store.write(k, frame)])
            vars(frame).clear()  # so that what the others are made of is computed again, as it is in a run
            vars(frame).update(fetched)

    def write() -> None:
        with ThreadPoolExecutor(_WRITERS) as writers:
            list(writers.map(write_some, range(_WRITERS)))

    runs = {"reading": lambda: sum(1 for _ in source.frames(0, n_frames)), "decoding": decode, "writing": write}
    all_found = [{name: measure(n_frames, run) for name, run in runs.items()} for _ in range(rounds)]
    found = {name: min(one[name] for one in all_found) for name in runs}
    cores = len(usable_cores())
    allowed = cores / sum(found.values())
    print(f"\n{source.size_px[0]}x{source.size_px[1]}, {len(job.fields)} fields, {cores} cores; CPU ms a frame:")
    print(", ".join(f"{name} {1e3 * seconds:.1f}" for name, seconds in found.items()), end="")
    print(f"; the cores allow {allowed:.1f} frames/s")
    rate = together(job)
    print(f"together {rate:.1f} frames/s, {rate / allowed:.0%} of that (goal: 85 %)")
    print(f"a frame takes {_bytes(job.store) / len(source) / 1e6:.2f} MB")


def together(job: Job) -> float:
    """Return frames a second of a run, between its first and its last fifth: starting takes as long for any length."""
    shutil.rmtree(job.store, ignore_errors=True)
    clocks: list[float] = []
    decode_job(job, notify=lambda done, of: clocks.append(time.perf_counter()))
    first, last = len(clocks) // 5, 4 * len(clocks) // 5
    return (last - first) / (clocks[last] - clocks[first])


def long_run(job: Job, n_frames: int) -> None:
    """Compare the last frames of a long run with the first ones."""
    times, sizes = {}, {}

    def note(done: int, of: int) -> None:
        times[done] = time.perf_counter()
        sizes[done] = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    decode_job(job, notify=note)
    first, last = (100 / (times[k + 100] - times[k]) for k in (0, n_frames - 100))
    print(f"\n{n_frames} frames: the first hundred at {first:.1f}, the last at {last:.1f} frames/s")
    print(f"memory after frame 100: {sizes[100]:.0f} MB, at the end {sizes[n_frames]:.0f} (goal: 20 more at most)")


def _bytes(folder: str) -> int:
    return sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())


def main() -> None:
    """Parse and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=768, help="of the footage")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--sizes", nargs="*", default=["640x480", "1920x1080"])
    parser.add_argument("--fields", nargs="*", help="left out: all")
    parser.add_argument("--arch", default="cpu")
    parser.add_argument("--long", action="store_true", help="compare the end of a long run with its beginning instead")
    options = parser.parse_args()
    runtime.init(options.arch)
    for size in options.sizes:
        width, height = map(int, size.split("x"))
        with tempfile.TemporaryDirectory() as folder:
            film = Path(folder) / "film.zarr"
            rig = record(film, options.frames, (width, height))
            fields = chosen_fields(options.fields, in_mm=True)
            says = StoredAs()
            job = Job(str(film), says, DecodeSettings(), rig, None, 1, 0, fields, f"{folder}/result.zarr", options.arch)
            if options.long:
                long_run(job, options.frames)
            else:
                stages(job, _ALONE, options.rounds)


if __name__ == "__main__":
    main()
