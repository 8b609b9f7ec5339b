"""Posteriors of parts by the steps that they show."""

import numpy as np
import pytest
from support.coded_steps import shown

from pipeline.orders.code_posterior import code_posteriors, log_likelihoods, seen_steps

PART = np.array([0])


def seen(rows, lack, **surface):
    """Return the steps of one part of six columns."""
    _, steps = shown(rows, 6, [lack] * 6, **surface)
    return seen_steps(steps, np.zeros(6 * rows, np.int32), PART)[0]


@pytest.mark.parametrize("lack", [0, 7, 80])
def test_ten_cycles_name_their_place(lack):
    (posterior,), readable = code_posteriors(log_likelihoods([seen(10, lack)]), np.zeros(1))
    assert readable and posterior.best == lack and posterior.error(lack) < 1e-6


def test_few_cycles_do_not():
    (posterior,), _ = code_posteriors(log_likelihoods([seen(4, 20)]), np.zeros(1))
    assert posterior.error(posterior.best) > 1e-3


def test_chance_that_looks_like_the_code_is_doubted():
    likelihoods = log_likelihoods([seen(7, 20)])
    errors = []
    for luck in (0.0, 12.0):
        (posterior,), _ = code_posteriors(likelihoods, np.array([luck]))
        errors.append(posterior.error(20))
    assert errors[1] > 10 * errors[0]


def test_a_part_without_steps():
    nothing = seen(1, 0)
    (posterior,), _ = code_posteriors(log_likelihoods([nothing]), np.zeros(1))
    assert posterior.error(0) == 1


def test_many_parts_are_read_as_each_by_itself():
    """Of any number of steps and offsets, in any order."""
    parts = [seen(rows, lack) for rows, lack in ((5, 3), (1, 0), (9, 40), (5, 60), (2, 7))]
    for together, part in zip(log_likelihoods(parts), parts, strict=True):
        ((first, alone),) = log_likelihoods([part])
        assert together[0] == first
        np.testing.assert_allclose(together[1], alone, rtol=1e-5, atol=1e-5)
