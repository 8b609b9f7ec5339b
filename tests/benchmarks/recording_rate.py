"""What recording costs, and whether live decoding lets it keep its pace.

python tests/benchmarks/recording_rate.py --help

Simulated frames of a bust with the camera's noise, as they come: RGB of 8 bits, and Bayer mosaics of 8 and 12. CPU
times are those of threads or processes, and change little with what else runs; frames a second are by the clock.
"""

import argparse
import os
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from numcodecs import Blosc, blosc

from pipeline.acquisition.live import LiveDecoder
from pipeline.recording.recorder import Recorder
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.raw.pixel_format import PixelFormat

FORMATS = {
    "RGB, 8 bits": PixelFormat("rgb"),
    "Bayer, 8 bits": PixelFormat("bayer", bayer="grbg"),
    "Bayer, 12 bits": PixelFormat("bayer", 12, bayer="grbg"),
}
SHUFFLES = {"plain": Blosc.NOSHUFFLE, "bytes": Blosc.SHUFFLE, "bits": Blosc.BITSHUFFLE}
# Frames that a camera's driver keeps for a program that is late.
CAMERA_BUFFERS = 32
DISTINCT = 8


def simulate(size_px):
    """Return RGB frames of 16 bits that differ by their noise, and the rig."""
    runtime.init("cpu")
    rig = simulated_rig(size_px).model_copy(update={"crosstalk_matrix": SimulationSettings().crosstalk_matrix})
    images = [simulate_frame(rig, SimulationSettings(seed=seed)).image for seed in range(DISTINCT)]
    rng = np.random.default_rng(0)
    # Below the eight bits that are simulated there is noise only.
    return [image.astype(np.uint16) * 256 + rng.integers(0, 256, image.shape, np.uint16) for image in images], rig


def stored(image, format):
    """Return a frame of 16 bits as a camera of this format gives it."""
    levels = (image >> (16 - format.bits)).astype(format.dtype)
    if format.layout == "rgb":
        return levels
    rows, columns = np.indices(levels.shape[:2])
    colors = np.array(["rgb".index(color) for color in format.bayer]).reshape(2, 2)
    return levels[rows, columns, colors[rows % 2, columns % 2]]


def compressors(images):
    """Print what each compressor makes of a frame."""
    blosc.use_threads = False
    print(f"\n{'one thread, ms and size of raw':32}" + "".join(f"{name:>18}" for name in FORMATS))
    for codec, level in (("lz4", 1), ("lz4", 5), ("blosclz", 5), ("zstd", 1)):
        for name, shuffle in SHUFFLES.items():
            compressor, row = Blosc(codec, level, shuffle), f"{codec} {level}, {name}".ljust(32)
            for format in FORMATS.values():
                frame, best = stored(images[0], format), np.inf
                for _ in range(10):
                    begin = time.thread_time()
                    chunk = compressor.encode(frame)
                    best = min(best, time.thread_time() - begin)
                row += f"{1e3 * best:11.2f} {len(chunk) / frame.nbytes:5.0%} "
            print(row)


def disk(folder):
    """Print how fast a disk takes chunks, until they are on it."""
    chunk, n_chunks = os.urandom(700_000), 500
    begin, cpu = time.perf_counter(), time.process_time()
    for number in range(n_chunks):
        (folder / str(number)).write_bytes(chunk)
    taken, cpu = time.perf_counter() - begin, time.process_time() - cpu
    for number in range(n_chunks):
        with (folder / str(number)).open("rb") as file:
            os.fsync(file.fileno())
    whole = time.perf_counter() - begin
    megabytes = n_chunks * len(chunk) / 1e6
    rates = f"{megabytes / taken:.0f} MB/s taken, {megabytes / whole:.0f} MB/s until they are on the disk"
    print(f"\nchunks of 0.7 MB: {rates}, {1e3 * cpu / n_chunks:.2f} ms of CPU time each")


def unpaced(images, folder, n_frames):
    """Print what a frame costs when frames come as fast as they are taken."""
    print(f"\n{'':24}{'frames/s':>10}{'CPU ms':>9}{'caller ms':>11}{'MB/frame':>10}")
    for name, format in FORMATS.items():
        frames, best = [stored(image, format) for image in images], (0.0, np.inf, np.inf)
        for round in range(3):
            path = folder / f"{round}.zarr"
            begin, cpu, caller = time.perf_counter(), time.process_time(), time.thread_time()
            with Recorder(path, format, rate_hz=200) as recorder:
                for k in range(n_frames):
                    recorder.add(frames[k % DISTINCT])
            found = (time.perf_counter() - begin, time.process_time() - cpu, time.thread_time() - caller)
            n = n_frames
            best = (max(best[0], n / found[0]), min(best[1], found[1] / n), min(best[2], found[2] / n))
            shutil.rmtree(path)
        rate, cpu_s, caller_s = best
        megabytes = recorder.n_bytes / n_frames / 1e6
        print(f"{name:24}{rate:10.0f}{1e3 * cpu_s:9.2f}{1e3 * caller_s:11.2f}{megabytes:10.2f}")


def paced(images, rig, size_px, folder, format, rate_hz, seconds, live):
    """Print whether bursts of a second at a camera's pace are recorded without loss."""
    frames = [stored(image, format) for image in images]
    n_frames, latencies, worst, offers = round(rate_hz * seconds), [], 0.0, []
    decoder = None
    if live:
        decoder = LiveDecoder(size_px, calibration=rig, format=format, arch="cpu")
        while not decoder.ready and decoder.ended is None:
            time.sleep(0.01)
    number = -1
    path = folder / "paced.zarr"
    with Recorder(path, format, rate_hz=rate_hz) as recorder:
        recorder.add(frames[0])
        recorder.commit()
        grown = memory_mb()
        begin, cpu = time.monotonic(), time.process_time()
        for k in range(n_frames):
            due = begin + k / rate_hz
            time.sleep(max(0.0, due - time.monotonic()))
            worst = max(worst, time.monotonic() - due)
            if decoder is not None:
                before = time.perf_counter()
                decoder.offer(frames[k % DISTINCT], k, due)
                offers.append(time.perf_counter() - before)
                result = decoder.latest()
                if result is not None and result.number > number:
                    number = result.number
                    latencies.append(result.latency_s)
            recorder.add(frames[k % DISTINCT])
            if k % rate_hz == rate_hz - 1:
                recorder.commit()
        cpu = time.process_time() - cpu
        grown = memory_mb() - grown
    if decoder is not None:
        print(decoder.ended or "", end="")
        decoder.close()
    behind = worst * rate_hz
    verdict = "none dropped" if behind < CAMERA_BUFFERS else "DROPPED"
    print(f"{rate_hz} frames/s, {'with' if live else 'without'} live decoding: {verdict}, ", end="")
    print(f"at most {behind:.1f} behind, {1e3 * cpu / n_frames:.2f} ms of CPU time each, memory {grown:+.0f} MB")
    if latencies:
        low, middle, high = 1e3 * np.percentile(latencies, (5, 50, 95))
        least, most = 1e6 * np.percentile(offers, (50, 99))
        print(
            f"  {len(latencies) / seconds:.1f} decoded/s, {middle:.0f} ms after exposure ({low:.0f} to {high:.0f}); ",
            end="",
        )
        print(f"an offer takes {least:.0f} us, with a frame {most:.0f}")
    shutil.rmtree(path)


def memory_mb():
    """Return this process's memory; 0 where there is no /proc."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except FileNotFoundError:
        return 0.0


def main() -> None:
    """Parse and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--frames", type=int, default=1000, help="a round")
    parser.add_argument("--seconds", type=float, default=20.0, help="of what comes at a camera's pace")
    parser.add_argument("--rate", type=int, default=200, help="frames a second")
    parser.add_argument("--folder", help="on the disk that is meant; left out: the one of temporary files")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    images, rig = simulate((width, height))
    print(f"{width}x{height}, {len(os.sched_getaffinity(0))} cores")
    compressors(images)
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        folder = Path(name)
        (folder / "disk").mkdir()
        disk(folder / "disk")
        unpaced(images, folder, options.frames)
        print()
        for live in (False, True):
            format = FORMATS["RGB, 8 bits"]
            paced(images, rig, (width, height), folder, format, options.rate, options.seconds, live)


if __name__ == "__main__":
    main()
