"""Every mechanism that the scorecard can switch off is there, and is really switched off."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import pytest
import scorecard
from scorecard_frames import frames
from scorecard_mechanisms import MECHANISMS, located

# Piles differ from seed to seed, and not all of them need every mechanism.
SEEDS = 5


def test_the_table_names_what_is_there():
    """Patches are for names of the product, and what only a mechanism needs can be counted."""
    for mechanism in MECHANISMS.values():
        for place in mechanism.patches:
            located(place)
        assert mechanism.lines() >= 0
        assert mechanism.shows in frames() or mechanism.promise, (
            f"no frame shows {mechanism.name}, and nothing says why"
        )


@pytest.mark.timeout(5400)  # half a hundred processes, each with kernels of its own
def test_each_mechanism_changes_its_frame(tmp_path):
    """Without it at least one pixel of mask, order, region, phase or sigma is another one."""
    names = sorted({mechanism.shows for mechanism in MECHANISMS.values() if mechanism.shows})
    everything = scorecard.measured(tmp_path, names, SEEDS)
    same = []
    for name, mechanism in MECHANISMS.items():
        if mechanism.shows:
            without = scorecard.measured(tmp_path, [mechanism.shows], SEEDS, without=name)
            if without.mean(mechanism.shows, "digest") == everything.mean(mechanism.shows, "digest"):
                same.append(name)
    assert not same, f"these change nothing: {', '.join(same)}"
