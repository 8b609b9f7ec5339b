"""Decode one frame, NumPy in and NumPy out, beside the same chain out of OpenCV, NumPy and scikit-image.

python tests/benchmarks/bench_decode.py [--arch cpu] [--no-peer]
"""

import argparse
import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from pipeline import Decoder, DecodeSettings
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

SIZES = ((480, 640), (1440, 1920), (2160, 3840))  # height, width


def frame(height: int, width: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return a simulated bust at 12 px a cycle, tiled, so that every size has the same fringes and noise."""
    small = simulate_frame(simulated_rig(), SimulationSettings()).image
    tiles = -(-height // 480), -(-width // 640)
    # Every other tile is mirrored, so that surfaces go on across the seams; left and right keep the fringe whole.
    rows = np.concatenate([small[:, :: 1 - 2 * (i % 2)] for i in range(tiles[1])], axis=1)
    return np.ascontiguousarray(np.concatenate([rows] * tiles[0], axis=0)[:height, :width])


def median_ms(body: Callable[[], object]) -> float:
    """Return the median time of a call over two seconds, the device waited for inside, after two of warming up.

    A virtual machine takes a second to give a program its second core back.
    """
    times: list[float] = []
    begin = time.perf_counter()
    while time.perf_counter() < begin + 4.0:
        start = time.perf_counter()
        body()
        runtime.synchronize()
        if start > begin + 2.0 or not times:
            times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arch", default="cpu")
    parser.add_argument("--no-peer", action="store_true")
    options = parser.parse_args()
    matrix = np.array(TYPICAL_CROSSTALK)
    decoder = Decoder(DecodeSettings(crosstalk_matrix=matrix), arch=options.arch)
    print(f"{decoder.arch}, {runtime.kernel_language()}; NumPy in, unwrapped phase and mask out")
    print(f"{'size':>12} {'ours ms':>9} {'ns/px':>7} {'peer ms':>9} {'ratio':>6}")
    for height, width in SIZES:
        image = frame(height, width)

        def ours(image: Any = image) -> None:
            result = decoder.decode(image)
            _ = result.unwrapped_phase, result.mask

        mine = median_ms(ours)
        line = f"{height:>6}x{width:<5} {mine:9.2f} {1e6 * mine / height / width:7.1f}"
        if not options.no_peer and height < 2000:
            from peer import decode  # beside this file

            theirs = median_ms(lambda image=image: decode(image, matrix, 12.0))
            line += f" {theirs:9.1f} {theirs / mine:6.1f}"
        print(line, flush=True)
    image = frame(480, 640)
    times, memory = [], []
    for _ in range(500):
        start = time.perf_counter()
        decoder.decode(image).unwrapped_phase  # noqa: B018
        times.append(time.perf_counter() - start)
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    print(
        f"frames 3-7 {1e3 * np.median(times[2:7]):.2f} ms, 496-500 {1e3 * np.median(times[-5:]):.2f} ms; "
        f"peak memory after 50 {memory[49]:.0f} MB, after 500 {memory[-1]:.0f} MB"
    )


if __name__ == "__main__":
    main()
