"""Posteriors of parts by the steps that they show."""

import numpy as np
import pytest
from pipeline.orders.code_posterior import PartSteps, code_posteriors, log_likelihoods, seen_steps
from support.coded_steps import shown

from pipeline.pattern import contrast_steps

PART = np.array([0])


def seen(rows, lack, **surface):
    """Return the steps of one part of six columns."""
    _, steps = shown(rows, 6, [lack] * 6, **surface)
    return seen_steps(steps, np.zeros(6 * rows, np.int32), PART)[0]


@pytest.mark.parametrize("lack", [0, 7, 80])
def test_ten_cycles_name_their_place(lack):
    (posterior,) = code_posteriors(log_likelihoods([seen(10, lack)]), np.zeros(1)).posteriors
    assert posterior.best == lack and posterior.error(lack) < 1e-6


@pytest.mark.parametrize(("strength", "spread"), [(1.0, 0.006), (0.5, 0.006), (1.0, 0.04), (0.5, 0.04)])
def test_what_the_code_looks_like(strength, spread):
    rng = np.random.default_rng(2)
    steps = contrast_steps(strength)[20:60] + rng.normal(0, spread, 40)
    parts = [PartSteps(np.arange(40), steps, np.full(40, 6), 0.004)]
    code = code_posteriors(log_likelihoods(parts), np.zeros(1))
    assert code.strengths[0] == code.strength == pytest.approx(strength, rel=0.2)
    assert code.spreads[0] == pytest.approx(spread, rel=0.7)


def test_a_frame_without_the_code():
    steps = np.random.default_rng(2).normal(0, 0.1, 40)
    parts = [PartSteps(np.arange(40), steps, np.full(40, 6), 0.004)]
    code = code_posteriors(log_likelihoods(parts), np.zeros(1))
    assert code.strength == code.strengths[0] == 0


def test_few_cycles_do_not():
    (posterior,) = code_posteriors(log_likelihoods([seen(4, 20)]), np.zeros(1)).posteriors
    assert posterior.error(posterior.best) > 1e-3


def test_chance_that_looks_like_the_code_is_doubted():
    likelihoods = log_likelihoods([seen(7, 20)])
    errors = []
    for luck in (0.0, 12.0):
        (posterior,) = code_posteriors(likelihoods, np.array([luck])).posteriors
        errors.append(posterior.error(20))
    assert errors[1] > 10 * errors[0]


def test_a_part_without_steps():
    nothing = seen(1, 0)
    code = code_posteriors(log_likelihoods([nothing]), np.zeros(1))
    assert code.posteriors[0].error(0) == 1 and code.strengths[0] == 0


def test_many_parts_are_read_as_each_by_itself():
    """Of any number of steps and offsets, in any order."""
    parts = [seen(rows, lack) for rows, lack in ((5, 3), (1, 0), (9, 40), (5, 60), (2, 7))]
    for together, part in zip(log_likelihoods(parts), parts, strict=True):
        ((first, alone),) = log_likelihoods([part])
        assert together[0] == first
        np.testing.assert_allclose(together[1], alone, rtol=1e-5, atol=1e-5)
