from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Any

import numpy as np
import pytest
from support.faulty_rigs import FRAMES, Bench, Faulty, settings

from hardware import rig as rig_module
from hardware.rig import Rejected, Rig


def random_fault(random: np.random.Generator) -> Faulty:
    """Return up to three faults, more often none."""
    kinds = [
        name for name in Faulty.__dataclass_fields__ if name not in ("restart", "unplugged_trigger", "unplugged_camera")
    ]
    found: dict[str, object] = {}
    for _ in range(random.choice([0, 1, 2, 3], p=[0.6, 0.2, 0.1, 0.1])):
        if random.random() < 0.1:
            found[str(random.choice(["restart", "unplugged_trigger", "unplugged_camera"]))] = int(
                random.integers(FRAMES)
            )
        else:
            found[str(random.choice(kinds))] = frozenset(random.integers(0, 4, random.integers(1, 3)).tolist())
    return Faulty(**found)


def suffer(seed: int, strobe: bool, n_bursts: int) -> tuple[int, int, int]:
    """Return how many frames were mispaired, how many good runs were thrown away, and how many all in all."""
    random = np.random.default_rng(seed)
    fates: list[Faulty] = []  # of the runs of this try
    n_failed = n_faults = lost = wrong = 0

    class Plan(list[Faulty]):
        def __bool__(self) -> bool:
            return True

        def pop(self, _: Any = 0) -> Faulty:
            # The third try of a burst is left alone: that three in a row fail is another test's matter.
            fates.append(random_fault(random) if n_failed < 2 else Faulty())
            return fates[-1]

    def notify(rejected: Rejected) -> None:
        nonlocal n_failed, lost
        n_failed += 1
        lost += all(fate.harmless for fate in fates)
        fates.clear()

    bench = Bench(settings(strobe=strobe, frames=4), Plan())
    with Rig(bench.settings, bench.open, notify) as rig:
        for burst in islice(rig.bursts(), n_bursts):
            wrong += len(bench.mispaired(burst))
            n_faults += n_failed
            n_failed = 0
            fates.clear()
    return wrong, lost, n_faults


@pytest.mark.parametrize(
    "strobe, n_bursts",
    [
        (True, 120),
        (False, 40),
        (True, 1000),
        (False, 200),
    ],
)
def test_random_faults_neither_mispair_nor_cost_a_good_burst(strobe, n_bursts, monkeypatch):
    """Every burst that is kept is right, every run without a fault is kept."""
    monkeypatch.setattr(rig_module, "_TRANSPORT_S", 0.5)
    n_rigs = 4  # at a time: they do little but wait
    with ThreadPoolExecutor(n_rigs) as pool:
        tolls = pool.map(suffer, range(n_rigs), n_rigs * [strobe], n_rigs * [n_bursts // n_rigs])
        wrong, lost, n_faults = np.sum(list(tolls), axis=0)
    assert (wrong, lost) == (0, 0)
    assert n_faults > n_bursts / 4
