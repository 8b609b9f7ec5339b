"""Factors of parts and how likely their blocks are, against NumPy twins."""

import numpy as np
import pytest

from tikernels.order_evidence.factor_fit import EVEN, FITTED, LEVELS, ROWS, SPREADS, Row, fit_factors, flatten

RESPONSES, CYCLES, PLACES = 3, 20, 30
ANY_OF = np.array([0.05, *np.linspace(-0.1, 0.1, LEVELS)], np.float32)
NOISE, OTHER, OTHER_SIGMA = 0.01, 0.15, 0.2


def code(rng):
    return rng.normal(0, 0.1, (RESPONSES, CYCLES, PLACES)).astype(np.float32)


def blocks(rng, levels, lacks, count=60):
    """Return blocks that show a code at an offset and a factor, and a tenth of them something else."""
    values = np.zeros((ROWS, count))
    values[Row.VARIANCE] = (NOISE * rng.uniform(0.5, 1.5, count)) ** 2
    values[Row.COUNTS] = rng.uniform(0.3, 0.6, count)
    values[Row.DOWN : Row.DARKER + 1] = rng.normal(0, 0.1, (3, count))
    values[Row.OFF] = np.where(rng.random(count) < 0.2, rng.normal(0, 0.1, count), 0)
    values[Row.ORDER] = np.sort(rng.integers(-2, 9, count))
    values[Row.COLUMN :] = (rng.normal(0, 1, (4, count)).T * [3, 0.1, 1e-3, 1e-5]).T
    values = values.astype(np.float32)
    values[Row.LEVEL] = expected(values, levels, 1, lacks, 0.0)[0] + terms_of(values, 1) @ [-0.2, 0.8, -0.5, 0.3]
    values[Row.LEVEL] += NOISE * rng.normal(0, 1, count) + 0.4 * (rng.random(count) < 0.1)
    return values


def expected(values, levels, response, offset, shift):
    """Return a code's levels, and whether it has such cycles."""
    cycle = values[Row.ORDER].astype(int) + offset
    inside, cycle = (cycle >= 0) & (cycle < CYCLES), np.clip(cycle, 0, CYCLES - 1)
    along = (values[Row.COLUMN :].T * cycle[:, None] ** np.arange(4.0)).sum(axis=1) + shift
    place = np.floor(np.mod(along, 1) * PLACES).astype(int)
    change = levels[response, np.minimum(cycle + 1, CYCLES - 1), place]
    change = change - levels[response, np.maximum(cycle - 1, 0), place]
    return levels[response, cycle, place] + values[Row.OFF] * change, inside


def terms_of(values, gain_sigma):
    return np.column_stack([np.full(values.shape[1], gain_sigma), *values[Row.DOWN : Row.DARKER + 1]])


def densities(departs, variance, spread):
    near, far = variance + spread**2, variance + OTHER_SIGMA**2
    other = OTHER * np.exp(-0.5 * departs**2 / far) / np.sqrt(far)
    return (1 - OTHER) * np.exp(-0.5 * departs**2 / near) / np.sqrt(near) + other


def fitted(values, level, inside, gain, gain_sigma, spreads=SPREADS):
    """Return the likelihood of what a fit leaves of levels, the terms of the factor, and what it leaves."""
    values = values.astype(np.float64)
    usual = np.median(level) if gain is None else gain
    terms, variance, counts = terms_of(values, gain_sigma), values[Row.VARIANCE], values[Row.COUNTS]
    departs, near = level - usual, variance + FITTED**2
    far, fit = near + OTHER_SIGMA**2, np.array([np.median(level - usual) / gain_sigma, 0, 0, 0])
    for _ in range(3):
        shows = (1 - OTHER) / np.sqrt(near) * np.exp(-0.5 * (departs - terms @ fit) ** 2 * (1 / near - 1 / far))
        weights = counts * inside / near * shows / (shows + OTHER / np.sqrt(far))
        normal = (terms.T * weights) @ terms + np.eye(4)
        fit = np.linalg.solve(normal, (terms.T * weights) @ departs)
    departs = departs - terms @ fit
    outside = np.log(OTHER / np.sqrt(variance + OTHER_SIGMA**2))
    shown = [counts @ np.where(inside, np.log(densities(departs, variance, spread)), outside) for spread in spreads]
    likelihood = np.logaddexp.reduce(shown) - np.log(len(SPREADS)) - 0.5 * (fit @ fit + np.linalg.slogdet(normal)[1])
    return likelihood, [usual + gain_sigma * fit[0], *fit[1:]], departs


@pytest.mark.parametrize(("gain", "gain_sigma"), [(None, 0.5), (-0.1, 0.08)])
def test_fits_as_the_twin(arch, gain, gain_sigma):
    """At offsets inside the code and partly outside, under several responses and shifts, with levels for each too."""
    rng = np.random.default_rng(0)
    levels = code(rng)
    values = blocks(rng, levels, 5)
    offsets, responses, shifts = np.array([5, 5, 5, 4, 14, -3]), np.array([1, 1, 2, 1, 1, 0]), np.arange(6) % 2 * 0.03
    each = (values[Row.LEVEL] + rng.normal(0, 0.02, (6, values.shape[1]))).astype(np.float32)
    for level in (None, each):
        found = fit_factors(
            values, levels, ANY_OF, offsets, responses, shifts, (gain, gain_sigma), by_cycle=False, level=level
        )
        for k in range(6):
            shown, inside = expected(values, levels, responses[k], offsets[k], shifts[k])
            seen = values[Row.LEVEL] if level is None else level[k]
            likelihood, terms, _ = fitted(values, seen - shown, inside, gain, gain_sigma)
            assert found.likelihood[k] == pytest.approx(likelihood, abs=2e-3, rel=1e-5)
            np.testing.assert_allclose(found.terms[:, k], terms, atol=1e-4)
        assert found.likelihood.argmax() == 0
        assert not found.other.any()
    np.testing.assert_allclose(
        fit_factors(values, levels, ANY_OF, offsets[:1], 1, 0.0, (None, 0.5), by_cycle=False).terms[:, 0],
        [-0.2, 0.8, -0.5, 0.3],
        atol=0.1,
    )


@pytest.mark.parametrize("count", [1, 2, 60])
@pytest.mark.parametrize("by_cycle", [False, True])
def test_blocks_without_the_code_as_the_twin(arch, by_cycle, count):
    """Each block has one of the levels, or each cycle, beside what all have in common."""
    rng = np.random.default_rng(1)
    levels = code(rng)
    values = blocks(rng, levels, 5, count)
    found = fit_factors(
        values, levels, ANY_OF, np.array([3, 0]), np.array([1, EVEN]), 0.0, (None, 0.5), by_cycle=by_cycle
    )
    spreads = np.array(SPREADS) / (2 if by_cycle else 1)
    level, all_inside = values[Row.LEVEL] - ANY_OF[0], np.ones(count, bool)
    likelihood, terms, departs = fitted(values, level, all_inside, None, 0.5, spreads)
    assert found.likelihood[1] == pytest.approx(likelihood, abs=2e-3, rel=1e-5)
    np.testing.assert_allclose(found.terms[:, 1], terms, atol=1e-4)
    cycle = values[Row.ORDER] if by_cycle else np.arange(count)
    total = []
    for spread in spreads:
        shown = np.log(densities(departs[:, None] - ANY_OF[1:], values[Row.VARIANCE, :, None], spread))
        shown = shown * values[Row.COUNTS, :, None]
        total.append(sum(np.log(np.exp(shown[cycle == each].sum(axis=0)).mean()) for each in np.unique(cycle)))
    expected = np.logaddexp.reduce(total) - np.log(len(SPREADS))
    assert found.other[0] == 0 and found.other[1] == pytest.approx(expected, abs=2e-3, rel=1e-5)


def test_flat_levels_as_the_twin(arch):
    rng = np.random.default_rng(2)
    levels = code(rng)
    values = blocks(rng, levels, 5)
    cells = np.stack([rng.integers(0, n, 60) for n in (7, 9, 4)]).astype(np.int32)
    offsets, terms = np.array([5, 4]), rng.normal(0, 0.3, (4, 2))
    found = flatten(values, cells, offsets, terms, levels, 1, (1, 2), 3)
    for k, offset in enumerate(offsets):
        plane = terms_of(values, 0.0) @ terms[:, k]
        departs = values[Row.LEVEL] - plane - terms[0, k] - expected(values, levels, 1, offset, 0.0)[0]
        near = (np.abs(cells[:, :, None] - cells[:, None]) <= np.array([1, 2, 1])[:, None, None]).all(axis=0)
        local = near @ np.clip(departs, -0.2, 0.2) / near.sum(axis=1)
        np.testing.assert_allclose(found[k], (values[Row.LEVEL] - plane - local)[::3], atol=1e-5)
