"""Which small surfaces are placed by themselves: plates, bars and balls before a wall, by size in cycles and cells.

    python tests/benchmarks/small_surfaces.py [--frames 12] [--code contrast contrast2] [--gamma 1 2]

A surface counts as right where more than half of its lit pixels are absolute and right, and as wrong where more than a
tenth are absolute and wrong. The oracle averages over the pixels' area (`tests/support/piled_objects.py`).
"""

import argparse
import warnings
from collections import defaultdict

import _tests_path  # noqa: F401 - puts support on the path
import numpy as np
from support.piled_objects import SIZE, Surface, photographed, ray_through, wall

from pipeline import Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, simulated_rig
from tikernels import runtime

# Camera px a cycle, and a cell of half of one; and what they are in mm on the simulated rig.
_CYCLE_PX, _CELL_PX = 12.0, 6.0
# Kinds: how many cycles high and cells wide, least and most.
KINDS = {
    "1.5 to 3 cycles": ((1.5, 3.0), (8.0, 14.0)),
    "2 x 8": ((2.0, 2.0), (8.0, 8.0)),
    "4 x 4": ((4.0, 4.0), (4.0, 4.0)),
    "3 to 4.5 cycles": ((3.0, 4.5), (6.0, 12.0)),
    "4.5 to 6 cycles": ((4.5, 6.0), (6.0, 12.0)),
    "5 x 8": ((5.0, 5.0), (8.0, 8.0)),
    "6 to 9 cycles": ((6.0, 9.0), (6.0, 12.0)),
    "bars along, 5 to 12 mm": ((1.4, 3.4), (40.0, 60.0)),
    "bars across, 5 px": ((12.0, 16.0), (0.83, 0.83)),
    "bars across, 10 px": ((12.0, 16.0), (1.7, 1.7)),
}


def scene(kind: str, rng: np.random.Generator, rig: object) -> list[Surface]:
    """Return a wall and five surfaces of a kind, none behind another."""
    (low, high), (narrow, wide) = KINDS[kind]
    surfaces = [wall(rng)]
    columns = rng.permutation(5)
    for k in range(5):
        half_height = rng.uniform(low, high) * _CYCLE_PX / 2
        half_width = rng.uniform(narrow, wide) * _CELL_PX / 2
        x, y = (60 + 125 * columns[k], rng.uniform(110, SIZE[1] - 110))
        if half_width > 60:  # one above the other
            x, y = SIZE[0] / 2 + rng.uniform(-80, 80), 70 + 85 * columns[k]
        normal = np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), 1.0])
        ray, depth = ray_through(rig, x, y), rng.uniform(800, 910)
        ellipse = bool(rng.random() < 0.3) and half_width < 60 and narrow > 3
        surfaces.append(Surface(SKIN, normal, float(depth * ray @ normal), (ellipse, x, y, half_width, half_height)))
    return surfaces


def main() -> None:
    """Print one row a kind."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--code", nargs="*", default=["contrast", "contrast2"])
    parser.add_argument("--gamma", nargs="*", type=float, default=[1.0, 2.0])
    parser.add_argument("--kind", nargs="*", default=list(KINDS))
    chosen = parser.parse_args()
    runtime.init("cpu")
    warnings.simplefilter("ignore", DecodeWarning)
    print("| kind | " + " | ".join(f"{code}, gamma {gamma:g}" for code in chosen.code for gamma in chosen.gamma) + " |")
    print("|---|" + "---|" * (len(chosen.code) * len(chosen.gamma)))
    for kind in chosen.kind:
        row = [figures(kind, code, gamma, chosen.frames) for code in chosen.code for gamma in chosen.gamma]
        print(f"| {kind} | " + " | ".join(row) + " |", flush=True)


def figures(kind: str, code: str, gamma: float, frames: int) -> str:
    """Return the shares of surfaces that are right, and wrong; and of all pixels that are wrong."""
    rig = simulated_rig(SIZE, code=code)
    calibration = rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    decoder, counts = Decoder(DecodeSettings(), calibration), defaultdict(float)
    for seed in range(frames):
        rng = np.random.default_rng(seed)
        truth, which = photographed(rng, rig, scene(kind, rng, rig), gamma)
        frame = decoder.decode(truth.image)
        lit = truth.mask & (truth.image.mean(axis=2) > 20)
        known = frame.absolute & lit
        wrong = known & (np.abs(np.nan_to_num(frame.unwrapped_phase) - truth.phase) > np.pi)
        for number in range(1, 6):
            own = lit & (which == number)
            if own.sum() < 60:
                continue
            counts["surfaces"] += 1
            counts["right"] += (known & ~wrong & own).sum() > 0.5 * own.sum()
            counts["wrong"] += (wrong & own).sum() > 0.1 * own.sum()
        counts["wrong px"] += wrong.sum() / max(known.sum(), 1) / frames
    number = counts["surfaces"]
    return f"{counts['right'] / number:.2f} ({counts['wrong'] / number:.2f}; {counts['wrong px']:.5f})"


if __name__ == "__main__":
    main()
