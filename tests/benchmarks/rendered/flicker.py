"""How much the share of absolute pixels flickers with noise and brightness in still scenes, before drawn rigs.

A row is a rig and a scene under the coded pattern: the mean share of the lit pixels that are absolute, by how much it
differs from frame to frame (largest less least), which share of the pixels that any frame calls absolute is not in all,
and the mean with three tenths less light less the mean before.

python tests/benchmarks/rendered/flicker.py --folder FOLDER [--rigs 0-4] [--frames 24]
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from drawn_figures import decode
from drawn_frames import Taken, kept
from drawn_rigs import rig_numbers

from tikernels import runtime

_SCENES = ("light face", "hand", "objects", "parcel")
_DIMMED = 0.7


def shares(taken: Taken, frames: int) -> tuple[list[float], float]:
    """Return the share of the lit pixels that is absolute, frame by frame, and that of pixels that are at times."""
    ever, always, found = np.zeros(taken.lit.shape, bool), np.ones(taken.lit.shape, bool), []
    for seed in range(frames):
        frame = decode(replace(taken, seed=1000 + seed), "coded")
        absolute = frame.mask & frame.absolute & taken.lit
        ever, always = ever | absolute, always & absolute
        found.append(float(absolute.sum() / taken.lit.sum()))
    return found, float((ever & ~always).sum() / max(ever.sum(), 1))


def main() -> None:
    """Print one row a scene, and the medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", default="0-4")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--folder", type=Path, required=True, help="where rendered frames are kept")
    options = parser.parse_args()
    runtime.init("cpu")
    print("| rig | scene | absolute | largest less least | at times | 30 % less light |\n|---|---|---|---|---|---|")
    rows = []
    for seed in rig_numbers(options.rigs):
        for name in _SCENES:
            taken = kept(seed, name, options.folder)
            found, at_times = shares(taken, options.frames)
            dimmed, _ = shares(replace(taken, exposure=_DIMMED * taken.exposure), max(2, options.frames // 4))
            rows.append((np.mean(found), np.ptp(found), at_times, np.mean(dimmed) - np.mean(found)))
            print(f"| {seed} | {name} | " + " | ".join(f"{value:.4f}" for value in rows[-1]) + " |", flush=True)
    print("| median | | " + " | ".join(f"{value:.4f}" for value in np.median(np.abs(rows), axis=0)) + " |")


if __name__ == "__main__":
    main()
