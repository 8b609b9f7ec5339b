"""Damaged files of every kind: read as they are, refused in one line, or in part, and never a traceback.

`python tests/benchmarks/fuzz.py` goes through as many cases as one likes, with bounds of time and memory.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.damage import damaged
from support.file_samples import OTHERWISE, SAMPLES, damage_sample, make_samples, outcome

pytestmark = pytest.mark.usefixtures("cpu")


@pytest.fixture(scope="module")
def samples(cpu, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("samples")
    make_samples(folder)
    return folder


@pytest.mark.parametrize("sample", SAMPLES.values(), ids=SAMPLES)
def test_damage_is_told_in_one_line(samples, tmp_path_factory, sample):
    """Where a format has checksums, what is not refused is what was written."""
    whole = sample.read(samples / sample.name)
    assert whole.parts

    @settings(derandomize=True, database=None, deadline=None, max_examples=60)
    @given(seed=st.integers(0, 2**32 - 1))
    def check(seed):
        path = tmp_path_factory.mktemp("damaged") / sample.name
        intent = damage_sample(sample, samples / sample.name, path, np.random.default_rng(seed))
        became = outcome(sample, path, whole)
        assert intent or not sample.checked or became != OTHERWISE

    check()


def test_the_same_seed_gives_the_same_damage():
    data = bytes(range(256)) * 4
    first, again = (damaged(data, np.random.default_rng(3)) for _ in range(2))
    assert first == again != data
