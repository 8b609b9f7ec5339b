"""What order finding sees of unwrapping: the graph, splitting, orders."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import drafts_and_orders, join, orders, surface, written

import tikernels
from tikernels import runtime
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.unwrapping.tables import numbers_of


def halves(graph, width: int) -> np.ndarray:
    """Return roots that split a region into the patches left and right of the middle."""
    right = graph.first % width >= width // 2
    return np.array([np.flatnonzero(right == side)[0] for side in (False, True)], np.int32)[right.astype(int)]


def test_the_graph_tells_what_the_labels_do(arch):
    """Pixels and first pixels of every patch, and offsets by which all orders of a plane agree."""
    true = reference.ramp(70, 90, tilt=0.02)
    phase = reference.wrapped(true)
    patches, _ = join(phase)
    graph = patches.graph()
    drafts, order = drafts_and_orders(runtime.to_host(patches.labels))
    number = numbers_of(drafts, runtime.to_host(patches.cell_table), patches.draft_bits)
    assert patches.count == len(graph.root) and patches.shape == (70, 90)
    np.testing.assert_array_equal(graph.pixels, np.bincount(number.ravel(), minlength=patches.count))
    np.testing.assert_array_equal(number.ravel()[graph.first], np.arange(patches.count))
    cycles = np.rint((true - phase) / (2 * np.pi)).astype(int)
    assert np.ptp(order + graph.offset[number] - cycles) == 0
    np.testing.assert_array_equal(graph.root, patches.roots())
    assert len(np.unique(graph.root)) == 1


def test_a_graph_stays_what_it_was(arch):
    """Splitting writes the patches' table, not what was read of it."""
    patches, _ = join(reference.wrapped(surface()))
    graph = patches.graph()
    before = graph.root.copy()
    patches.split(np.arange(patches.count, dtype=np.int32))
    np.testing.assert_array_equal(graph.root, before)
    np.testing.assert_array_equal(patches.roots(), np.arange(patches.count))


def test_parts_get_orders_of_their_own(arch):
    """A split plane's right half is put three cycles higher."""
    true = reference.ramp(80, 96)
    phase = reference.wrapped(true)
    patches, rates = join(phase)
    whole = orders(written(patches, phase, rates)[0], phase)
    roots = halves(patches.graph(), 96)
    patches.split(roots)
    parts = np.unique(roots)
    own = patches.orders(parts)
    patches.set_orders(parts[1:], own[1:] + 3)
    np.testing.assert_array_equal(patches.orders(parts) - own, [0, 3])
    unwrapped, mask, region = written(patches, phase, rates)
    assert set(np.unique(region[mask != 0])) == {1, 2}
    # Cells on either side of the split hide a step, and so do those beside them at the image's border.
    low, high = (np.unique(region[:, side]) for side in (np.s_[:32], np.s_[64:]))
    assert len(low) == len(high) == 1 and low != high
    cycles = np.rint((unwrapped - true) / (2 * np.pi))[mask != 0]
    left = region[mask != 0] == low
    assert np.ptp(cycles[left]) == np.ptp(cycles[~left]) == 0
    assert np.ptp(whole - np.rint((true - phase) / (2 * np.pi))) == 0


def test_patches_change_their_orders_one_by_one(arch):
    """The right half of a plane, two cycles higher; and shifts of another number of patches are refused."""
    true = reference.ramp(80, 96)
    phase = reference.wrapped(true)
    patches, rates = join(phase)
    roots = halves(patches.graph(), 96)
    right = roots == roots.max()
    patches.shift_orders(2 * right)
    patches.split(np.zeros(patches.count, np.int32))  # one region again: its patches' orders stay
    patches.set_orders(np.array([0]), np.array([0]))
    unwrapped, mask, _ = written(patches, phase, rates)
    cycles = np.rint((unwrapped - true) / (2 * np.pi))
    left, right = (np.unique(cycles[:, side][mask[:, side] != 0]) for side in (np.s_[:32], np.s_[64:]))
    assert len(left) == len(right) == 1 and right - left == 2
    with pytest.raises(tikernels.ShapeError, match="shifts has shape"):
        patches.shift_orders(np.zeros(patches.count + 1, np.int64))


def test_regions_that_were_written(arch):
    """Two surfaces beside a gap: roots and pixels of both, the larger first; specks are none."""
    phase = reference.wrapped(reference.ramp(64, 100))
    phase[:, 30:34] = NO_PHASE
    phase[:, 98] = NO_PHASE
    patches, rates = join(phase)
    outputs = tuple(runtime.empty(phase.shape, dtype) for dtype in (np.float32, np.uint8, np.int32))
    table = patches.write(phase, np.ones_like(phase), rates, *outputs)
    region = runtime.to_host(outputs[2])
    np.testing.assert_array_equal(table.pixels, np.bincount(region.ravel())[1:])
    np.testing.assert_array_equal(table.pixels, [64 * 64, 64 * 30])
    np.testing.assert_array_equal(patches.roots()[table.roots], table.roots)


def test_nothing_at_all(arch):
    patches, rates = join(np.full((32, 24), NO_PHASE, np.float32))
    assert patches.count == 0 and len(patches.roots()) == 0 and patches.graph().ends.shape == (2, 0)
    unwrapped, mask, region = written(patches, np.full((32, 24), NO_PHASE, np.float32), rates)
    assert np.isnan(unwrapped).all() and not mask.any() and not region.any()


def test_what_are_not_patches_is_refused(arch):
    """Nothing is written: the patches' roots and the regions' orders stay."""
    patches, _ = join(reference.wrapped(surface()))
    roots, count = patches.roots(), patches.count
    regions = np.unique(roots)
    orders_before = patches.orders(regions)
    for bad, message in (
        (roots[:-1], rf"roots has shape \({count - 1},\), expected one for each of {count} patches"),
        (roots.astype(np.float64), "roots is 1-dimensional float64, expected a row of integers"),
        (roots - count, rf"roots holds -\d+ to -\d+, expected numbers of patches, 0 to {count - 1}"),
        (roots + count, rf"roots holds \d+ to \d+, expected numbers of patches, 0 to {count - 1}"),
    ):
        with pytest.raises(tikernels.ShapeError, match=message):
            patches.split(bad)
    for bad, message in ((regions - count, "roots holds"), (regions[None], "roots is 2-dimensional int32")):
        with pytest.raises(tikernels.ShapeError, match=message):
            patches.set_orders(bad, np.zeros(bad.shape, int))
    with pytest.raises(tikernels.ShapeError, match=r"orders has shape \(\d+,\), expected \(\d+,\): one for each root"):
        patches.set_orders(regions, np.zeros(len(regions) + 1, int))
    np.testing.assert_array_equal(patches.roots(), roots)
    np.testing.assert_array_equal(patches.orders(regions), orders_before)


def test_what_is_left_out_is_not_written(arch):
    phase = reference.wrapped(surface()).astype(np.float32)
    patches, rates = join(phase)
    roots = patches.roots()
    largest = np.bincount(roots).argmax()
    before = written(patches, phase, rates)[2]
    patches.split(roots, roots == largest)
    mask, region = written(patches, phase, rates)[1:]
    assert np.count_nonzero(before == 1) > 5000
    assert not mask[before == 1].any()
    assert region.max() == before.max() - 1


def test_a_patch_that_is_left_out_of_a_region_is_not_written(arch):
    phase = reference.wrapped(reference.ramp(80, 96)).astype(np.float32)
    patches, rates = join(phase)
    assert written(patches, phase, rates)[1].all()
    first = patches.graph().first
    patches.split(patches.roots(), first == 32 * 96 + 48)
    outside = written(patches, phase, rates)[1] == 0
    assert outside[32:48, 48:56].all()
    outside[31:49, 47:57] = False  # nor are the pixels around it
    assert not outside.any()
