"""The forest of the most reliable edges against the sequential twin and scikit-image, and between backends."""

import numpy as np
import pytest
import reference
from support.missing import import_but_fail_in_ci
from support.wrapped_surfaces import flat_rates, holes, orders, surface, written

import tikernels
from tikernels import runtime
from tikernels.phase.wrapped_phase import mark_no_phase_kernel
from tikernels.unwrapping.edge_reliability import MISSING, NO_EDGE, weigh_edges_kernel
from tikernels.unwrapping.patches import Patches
from tikernels.unwrapping.tables import Edge
from tikernels.unwrapping.unwrap_methods import SpanningForest
from tikernels.unwrapping.unwrapper import RegionUnwrapper

#: rad, more than any two neighbours can depart: with it nothing is a step, as for scikit-image.
ANYTHING = 10.0


def joined(phase: np.ndarray, mask: np.ndarray, max_departure: float, draft_bits: int | None = None) -> tuple:
    """Return the marked phase, its patches, and rates by which no change is usual."""
    marked = runtime.empty(phase.shape, np.float32)
    mark_no_phase_kernel(phase, mask.view(np.uint8), marked)
    rates = runtime.to_device(flat_rates())
    method = SpanningForest(*phase.shape, max_departure)
    method.draft_bits = method.draft_bits if draft_bits is None else draft_bits
    unwrapper = RegionUnwrapper(*phase.shape, method)
    patches: Patches = unwrapper.join(marked, runtime.to_device(np.ones(phase.shape, np.float32)), rates)
    return marked, patches, rates


def unwrap_across_steps(phase: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return what the method makes of a phase where nothing is a step and no change usual, as scikit-image has it."""
    marked, patches, rates = joined(phase, mask, ANYTHING)
    return written(patches, marked, rates)[0]


def differing(unwrapped: np.ndarray, phase: np.ndarray, expected: np.ndarray, region: np.ndarray) -> int:
    """Count orders that are not the expected ones up to a constant a region, among those that were found."""
    found = ~np.isnan(unwrapped)
    return int(reference.wrong_orders(orders(unwrapped, phase) - expected, np.where(found, region, 0)).sum())


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("seed", [1, 2])
def test_as_the_twin(arch, noise, seed):
    """Steps and holes included: every order but where float32 decides between two equally reliable edges, 1e-4."""
    rng = np.random.default_rng(seed)
    phase = reference.wrapped(surface() + noise * rng.standard_normal((97, 131)))
    mask = holes(phase.shape, rng)
    unwrapped = tikernels.unwrap_phase(phase, np.ones_like(phase), mask, method="reliability")
    order, region = reference.unwrap_by_reliability(phase, mask)
    large = np.bincount(region.ravel())[region] >= 128
    # An edge whose departure lies on the limit may hang a single pixel on; beside hidden steps pixels are left out.
    assert np.count_nonzero(~np.isnan(unwrapped) & ~large) <= (2 if noise else 0)
    assert np.count_nonzero(np.isnan(unwrapped) & large & mask) <= 0.03 * mask.size
    assert differing(unwrapped, phase, order, region) <= (1e-4 * mask.size if noise else 0)


@pytest.mark.parametrize("noise", [0.3, 0.6])
@pytest.mark.parametrize("shape", [(97, 131), (64, 48), (16, 9), (130, 33)])
def test_residues_as_the_twin(arch, noise, shape):
    """Where noise makes residues any other forest has other orders; a sieve for a mask, nothing is a step."""
    rng = np.random.default_rng(shape[0])
    phase = reference.wrapped(reference.ramp(*shape, tilt=0.03) + noise * rng.standard_normal(shape))
    mask = (rng.random(shape) > 0.02) & (np.arange(shape[1]) != shape[1] // 2)
    unwrapped = unwrap_across_steps(phase, mask)
    order, region = reference.unwrap_by_reliability(phase, mask, (0.0, 0.0), ANYTHING)
    assert np.count_nonzero(~np.isnan(unwrapped)) > (0.5 * mask.size if mask.size > 500 else -1)
    assert differing(unwrapped, phase, order, region) <= 1e-4 * mask.size


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3, 0.6])
def test_as_scikit_image(arch, noise):
    """The same wrapped phase, residues included: 2e-5 of the pixels may be ties."""
    restoration = import_but_fail_in_ci("skimage.restoration")
    rng = np.random.default_rng(4)
    phase = reference.wrapped(surface(150, 211) + noise * rng.standard_normal((150, 211)))
    unwrapped = unwrap_across_steps(phase, np.ones(phase.shape, bool))
    theirs = restoration.unwrap_phase(phase.astype(np.float64), rng=0)
    expected = np.rint((theirs - phase) / reference.CYCLE).astype(int)
    assert np.mean(~np.isnan(unwrapped)) > 0.7
    assert differing(unwrapped, phase, expected, np.ones(phase.shape, int)) <= 2e-5 * phase.size


def test_backends_agree(arch):
    """Bit by bit, whatever the noise; and the CPU's threads from run to run."""
    rng = np.random.default_rng(9)
    cases = []
    for shape, noise in (((97, 131), 0.0), ((97, 131), 0.3), ((64, 200), 1.0), ((1, 300), 0.1)):
        phase = reference.wrapped(reference.ramp(*shape, tilt=0.03) + noise * rng.standard_normal(shape))
        cases.append((phase, rng.random(shape, np.float32), rng.random(shape) > 0.01))
    found = [tikernels.unwrap_phase(*case, method="reliability") for case in cases]
    tikernels.init("cpu")
    for case, unwrapped in zip(cases, found, strict=True):
        np.testing.assert_array_equal(unwrapped, tikernels.unwrap_phase(*case, method="reliability"))


def test_crowded_cells(arch):
    """Phases of pure noise make more patches and contacts a cell than it has places for at first."""
    rng = np.random.default_rng(10)
    phase = rng.uniform(-np.pi, np.pi, (96, 128)).astype(np.float32)
    mask = rng.random(phase.shape) > 0.3
    _, region = reference.unwrap_by_reliability(phase, mask, (0.0, 0.0), 1.5)
    _, patches, _ = joined(phase, mask, 1.5, draft_bits=0)
    sizes = np.bincount(patches.roots(), patches.graph().pixels)
    expected = np.bincount(region[region > 0])
    np.testing.assert_array_equal(np.sort(sizes[sizes > 0]), np.sort(expected[expected > 0]))


@pytest.mark.parametrize("shape", [(23, 41), (64, 48), (1, 5)])
def test_levels_as_the_equation(arch, shape):
    """H^2 + V^2 + D1^2 + D2^2 of both ends, to what counting in 2^15ths of a cycle leaves of eight differences."""
    rng = np.random.default_rng(shape[1])
    phase = reference.wrapped(reference.ramp(*shape, tilt=0.03) + 0.3 * rng.standard_normal(shape))
    edges = runtime.empty((len(Edge), -(-shape[0] // 16) * 16 + 1, -(-shape[1] // 8) * 8 + 1), np.int32)
    weigh_edges_kernel(phase, runtime.to_device(flat_rates()), ANYTHING, edges)
    edges = runtime.to_host(edges)
    inside = edges[:, 1 : shape[0] + 1, 1 : shape[1] + 1]
    unit = 2**15 / reference.CYCLE
    np.testing.assert_array_equal(inside[Edge.COUNTED], (phase * np.float32(unit)).astype(np.int32))
    assert (edges[Edge.COUNTED, 0] > MISSING).all() and (edges[Edge.RIGHT, 0] == NO_EDGE).all()
    bend = np.zeros(shape)
    for rows, columns in ((0, 1), (1, 0), (1, 1), (1, -1)):
        before, after = (reference.neighbour(phase, side * rows, side * columns) for side in (-1, 1))
        both = reference.wrapped_difference(before, phase) + reference.wrapped_difference(after, phase)
        bend += (unit * both / 2) ** 2
    for plane, (rows, columns) in ((Edge.RIGHT, (0, 1)), (Edge.DOWN, (1, 0))):
        level = bend + reference.neighbour(bend, rows, columns)
        known = ~np.isnan(level)
        assert known.any() == (min(shape) > 3)
        # A difference counts to one unit, a sum of two bends by its size.
        error = np.abs(inside[plane][known] - level[known])
        assert (error <= 8 * np.sqrt(level[known]) + 16).all()
