"""Frames, settings and calibrations that nobody means: refused in one line, or decoded to something sane."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.hostile_frames import decode_hostile

pytestmark = pytest.mark.usefixtures("cpu")


@settings(derandomize=True, database=None, deadline=None, max_examples=150)
@given(seed=st.integers(0, 2**32 - 1))
def test_whatever_decodes_is_sane(seed):
    decode_hostile(np.random.default_rng(seed))
