"""The study of `order_error_probability`: uncertain regions, counted by the probability that they were given.

Small pieces of simulated surfaces, some in half-shadow, with texture and printed stripes, under coded light that is
dim, noisy, blurred, ambient, or not what the decoder was told. A region's order is wrong where most of its pixels are.

python tests/benchmarks/order_probability.py [--frames 200] [--seed 1] [--depth-range] [--code contrast2]
python tests/benchmarks/order_probability.py --rigs 0-19 --folder FOLDER   # scenes before drawn rigs, coded both ways
"""

import argparse
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import _tests_path  # noqa: F401 - puts support on the path
import numpy as np
import numpy.typing as npt
from support.uncertain_frames import judged_regions, uncertain_frame

from tikernels import runtime

BINS = (0.0, 1e-3, 1e-2, 0.03, 0.1, 0.3, 0.6, 0.9, 1.0)


def main() -> None:
    """Print expected and observed numbers of wrong regions by bins of probability."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arch", default="cpu")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--depth-range", action="store_true", help="tell the decoder where the surfaces are")
    parser.add_argument("--code", choices=("contrast", "contrast2", "none"), default="contrast", help="the pattern's")
    parser.add_argument("--rigs", metavar="N-M", help="judge drawn rigs of these numbers instead")
    parser.add_argument("--folder", type=Path, help="where their rendered frames are kept")
    options = parser.parse_args()
    runtime.init(options.arch)
    if options.rigs:
        print_table(np.array(list(drawn_regions(options.rigs, options.folder))))
        return
    code = None if options.code == "none" else options.code
    seeds = range(options.seed, options.seed + options.frames)
    rows = [row for seed in seeds for row in judged_regions(*uncertain_frame(seed, code, options.depth_range))]
    print_table(np.array(rows))


def drawn_regions(rigs: str, folder: Path) -> Iterator[tuple[float, float]]:
    """Yield the regions of all opaque scenes before these rigs."""
    sys.path.append(str(Path(__file__).with_name("rendered")))
    from drawn_figures import OPAQUE, decode
    from drawn_frames import kept
    from drawn_rigs import rig_numbers
    from ray_caster import NOTHING

    for seed in rig_numbers(rigs):
        for name in OPAQUE:
            taken = kept(seed, name, folder)
            phase = np.where(taken.truth.body != NOTHING, taken.phase, np.nan)
            for pattern in ("coded", "compensated coded"):
                yield from judged_regions(decode(taken, pattern), phase)


def print_table(regions: npt.NDArray[np.float64]) -> None:
    """Print a table of regions, each its probability of being wrong and whether it is."""
    print("| probability | regions | expected wrong | observed wrong | ratio |\n|---|---|---|---|---|")
    for low, high in pairwise(BINS):
        inside = regions[(regions[:, 0] >= low) & ((regions[:, 0] < high) | (high == 1.0))]
        expected, observed = inside[:, 0].sum(), inside[:, 1].sum()
        ratio = f"{observed / expected:.2f}" if expected >= 20 else ""
        print(f"| {low:g} .. {high:g} | {len(inside)} | {expected:.1f} | {observed:.0f} | {ratio} |")


if __name__ == "__main__":
    main()
