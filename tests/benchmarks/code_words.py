"""Find which words of fifteen cells the cycles of "contrast2" have, and print how far windows of it are apart.

By simulated annealing on the sum over all pairs of windows at the same cells of exp(-distance / T), those within six
cycles of each other counted four times. With no steps: the distances of the words that the program has.

python tests/benchmarks/code_words.py [--steps 20000] [--seed 1]
"""

import argparse

import _tests_path  # noqa: F401
import numpy as np
import numpy.typing as npt
from support.code_windows import apart, lowest_distances, words_of_distance_five

from pipeline.contrast_code import CYCLES, ContrastCode

# Cycles by cells: what is made distant, and what is printed.
_SHAPES = ((1, 8), (2, 4), (2, 8), (4, 4), (3, 3), (6, 2), (8, 2), (9, 1), (12, 1))
_SHOWN = ((1, 15), (1, 8), (2, 8), (4, 4), (8, 2), (9, 1), (12, 1))
# T, and the annealing's first and last temperature.
_SCALE, _HOT, _COLD = 0.3, 0.5, 0.005
_NEAR, _NEAR_COUNTS = 6, 4.0
# Of fifteen cells: the two words without change look like a gain.
_FEWEST_ONES, _MOST_ONES = 5, 10


def cost(symbols: npt.NDArray[np.int64], changed: list[int]) -> float:
    """Return what all windows that hold one of these cycles cost."""
    total = 0.0
    for shape in _SHAPES:
        first = np.arange(len(symbols) - shape[0] + 1)
        holds = np.any([(first <= cycle) & (cycle < first + shape[0]) for cycle in changed], axis=0)
        starts = np.flatnonzero(holds)
        gap = np.abs(starts[:, None] - first)
        counts = np.where(gap > _NEAR, 1.0, _NEAR_COUNTS) * np.where(holds, 0.5, 1.0) * (gap > 0)
        total += float((counts * np.exp(-apart(symbols, shape, starts) / _SCALE)).sum()) / symbols.shape[1]
    return total


def anneal(steps: int, seed: int) -> npt.NDArray[np.int64]:
    """Return the symbols, (CYCLES, 15)."""
    rng = np.random.default_rng(seed)
    words = words_of_distance_five()
    ones = words.sum(axis=1)
    words = rng.permutation(words[(ones >= _FEWEST_ONES) & (ones <= _MOST_ONES)])
    for temperature in np.geomspace(_HOT, _COLD, steps):
        one, other = int(rng.integers(CYCLES)), int(rng.integers(len(words)))
        changed = [cycle for cycle in (one, other) if cycle < CYCLES]
        before = cost(words[:CYCLES], changed)
        words[[one, other]] = words[[other, one]]
        if rng.random() >= np.exp(min(0.0, (before - cost(words[:CYCLES], changed)) / temperature)):
            words[[one, other]] = words[[other, one]]
    return words[:CYCLES]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    symbols = (ContrastCode.named("contrast2", 2.0).contrasts == 1).astype(np.int64)
    if options.steps:
        symbols = anneal(options.steps, options.seed)
        print("".join(f"{word:04x}" for word in symbols @ (1 << np.arange(symbols.shape[1]))))
    print(f"{'cycles x cells':>16}" + "".join(f"{'{}x{}'.format(*shape):>12}" for shape in _SHOWN))
    for count in (CYCLES, 44):
        found = (lowest_distances(symbols[:count], shape) for shape in _SHOWN)
        print(f"{count:>9} cycles" + "".join(f"{least:6.2f}/{low:5.2f}" for least, low in found))


if __name__ == "__main__":
    main()
