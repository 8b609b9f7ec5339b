"""Unwrap one phase map, NumPy in and NumPy out, by colorphase and by scikit-image's unwrap_phase.

python tests/benchmarks/bench_unwrapping.py [--arch cpu]
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from bench_decode import tiled
from skimage.restoration import unwrap_phase

import tikernels
from pipeline import Decoder, DecodeSettings
from pipeline.simulation import TYPICAL_CROSSTALK
from tikernels import runtime

SIZES = ((480, 640), (1440, 1920))  # height, width


def best_ms(bodies: dict[str, Callable[[], object]], rounds: int = 12) -> dict[str, float]:
    """Return each call's best time, the calls taking turns, so that all see the same machine."""
    best = dict.fromkeys(bodies, np.inf)
    for _ in range(rounds):
        for name, body in bodies.items():
            start = time.perf_counter()
            body()
            runtime.synchronize()
            best[name] = min(best[name], 1e3 * (time.perf_counter() - start))
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arch", default="cpu")
    options = parser.parse_args()
    settings = DecodeSettings(crosstalk_matrix=np.array(TYPICAL_CROSSTALK))
    decoder = Decoder(settings, arch=options.arch)
    print(f"{decoder.arch}, {runtime.kernel_language()}; best of twelve, ms, and times faster than scikit-image")
    print(f"{'size':>11} {'colorphase':>18} {'scikit-image':>14} {'orders differ':>14}")
    for height, width in SIZES:
        decoded = decoder.decode(tiled(width, height))
        mask, quality = decoded.mask, decoded.modulation
        phase = np.nan_to_num(decoded.wrapped_phase)
        masked = np.ma.masked_array(phase, ~mask)
        out = np.empty_like(phase)
        bodies: dict[str, Callable[[], object]] = {
            "colorphase": partial(tikernels.unwrap_phase, phase, quality, mask, out=out),
            "scikit-image": partial(unwrap_phase, masked),
        }
        times = best_ms(bodies)
        # One constant is free: the commonest difference is it.
        cycles = np.rint((out - unwrap_phase(masked).filled(np.nan)) / (2 * np.pi))[~np.isnan(out) & mask].astype(int)
        differ = 1.0 - np.unique(cycles, return_counts=True)[1].max() / cycles.size
        ours, peer = times["colorphase"], times["scikit-image"]
        print(f"{width:>5}x{height:<5} {ours:11.2f} {peer / ours:5.1f}x {peer:14.1f} {differ:14.1e}", flush=True)


if __name__ == "__main__":
    main()
