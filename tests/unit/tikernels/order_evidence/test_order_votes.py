"""Votes of the frame before, against a twin and closed forms."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import drafts_and_orders, join, surface

import tikernels
from tikernels import runtime
from tikernels.order_evidence import vote_orders
from tikernels.order_evidence.order_votes import BEFORE, LACKING, PATCH, REST, SOUND, VOTES_A_CELL
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.unwrapping.tables import cells_of, numbers_of

NO_CHANGE = np.zeros((4, 3), np.float32)


def voters(shape: tuple[int, int]) -> np.ndarray:
    """Return (N, 2) row and column of every vote: in each cell every fourth pixel both ways, from the second on."""
    rows, columns = cells_of(*shape)
    cell, place = np.divmod(np.arange(rows * columns * VOTES_A_CELL), VOTES_A_CELL)
    return np.stack([cell // columns * 16 + 4 * (place // 2) + 1, cell % columns * 8 + 4 * (place % 2) + 1], axis=1)


def twin(phase, patches, before, region_before):
    """Return the votes, pixel by pixel, and their places."""
    graph = patches.graph()
    drafts, order = drafts_and_orders(runtime.to_host(patches.labels))
    number = numbers_of(drafts, runtime.to_host(patches.cell_table), patches.draft_bits)
    votes, places = [], []
    for y, x in voters(phase.shape):
        if not (y < phase.shape[0] and x < phase.shape[1]):
            continue
        region = region_before[y, x]
        if drafts[y, x] < 0 or region == 0:
            continue
        places.append((y, x))
        patch = number[y, x]
        lacking = (before[y, x] - phase[y, x]) / (2 * np.pi) - order[y, x] - graph.offset[patch]
        rest = 64 * (lacking - np.rint(lacking))
        votes.append((patch, int(np.rint(lacking)), rest, region, smooth(before, y, x)))
    return np.array(votes), np.transpose(places)


def smooth(before, y, x) -> bool:
    """Whether no three pixels in a row, 5 or 10 px apart, bend by more than 2.5 rad, or are missing."""
    height, width = before.shape
    if not (10 <= y < height - 10 and 10 <= x < width - 10):
        return False
    around = [
        before[y - reach * dy, x - reach * dx] + before[y + reach * dy, x + reach * dx] - 2 * before[y, x]
        for reach in (5, 10)
        for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1))
    ]
    return bool(np.all(np.abs(around) <= 2.5))


@pytest.mark.parametrize("shape", [(97, 131), (33, 41)])
def test_as_the_twin(arch, shape):
    rng = np.random.default_rng(5)
    true = surface(*shape)
    phase = reference.wrapped(true)
    phase[rng.random(shape) < 0.02] = NO_PHASE
    before = (true + 0.3 * rng.standard_normal(shape)).astype(np.float32)
    before[rng.random(shape) < 0.01] = np.nan
    region = np.where(np.isnan(before), 0, rng.integers(1, 4, shape)).astype(np.int32)
    patches, _ = join(phase)
    votes, places = vote_orders(phase, patches, before, region, NO_CHANGE)
    expected, at = twin(phase.astype(np.float64), patches, before.astype(np.float64), region)
    np.testing.assert_array_equal(places, at)
    np.testing.assert_array_equal(votes[:, [PATCH, LACKING, BEFORE, SOUND]], expected[:, [0, 1, 3, 4]])
    np.testing.assert_allclose(votes[:, REST], expected[:, 2], atol=0.501)  # rounded to 64ths of a cycle


def test_a_surface_that_has_moved_lacks_its_cycles(arch):
    """A plane that was a quarter of a cycle and seven cycles higher: all sound votes say so."""
    true = reference.ramp(96, 120, tilt=0.02)
    phase = reference.wrapped(true)
    patches, _ = join(phase)
    graph = patches.graph()
    _, order = drafts_and_orders(runtime.to_host(patches.labels))
    y, x = np.divmod(graph.first, 120)
    now = phase[y, x] + 2 * np.pi * (order[y, x] + graph.offset)
    constant = np.rint((true[y, x] - now) / (2 * np.pi))
    assert np.ptp(constant) == 0
    before = (true + 2 * np.pi * 7.25).astype(np.float32)
    votes, _ = vote_orders(phase, patches, before, np.ones(true.shape, np.int32), NO_CHANGE)
    sound = votes[votes[:, SOUND] == 1]
    assert len(sound) > 0.5 * len(votes)
    assert (sound[:, LACKING] == 7 + constant[0]).all() and (np.abs(sound[:, REST] - 16) <= 1).all()


def test_votes_are_taken_with_the_change_that_is_expected(arch):
    """A plane that has moved by 0.6 cycles, and by more to the right and below, as it did before."""
    true = reference.ramp(96, 120, tilt=0.02)
    patches, _ = join(reference.wrapped(true))
    change = np.array([[0, 0, 0], [1.2 * np.pi, 0.02, -0.01]], np.float32)
    y, x = np.indices(true.shape)
    before = true - (change[1, 0] + change[1, 1] * x + change[1, 2] * y)
    votes, _ = vote_orders(
        reference.wrapped(true), patches, before.astype(np.float32), np.ones(true.shape, np.int32), change
    )
    sound = votes[votes[:, SOUND] == 1]
    assert np.ptp(sound[:, LACKING]) == 0 and np.abs(sound[:, REST]).max() <= 1


def test_what_is_refused(arch):
    phase = reference.wrapped(reference.ramp(32, 40))
    patches, _ = join(phase)
    with pytest.raises(tikernels.ShapeError, match="unwrapped_before has shape"):
        vote_orders(phase, patches, phase[1:], np.ones((32, 40), np.int32), NO_CHANGE)
    with pytest.raises(tikernels.ShapeError, match="region_before is uint8"):
        vote_orders(phase, patches, phase, np.ones((32, 40), np.uint8), NO_CHANGE)
    with pytest.raises(tikernels.ShapeError, match="change has shape"):
        vote_orders(phase, patches, phase, np.ones((32, 40), np.int32), NO_CHANGE[0])
