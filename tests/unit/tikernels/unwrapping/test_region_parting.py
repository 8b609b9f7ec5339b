"""Regions that touch where the step between them is a whole cycle."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import join, written

from tikernels.unwrapping import region_parting
from tikernels.unwrapping.patches import PatchGraph
from tikernels.unwrapping.region_parting import grow_parts, part_regions, regions_that_step
from tikernels.unwrapping.surface_borders import Borders

SHAPE = (240, 320)
CYCLE = 2 * np.pi


def disc_and_wall(slope):
    """Return the phase (rad) of a disc before a wall, exactly a cycle at its left end; where the disc is."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    disc = (y - 120) ** 2 + (x - 160) ** 2 < 70**2
    return reference.ramp(*SHAPE, 12.0) + np.where(disc, CYCLE + slope * (x - 90), 0.0), disc


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_disc_that_touches_the_wall_is_a_region_of_its_own(arch, noise):
    """It joins the wall for a tenth of its border, where the step is a cycle; everywhere else it steps."""
    true, disc = disc_and_wall(0.03)
    rng = np.random.default_rng(3)
    phase = reference.wrapped(true + rng.normal(0, noise, SHAPE)).astype(np.float32)
    patches, rates = join(phase)
    unwrapped, mask, region = written(patches, phase, rates)
    sizes = np.bincount(region.ravel())[1:]
    assert len(sizes) == 2
    assert 0.8 * disc.sum() < sizes[1] < 1.02 * disc.sum()
    # In either region all pixels have the same order relative to the truth.
    for number in (1, 2):
        inside = (region == number) & (mask != 0)
        cycles = np.rint((unwrapped[inside] - true[inside]) / CYCLE)
        assert np.mean(cycles != np.median(cycles)) < 0.005


def test_one_surface_stays_one(arch):
    """A bump as steep as a nose, with noise, and a hole."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    bump = 9 * np.exp(-((y - 120) ** 2 + (x - 160) ** 2) / 900)
    rng = np.random.default_rng(4)
    phase = reference.wrapped(reference.ramp(*SHAPE, 12.0) + bump + rng.normal(0, 0.1, SHAPE)).astype(np.float32)
    patches, _ = join(phase)
    roots, counts = np.unique(patches.roots(), return_counts=True)
    assert counts.max() > 0.98 * counts.sum(), f"{len(roots)} regions"


@pytest.mark.parametrize("seed", [1, 2])
def test_parts_grow_as_the_twin(arch, seed):
    """Stripes of two shades of patches, which step against the other shade: more loop rounds than one call may do."""
    rng = np.random.default_rng(seed)
    rows, columns = 80, 100
    number = np.arange(rows * columns).reshape(rows, columns)
    along = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()])
    down = np.stack([number[:-1].ravel(), number[1:].ravel()])
    contacts = np.concatenate([along, down], axis=1).astype(np.int32)
    contacts = np.ascontiguousarray(contacts[:, rng.permutation(contacts.shape[1])])
    shade = (number % columns // 10 % 2).ravel()
    against = contacts[:, shade[contacts[0]] != shade[contacts[1]]].T.copy()
    # Quarters: sums of float32 are then exact in any order.
    px = np.round(rng.uniform(0, 8, len(against)) * 4).astype(np.float32) / 4
    pixels = rng.integers(40, 129, rows * columns).astype(np.int32)
    before = pixels.copy()
    limits = (region_parting._MAX_STEPPING, region_parting._MIN_PATCH_PX)
    expected = reference.grow_parts(contacts, against, px, pixels, *limits)
    np.testing.assert_array_equal(grow_parts(contacts, against, px, pixels), expected)
    np.testing.assert_array_equal(pixels, before)
    assert 2 < len(np.unique(expected)) < 500


def test_nothing_steps(arch):
    contacts = np.array([[0, 1], [1, 2]], np.int32)
    none = np.empty((0, 2), np.int32), np.empty(0, np.float32)
    np.testing.assert_array_equal(grow_parts(contacts, *none, np.full(4, 128, np.int32)), [0, 0, 0, 3])


def test_parts_join_over_most_of_their_border(arch):
    """Three rows of patches: the second goes on over most of its border with the first, the third does not."""
    number = np.arange(30).reshape(3, 10)
    along = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()])
    down = np.stack([number[:-1].ravel(), number[1:].ravel()])
    stepping = np.zeros(20)
    stepping[[0, 1, 2]] = 8.0  # of the first border 3 of 10 pairs step,
    stepping[[10, 11, 12, 13, 14, 15]] = 8.0  # of the second 6
    borders = Borders(
        np.concatenate([along, down], axis=1),
        np.zeros(47, np.int64),
        np.concatenate([np.full(27, 8.0), 8.0 - stepping]),
        np.concatenate([np.zeros(27), stepping]),
    )
    ends = np.concatenate([along, down[:, stepping == 0]], axis=1).astype(np.int32)
    zeros = np.zeros(30, np.int32)
    of_patches = (zeros, zeros, np.full(30, 128, np.int32), np.arange(30, dtype=np.int32))
    votes = np.concatenate([np.full(27, 400), np.full(11, 300)]).astype(np.int32)
    graph = PatchGraph(*of_patches, ends, votes)
    assert regions_that_step(graph.root, borders)[0]
    roots, slivers, beside = part_regions(graph, borders, np.zeros((2, 30)))
    assert not slivers.any()
    assert len(np.unique(roots[:20])) == 1
    assert len(np.unique(roots[20:])) == 1
    assert roots[0] != roots[20]
    # Where they go on, if not over most of their border, they are said to be neighbours.
    np.testing.assert_array_equal(beside, np.where(np.arange(30) < 20, roots[20], roots[0]))
    # A row of small patches is a sliver.
    few = np.repeat([128, 128, 30], 10).astype(np.int32)
    _, slivers, _ = part_regions(graph._replace(pixels=few), borders, np.zeros((2, 30)))
    np.testing.assert_array_equal(slivers, np.arange(30) >= 20)
    # Where nothing steps, nothing is parted.
    smooth = borders._replace(stepping=np.zeros(47))
    assert not regions_that_step(graph.root, smooth).any()
