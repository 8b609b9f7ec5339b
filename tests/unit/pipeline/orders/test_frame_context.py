"""What placed parts tell of the others: how high the contrast is, and where the surfaces are."""

import numpy as np
from support.coded_steps import WIDTH, grid

from pipeline.orders.frame_context import PartLevel, level_evidence, log_nearness, nearness
from pipeline.pattern import contrast_levels

STRENGTHS = (0.0, 0.5, 1.0)
FULL = 2  # the place of strength 1


def part(offset, factor, offsets=40):
    """Return the level of a part of one cycle with these offsets possible."""
    code = np.array([contrast_levels(strength)[:offsets] for strength in STRENGTHS])
    return PartLevel(float(code[FULL, offset] + factor), code, 1e-4)


def test_the_level_tells_the_symbol():
    """Three placed parts have a factor of -0.2; of the fourth only offsets with its symbol stay likely."""
    levels = [part(3, -0.2), part(12, -0.21), part(30, -0.19), part(17, -0.2)]
    evidence = level_evidence(levels, {0: 3, 1: 12, 2: 30}, np.full(4, 1000))
    away = np.abs(contrast_levels()[:40] - contrast_levels()[17])
    found = evidence[3][FULL]
    assert found[away < 0.02].min() > found[away > 0.1].max() + 3
    # Without strength all offsets are alike.
    assert np.ptp(evidence[3][0]) == 0


def test_a_level_of_its_own_says_little():
    """Nothing has the factor of a part in deep shadow; that does not name an offset with certainty."""
    levels = [part(3, -0.2), part(12, -0.21), part(17, -1.0)]
    evidence = level_evidence(levels, {0: 3, 1: 12}, np.full(3, 1000))
    assert np.ptp(evidence[2][FULL]) < 5


def test_nothing_without_placed_parts():
    levels = [part(3, -0.2), None, part(12, -0.2)]
    evidence = level_evidence(levels, {0: 3}, np.full(3, 1000))
    assert evidence[0] == 0.0 and evidence[1] == 0.0 and np.ndim(evidence[2]) == 2


def test_parts_near_a_plane():
    """The left half is placed; the right one, whose orders count from elsewhere, lacks 5 cycles to be on its plane."""
    graph = grid(6, 10)
    right = np.arange(60) % 10 >= 5
    roots = np.where(right, 5, 0).astype(np.int32)
    graph = graph._replace(offset=(graph.offset - 5 * right).astype(np.int32))
    lacking = nearness(graph, roots, WIDTH, {0: 12})
    np.testing.assert_allclose(lacking[[0, 5]], [12, 17])
    likely = log_nearness(lacking[5], np.arange(40))
    assert likely.argmax() == 17 and likely[17] == 0
    np.testing.assert_allclose(likely[[13, 21]], -np.log(2))
