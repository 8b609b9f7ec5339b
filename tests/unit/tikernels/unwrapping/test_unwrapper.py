"""Fringe orders against the sequential twin, known surfaces, and between backends."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import holes, join, orders, surface

import tikernels
from tikernels.unwrapping import RegionUnwrapper


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_as_the_twin(arch, noise, seed):
    """Up to one constant order a region the sequential twin's orders: all when clean, all but 1e-4 of them in noise."""
    rng = np.random.default_rng(seed)
    true = surface()
    phase = reference.wrapped(true + noise * rng.standard_normal(true.shape))
    quality = (rng.random(true.shape) + 0.5).astype(np.float32)
    mask = holes(true.shape, rng)
    unwrapped = tikernels.unwrap_phase(phase, quality, mask)
    order, region = reference.unwrap_phase(phase, quality, mask)
    found = ~np.isnan(unwrapped)
    # Where a hidden step leaves a pixel out hangs on single pixels' noise: one in a hundred may.
    assert np.count_nonzero(found != (region > 0)) <= (0.01 * mask.size if noise else 0)
    wrong = reference.wrong_orders(orders(unwrapped, phase) - order, np.where(found, region, 0))
    assert wrong.sum() <= (1e-4 * mask.size if noise else 0)


def test_the_graph_holds_regions_together(arch):
    """Every patch can be reached from its region's root: who splits a region by its graph must not find it in bits."""
    phase = reference.wrapped(surface() + 0.1 * np.random.default_rng(4).standard_normal(surface().shape))
    graph = join(phase)[0].graph()
    reached = np.arange(len(graph.root))
    for _ in range(len(reached)):
        before = reached.copy()
        for a, b in (graph.ends, graph.ends[::-1]):
            np.minimum.at(reached, a, reached[b])
        if np.array_equal(before, reached):
            break
    assert len(np.unique(reached)) == len(np.unique(graph.root)) < len(graph.root)
    assert (graph.votes > 0).all()


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
@pytest.mark.parametrize("shape", [(64, 48), (47, 129), (16, 8), (3, 300)])
def test_a_plane(arch, stripes, shape):
    """A ramp comes back as itself up to one constant; 1e-4 rad is what float32 leaves of 25 cycles."""
    true = reference.ramp(*shape, 12.0, tilt=0.05)
    phase = reference.wrapped(true)
    if stripes == "vertical":
        true, phase = true.T, np.ascontiguousarray(phase.T)
    unwrapped = tikernels.unwrap_phase(phase, np.ones_like(phase), np.ones(phase.shape, bool), stripes)
    assert not np.isnan(unwrapped).any()
    np.testing.assert_allclose(unwrapped - true, np.full(true.shape, (unwrapped - true)[0, 0]), atol=1e-4)


def test_the_start_has_order_zero(arch):
    """The reliable pixel nearest the centre keeps its wrapped phase."""
    phase = reference.wrapped(reference.ramp(128, 96))
    unwrapped = tikernels.unwrap_phase(phase, np.ones_like(phase), np.ones(phase.shape, bool))
    assert (orders(unwrapped, phase)[60:68, 44:52] == 0).any()


def test_separate_surfaces_start_anew(arch):
    """A gap as wide as a shadow joins nothing: both halves start with order 0."""
    true = reference.ramp(96, 128)
    true[:, 64:] += 100.0
    mask = np.ones(true.shape, bool)
    mask[:, 60:70] = False
    phase = reference.wrapped(true)
    unwrapped = tikernels.unwrap_phase(phase, np.ones_like(phase), mask)
    order = orders(unwrapped, phase)
    for half in (np.s_[:, :60], np.s_[:, 70:]):
        assert np.ptp((unwrapped - true)[half]) < 1e-3  # rad; one constant
        assert (order[half] == 0).any()


def test_noise_at_twelve_pixels_a_cycle(arch):
    """0.3 rad of noise, ten times the best frame's, costs no order on a plane but at single pixels: 1 in 1,000."""
    rng = np.random.default_rng(5)
    true = reference.ramp(150, 170, 12.0, tilt=0.02)
    phase = reference.wrapped(true + 0.3 * rng.standard_normal(true.shape))
    mask = np.ones(true.shape, bool)
    unwrapped = tikernels.unwrap_phase(phase, np.ones_like(phase), mask)
    found = ~np.isnan(unwrapped)
    cycles = np.rint(np.nan_to_num(unwrapped - true) / (2 * np.pi)).astype(int)
    assert found.mean() > 0.95
    assert reference.wrong_orders(cycles, found.astype(int)).sum() <= 1e-3 * mask.size


def test_nothing_valid(arch):
    phase = reference.wrapped(surface())
    for mask in (np.zeros(phase.shape, bool), np.eye(*phase.shape, dtype=bool)):  # specks are as good as nothing
        assert np.isnan(tikernels.unwrap_phase(phase, np.ones_like(phase), mask)).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (300, 1), (9, 11)])
def test_slim_images(arch, shape):
    """Fewer than 128 px are a speck; lines of 300 px unwrap."""
    true = reference.ramp(*shape, 12.0, tilt=0.05)
    phase = reference.wrapped(true)
    unwrapped = tikernels.unwrap_phase(phase, np.ones_like(phase), np.ones(shape, bool))
    if true.size < 128:
        assert np.isnan(unwrapped).all()
    else:
        assert np.ptp(unwrapped - true) < 1e-4


def test_missing_values_are_as_if_masked(arch):
    rng = np.random.default_rng(6)
    phase = reference.wrapped(surface() + 0.05 * rng.standard_normal((97, 131)))
    mask = holes(phase.shape, rng)
    expected = tikernels.unwrap_phase(phase, np.ones_like(phase), mask)
    phase[~mask] = np.nan
    found = tikernels.unwrap_phase(phase, np.ones_like(phase), np.ones_like(mask))
    np.testing.assert_array_equal(found, expected)


def test_useless_quality(arch):
    """Missing, zero or equal quality only weighs votes: a plane unwraps all the same."""
    true = reference.ramp(64, 48)
    for level in (np.nan, 0.0, 1e-30, 1e30):
        quality = np.full(true.shape, level, np.float32)
        unwrapped = tikernels.unwrap_phase(reference.wrapped(true), quality, np.ones(true.shape, bool))
        assert np.ptp(unwrapped - true) < 1e-4


def test_twice_the_same(arch):
    """Bit by bit, whatever order the threads ran in."""
    rng = np.random.default_rng(7)
    phase = reference.wrapped(surface(240, 320) + 0.4 * rng.standard_normal((240, 320)))
    quality = rng.random(phase.shape, np.float32)
    mask = holes(phase.shape, rng)
    first, second = (tikernels.unwrap_phase(phase, quality, mask) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_menu(menu):
    phase = reference.wrapped(surface(35, 41))
    rng = np.random.default_rng(8)
    inputs = {
        "wrapped_phase": phase,
        "quality": rng.random(phase.shape, np.float32),
        "mask": rng.random(phase.shape) > 0.02,
    }
    menu(tikernels.unwrap_phase, np.empty_like(phase), **inputs)


def test_unknown_stripes_are_refused(arch):
    image = np.zeros((4, 4), np.float32)
    with pytest.raises(tikernels.ShapeError, match="stripes is 'diagonal': choose"):
        tikernels.unwrap_phase(image, image, image == 0, "diagonal")


def test_cells_without_room_are_grown_again(arch):
    """With one place per cell at first, the patches are those of ample room."""
    rng = np.random.default_rng(3)
    true = reference.ramp(64, 72, tilt=0.03)
    phase = reference.wrapped(true + 0.4 * rng.standard_normal(true.shape))
    patches, rates = join(phase)
    *expected, expected_borders = patches.graph()
    tight = RegionUnwrapper(*phase.shape)
    tight._drafts.make_room(0)
    *found, found_borders = tight.join(phase, np.ones_like(phase), rates).graph()
    for one, other in zip([*found, *found_borders], [*expected, *expected_borders], strict=True):
        np.testing.assert_array_equal(one, other)


def test_join_refuses_other_shapes_and_types(arch):
    unwrapper = RegionUnwrapper(32, 24)
    phase, rates = np.zeros((32, 24), np.float32), np.zeros((5, 5), np.float32)
    with pytest.raises(tikernels.ShapeError, match="quality has shape"):
        unwrapper.join(phase, phase[1:], rates)
    with pytest.raises(tikernels.ShapeError, match="phase is float64"):
        unwrapper.join(phase.astype(np.float64), phase, rates)
    with pytest.raises(tikernels.ShapeError, match="rates has shape"):
        unwrapper.join(phase, phase, rates[:, :3])
