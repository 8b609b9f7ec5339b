"""How fast footage is decoded, end to end, and what limits it: python tests/benchmarks/throughput.py --help.

Each stage runs alone first: reading, decoding (kernels on all cores), writing (as many threads as in a run). The bound
is the lower of the slowest of them and of what the cores allow: cores over the stages' summed CPU seconds a frame. The
goal is 85 % of it. Rounds alternate between them and the best of each counts, because other programs take the cores.
Two workers of one thread, each bound to a core of its own, are to reach 1.6 times the rate of one.
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

import _tests_path  # noqa: F401 - puts support on the path
from support.recorded_footage import record

from pipeline import DecodeSettings
from pipeline.batch.job import Job
from pipeline.batch.run import decode_footage
from pipeline.batch.worker import _WRITERS
from pipeline.decoding.front_side import RimVotes
from pipeline.footage.source import StoredAs
from pipeline.output.store import chosen_fields
from tikernels import runtime

_STARTING = 8  # frames


def measure(n_frames: int, run: Callable[[], object]) -> tuple[float, float]:
    """Return frames a second, and CPU seconds a frame of all threads."""
    begin, cpu = time.perf_counter(), time.process_time()
    run()
    runtime.synchronize()
    return n_frames / (time.perf_counter() - begin), (time.process_time() - cpu) / n_frames


def stages(job: Job, n_frames: int, rounds: int) -> None:
    """Measure each stage alone, and all together."""
    warm = replace(job, store=f"{job.store}.warm")
    decode_footage(warm, stop=8)  # compiles the kernels, and makes a store
    source, decoder = job.open(), job.decoder()
    store = warm.open_store(source)
    decoder.use_light(None)
    decoder.use_rims(RimVotes())
    read = list(source.frames(0, min(n_frames, 32)))
    image = runtime.empty((*reversed(source.size_px), 3), source.format.rgb_dtype)
    results = [decoder.decode(job.develop(read[0], image)) for _ in range(4)]
    written = [decoder.decode(job.develop(read[k], image)) for k in range(_WRITERS)]

    def decode() -> None:
        for k in range(n_frames):
            previous = results[(k - 1) % 4]
            results[k % 4] = decoder.decode(job.develop(read[k % len(read)], image), previous, results[k % 4])
            results[k % 4].fetch(job.fields)

    def write_some(first: int) -> None:
        frame = written[first]
        frame.fetch(job.fields)
        fetched = dict(vars(frame))
        for k in range(first, n_frames, _WRITERS):
            store.write(k, frame)
            vars(frame).clear()  # so that what the others are made of is computed again, as it is in a run
            vars(frame).update(fetched)

    def write() -> None:
        with ThreadPoolExecutor(_WRITERS) as writers:
            list(writers.map(write_some, range(_WRITERS)))

    def together() -> tuple[float, float]:
        """Begin to measure when all buffers are there: opening takes as long whatever the footage's length."""
        shutil.rmtree(job.store, ignore_errors=True)
        clocks = []
        decode_footage(job, tell=lambda done, of: clocks.append((time.perf_counter(), time.process_time())))
        (begin, cpu_begin), (end, cpu_end) = clocks[_STARTING], clocks[-1]
        n_timed = n_frames - _STARTING
        return n_timed / (end - begin), (cpu_end - cpu_begin) / n_timed

    runs = {
        "reading": lambda: sum(1 for _ in source.frames(0, n_frames)),
        "decoding": decode,
        "writing": write,
    }
    all_found = [
        {**{name: measure(n_frames, run) for name, run in runs.items()}, "together": together()} for _ in range(rounds)
    ]
    found = {
        name: tuple(best(one[name][i] for one in all_found) for i, best in enumerate((max, min)))
        for name in all_found[0]
    }
    whole = found.pop("together")
    cores = len(os.sched_getaffinity(0))
    cpu_s = sum(seconds for _, seconds in found.values())
    bound = min(*(rate for rate, _ in found.values()), cores / cpu_s)
    print(f"\n{source.size_px[0]}x{source.size_px[1]}, {len(job.fields)} fields, {n_frames} frames, {cores} cores")
    print(f"{'':12}{'frames/s':>10}{'CPU ms/frame':>14}")
    for name, (rate, seconds) in {**found, "together": whole}.items():
        print(f"{name:12}{rate:10.1f}{1e3 * seconds:14.1f}")
    print(f"cores allow {cores / cpu_s:.1f} frames/s; together {whole[0] / bound:.0%} of the bound (goal: 85 %),")
    print(f"and {whole[1] / cpu_s:.2f} times the stages' CPU time")
    print(f"a frame takes {_bytes(job.store) / n_frames / 1e6:.2f} MB")


def long_run(job: Job, n_frames: int) -> None:
    """Compare the last frames of a long run with the first ones."""
    times, sizes = {}, {}

    def note(done: int, of: int) -> None:
        times[done] = time.perf_counter()
        sizes[done] = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    decode_footage(job, tell=note)
    first, last = (100 / (times[k + 100] - times[k]) for k in (0, n_frames - 100))
    print(f"\n{n_frames} frames: the first hundred at {first:.1f}, the last at {last:.1f} frames/s")
    print(f"memory after frame 100: {sizes[100]:.0f} MB, at the end {sizes[n_frames]:.0f} (goal: 20 more at most)")


def two_workers(job: Job, n_frames: int) -> None:
    """Compare one and two workers of one thread, each bound to one core."""
    from distributed import Client

    from pipeline.batch.cluster import local_cluster

    os.environ["TI_CPU_MAX_NUM_THREADS"] = "1"
    rates = {}
    for n_workers in (1, 2):
        with local_cluster(n_workers) as cluster, Client(cluster) as client:
            cores = sorted(os.sched_getaffinity(0))
            for k, address in enumerate(client.scheduler_info()["workers"]):
                client.run(_bind, cores[k % len(cores)], workers=[address])
            store = f"{job.store}.{n_workers}"
            decode_footage(replace(job, store=f"{store}.warm"), stop=128 * n_workers, cluster=cluster.scheduler_address)
            begin = time.perf_counter()
            decode_footage(replace(job, store=store), stop=n_frames, cluster=cluster.scheduler_address)
            rates[n_workers] = n_frames / (time.perf_counter() - begin)
    print(f"one worker {rates[1]:.1f}, two {rates[2]:.1f} frames/s: {rates[2] / rates[1]:.2f} times (goal: 1.6)")


def _bind(core: int) -> None:
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), {core})


def _bytes(folder: str) -> int:
    return sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())


def main() -> None:
    """Parse and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100, help="a round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--sizes", nargs="*", default=["640x480", "1920x1080"])
    parser.add_argument("--fields", nargs="*", help="left out: all")
    parser.add_argument("--arch", default="cpu")
    parser.add_argument("--workers", action="store_true", help="compare one and two workers instead")
    parser.add_argument("--long", action="store_true", help="compare the end of a long run with its beginning instead")
    options = parser.parse_args()
    for size in options.sizes:
        width, height = map(int, size.split("x"))
        with tempfile.TemporaryDirectory() as folder:
            film = Path(folder) / "film.mkv"
            rig = record(film, options.frames, (width, height))
            fields = chosen_fields(options.fields, in_mm=True)
            says = StoredAs()
            job = Job(str(film), says, DecodeSettings(), rig, None, 1, 0, fields, f"{folder}/result.zarr", options.arch)
            if options.workers:
                two_workers(job, options.frames)
            elif options.long:
                long_run(job, options.frames)
            else:
                stages(job, options.frames, options.rounds)


if __name__ == "__main__":
    main()
