"""One table of fields: the tables of the docs are those of the code."""

import numpy as np
import pytest
from support.field_tables import TABLES

from pipeline.decoding.fields import (
    MODULATION_DIGITS,
    RELATIVE_RANGE_DIGITS,
    SIGMA_DIGITS,
    WRAPPED_PHASE_DIGITS,
    field,
    fields_of,
)
from pipeline.decoding.frame import FIELDS


class Frame:
    """A frame with one field, which counts how often it is computed."""

    def __init__(self):
        self.computed = 0

    @field("float32", "rad", needs=("height",), axes=(), vertex="h")
    def height(self):
        """How high.

        More about it.
        """
        self.computed += 1
        return np.float32(2)


def test_a_new_field_is_one_method():
    ((name, entry),) = fields_of(Frame).items()
    assert (name, entry.dtype, entry.unit, entry.axes, entry.vertex) == ("height", "float32", "rad", (), "h")
    assert entry.meaning == "How high."
    assert entry.__doc__.startswith("one value float32: How high.")


def test_a_field_is_computed_once():
    frame = Frame()
    assert (frame.height, frame.height, frame.computed) == (2, 2, 1)
    assert Frame().computed == 0


@pytest.mark.parametrize("path, table", TABLES.items(), ids=lambda value: getattr(value, "name", ""))
def test_the_docs_say_what_the_code_says(path, table):
    assert table() in path.read_text(encoding="utf-8"), "run python tests/support/field_tables.py"


def test_every_field_says_what_it_is():
    for name, entry in FIELDS.items():
        assert entry.meaning.endswith("."), name
        assert entry.needs, name
        assert (entry.unit is None) == (entry.dtype != "float32"), name


def test_rounding_stays_below_what_it_claims():
    rng = np.random.default_rng(1)
    phase = rng.uniform(-np.pi, np.pi, 10_000).astype(np.float32)
    rounded = WRAPPED_PHASE_DIGITS.apply(phase, 3.0, False)
    assert np.abs(rounded - phase).max() <= 2.0**-15 + 2.0**-14 * (np.abs(phase) > np.pi - 2.0**-14).any()
    assert np.abs(rounded).max() <= np.pi
    sigma = rng.uniform(1e-4, 1, 10_000).astype(np.float32)
    assert np.abs(SIGMA_DIGITS.apply(sigma, 3.0, False) / sigma - 1).max() <= 2.0**-8
    levels = rng.uniform(0, 255, 10_000).astype(np.float32)
    # Half of 1/4, the step below 0.3.
    assert np.abs(MODULATION_DIGITS.apply(levels, 3.0, False) - levels).max() <= 0.125


def test_relative_ranges_are_rounded_and_depths_in_mm_are_not():
    depth = np.float32([0.123456])
    assert RELATIVE_RANGE_DIGITS.apply(depth, 3.0, False) != depth
    assert RELATIVE_RANGE_DIGITS.apply(depth, 3.0, True) == depth
