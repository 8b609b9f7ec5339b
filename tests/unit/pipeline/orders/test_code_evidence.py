"""What blocks say of their part's offset, of the code itself and of where it lies."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from support.coded_blocks import CODES, code_and_columns, reader_of

from pipeline.contrast_code import GAMMAS
from pipeline.orders.code_blocks import Blocks
from pipeline.orders.code_evidence import CodeReader, Factor
from pipeline.orders.posterior import NOTHING_KNOWN
from pipeline.orders.stripe_columns import column_at
from tikernels.order_evidence.contrast_reading import BLOCK_WIDTH
from tikernels.unwrapping.tables import CELL_HEIGHT

# Patches, cycles by columns of two blocks, that name their place, and that do not.
ENOUGH, FEW = {"contrast": (7, 6), "contrast2": (2, 4)}, {"contrast": (4, 6), "contrast2": (1, 3)}
CELL_PX = code_and_columns("contrast2")[0].cell_px
each_code = pytest.mark.parametrize("name", CODES)


def all_of(reader):
    return np.arange(len(reader.blocks.order))


def posterior(reader, luck=0.0):
    return reader.read(all_of(reader)).posterior(0.0, luck, reader.trust)


@each_code
@pytest.mark.parametrize("lack", [0, 7, 30])
@pytest.mark.parametrize("gamma", [1.0, 2.0])
def test_small_surfaces_name_their_place(name, lack, gamma):
    reader = reader_of(name, *ENOUGH[name], lack, gamma=gamma)
    assert reader.learn()
    found = posterior(reader)
    assert found.best == lack and found.error(lack) < 1e-4


@each_code
def test_smaller_ones_do_not(name):
    reader = reader_of(name, *FEW[name], 21)
    found = posterior(reader)
    assert found.error(found.best) > 1e-2


@each_code
def test_a_frame_that_shows_too_little_to_say(name):
    assert reader_of(name, *{"contrast": (2, 4), "contrast2": (1, 3)}[name], 12).learn() is None


@each_code
def test_chance_that_looks_like_the_code_is_doubted(name):
    reader = reader_of(name, *{"contrast": (5, 1), "contrast2": (1, 6)}[name], 9)
    errors = [posterior(reader, luck).error(9) for luck in (0.0, 8.0)]
    assert errors[0] < 0.02 and errors[1] > 10 * errors[0]


@each_code
def test_what_else_is_known_of_the_offsets_counts(name):
    evidence = reader_of(name, *FEW[name], 21)
    evidence = evidence.read(all_of(evidence))
    prior = np.where(evidence.first + np.arange(len(evidence.likelihood)) == 21, 0.0, -20.0)
    assert evidence.posterior(0.0, 0.0, 0.0).error(21) > 1e-2 > 1e-6 > evidence.posterior(prior, 0.0, 0.0).error(21)


@each_code
def test_a_part_without_blocks(name):
    reader = reader_of(name, 2, 2, 0)
    (nothing,) = reader.read_all(np.array([7]))
    assert nothing.posterior(0.0, 0.0, 0.0) is NOTHING_KNOWN and nothing.best == 0


def test_blocks_that_deviate_alike_count_less():
    """Pairs of blocks of a print are half as much evidence as blocks that deviate each by itself."""
    blocks, context, sure = reader_of("contrast2", 12, 12, 9).blocks, code_and_columns("contrast2"), {1: 0.0, 2: 0.0}
    for alike, seed in product(sure, range(4)):
        row, column = (blocks.place // (CELL_HEIGHT, BLOCK_WIDTH * alike)).astype(int).T
        off = np.random.default_rng(seed).normal(0, 0.03, (row.max() + 1, column.max() + 1))[row, column]
        reader = CodeReader(replace(blocks, contrast=blocks.contrast + off), *context)
        assert reader.learn()
        evidence = reader.read(all_of(reader))
        assert evidence.best == 9
        second, best = np.sort(evidence.likelihood)[-2:]
        sure[alike] += best - second
    assert 0.3 * sure[1] < sure[2] < 0.7 * sure[1]


@each_code
def test_parts_are_read_by_themselves(name):
    roots = np.repeat([0, 6, 9], [6, 3, 3])
    reader = reader_of(name, 9, 12, np.where(roots == 6, 12, 20), root=roots)
    together = reader.read_all(np.array([0, 6, 9]))
    assert [part.best for part in together] == [20, 12, 20]
    for root, part in zip((0, 6, 9), together, strict=True):
        alone = reader.read(np.flatnonzero(reader.blocks.root == root))
        np.testing.assert_array_equal(part.likelihood, alone.likelihood)


@each_code
@pytest.mark.parametrize("gamma", [1.0, 2.6])
def test_the_response_is_learnt(name, gamma):
    reader = reader_of(name, 12, 12, 20, gamma=gamma)
    assert reader.learn()
    np.testing.assert_array_equal(reader.levels_now, reader.levels[GAMMAS.index(gamma)])


@each_code
def test_what_was_learnt_counts_for_the_largest_parts_too(name):
    reader = reader_of(name, *ENOUGH[name], 20, factor=-0.2)
    which = all_of(reader)
    before = reader.read(which)
    assert reader.learn()
    after = reader.read(which)
    assert after.posterior(0.0, 0.0, 0.0).error(20) < before.posterior(0.0, 0.0, 0.0).error(20)


@each_code
def test_a_frame_without_the_code(name):
    """Plain contrasts with noise, and contrasts of every block's own."""
    for noise in (0.0, 0.01, 0.05):
        reader = reader_of(name, 12, 12, 20)
        reader.blocks.contrast[:] = np.random.default_rng(2).normal(-0.3, noise, len(reader.blocks.order))
        assert reader.learn() in ((False,) if noise < 0.05 else (False, None)), noise
        found = posterior(reader)
        assert found.error(found.best) > 0.1, noise


OTHERS = {
    "reversed": lambda levels: levels[:, ::-1],
    "permuted": lambda levels: levels[:, np.random.default_rng(3).permutation(levels.shape[1])],
    "mirrored": lambda levels: levels[..., ::-1],
}


@pytest.mark.parametrize(("name", "other"), [*product(CODES, ["reversed", "permuted"]), ("contrast2", "mirrored")])
def test_another_sequence_is_not_the_code(name, other):
    """The code's own symbols, from the last cycle or cell to the first or in another order, on all of the frame."""
    reader = reader_of(name, 40, 12, 2)
    blocks, own = reader.blocks, reader.levels
    reader.levels = OTHERS[other](own)
    blocks.contrast[:] += reader.expected(all_of(reader), blocks.order + 2)
    reader.levels = own
    blocks.contrast[:] -= reader.expected(all_of(reader), blocks.order + 2)
    assert reader.learn() is False
    found = posterior(reader)
    assert found.error(found.best) > 0.1


def test_a_wider_surface_of_few_cycles_is_no_surer():
    """Of the first code: what is not known of the response is off alike all along a cycle."""
    errors = []
    for columns in (6, 24):
        found = posterior(reader_of("contrast", 3, columns, 21))
        errors.append(found.error(found.best))
    assert errors[0] > 1e-2 and errors[1] > 0.5 * errors[0]


@each_code
def test_what_was_learnt_is_passed_on(name):
    reader = reader_of(name, 12, 12, 20, gamma=1.0, factor=-0.2, shift_px=1.5)
    reader.learn()
    fresh = reader_of(name, 2, 4, 20, gamma=1.0, factor=-0.2)
    later = reader.again(CodeReader(fresh.blocks, fresh.code, code_and_columns(name)[1]))
    np.testing.assert_array_equal(later.levels_now, reader.levels_now)
    np.testing.assert_allclose(later.columns[:, 0] - fresh.columns[:, 0], reader.shift_px, atol=1e-4)
    known, learnt = (seen.read(all_of(seen)).posterior(0.0, 0.0, 0.0).error(20) for seen in (later, fresh))
    assert known < learnt


@each_code
def test_a_surfaces_own_factor_is_taken_off(name):
    """A plane that changes by a quarter over the part, and of which ambient light takes a share where it is darker."""
    reader = reader_of(name, 12, 12, 20)
    blocks = reader.blocks
    blocks.brightness[:] = np.linspace(40, 160, len(blocks.order))
    middle, terms = blocks.place.mean(axis=0), np.array([-0.3, 1.2, -0.8, -0.4])
    blocks.contrast[:] += Factor.shape(blocks.place, blocks.brightness, middle, 100.0) @ terms
    reader.learn()
    evidence = reader.read(all_of(reader))
    found = evidence.posterior(0.0, 0.0, 0.0)
    assert found.best == 20 and found.error(20) < 1e-6
    seen = reader.fit(all_of(reader), 20)[0].at(blocks.place, blocks.brightness)
    np.testing.assert_allclose(seen, Factor.shape(blocks.place, blocks.brightness, middle, 100.0) @ terms, atol=0.01)


@each_code
def test_what_is_off_locally_is_flattened(name):
    """A corner whose contrast is a tenth lower is as high as the rest, and the code stays."""
    corner = (np.arange(20 * 48) % 48 < 20) & (np.arange(20 * 48) // 48 < 10)
    reader = reader_of(name, 20, 24, 12, factor=np.where(corner, -0.1, 0.0), noise=0.004)
    flat = reader.flattened(all_of(reader), 12, (17, 5))
    departs = flat - reader.expected(all_of(reader), reader.blocks.order + 12)
    step = abs(departs[corner].mean() - departs[~corner].mean())
    assert step < 0.03
    assert np.std(departs) < 0.02


@each_code
@pytest.mark.parametrize(("low", "high"), [(-np.pi, 0.0), (-np.pi, -0.3), (-0.3, np.pi)])
def test_cut_cycles_show_more_of_one_neighbour(name, low, high):
    """By how much more: averaged over what is seen of each cycle, under a linear response, to about a third."""
    reader = reader_of(name, 40, 8, 2)
    reader.levels = reader.levels[[GAMMAS.index(1.0)] * len(GAMMAS)]
    which, order = all_of(reader), reader.blocks.order + 2

    def mean_over(low, high):
        phase = np.linspace(low, high, 401)
        weight = (1 - (phase / np.pi) ** 2) ** 2
        along = column_at(reader.columns, order)[:, None]
        seen = reader.code.modulation(order[:, None] + phase / (2 * np.pi), along) @ weight / weight.sum()
        return np.log(seen / (1 - seen)), weight @ phase / weight.sum() / (2 * np.pi)

    def expected():
        return reader.expected(which, order)

    part, off = mean_over(low, high)
    before = expected()
    reader.blocks.off[:] = off
    more, true = expected() - before, part - mean_over(-np.pi, np.pi)[0]
    assert np.std(true) > 0.009
    assert np.sqrt(np.mean((more - true) ** 2)) < 0.35 * np.std(true)


@each_code
def test_the_offsets_that_the_pattern_leaves(name):
    """44 cycles and one that begins: six rows lack 0 to 39, and a stray outside does not matter."""
    reader = reader_of(name, 6, 12, 0)
    which = all_of(reader)
    np.testing.assert_array_equal(reader.offsets(which), np.arange(40))
    reader.blocks.order[:3] = -30
    np.testing.assert_array_equal(reader.offsets(which), np.arange(40))
    assert len(reader.offsets(which[:0])) == 0
    inside = reader.has(which[-4:], np.array([-1, 0, 44, 45]))
    np.testing.assert_array_equal(inside, [False, True, True, False])


@pytest.mark.parametrize("shift_px", [-2.0, -0.7, 0.0, 1.3, 4.0])
def test_a_shift_of_less_than_half_a_cell(shift_px):
    """Of 8.7 px; a quarter of it is too far to be believed."""
    reader = reader_of("contrast2", 10, 12, 20, shift_px=shift_px)
    places = reader.columns[:, 0].copy()
    assert reader.learn() or reader.is_far
    assert reader.shift_px == pytest.approx(shift_px, abs=0.25)
    assert reader.is_far == (abs(shift_px) > CELL_PX / 4)
    moved = 0.0 if reader.is_far else reader.shift_px
    np.testing.assert_allclose(reader.columns[:, 0] - places, moved, atol=1e-4)
    assert reader.is_far or reader.read(all_of(reader)).best == 20


@pytest.mark.parametrize("shift_px", [-40.0, -8.0, 16.0, 60.0])
@pytest.mark.parametrize("gamma", [1.0, 2.3])
def test_a_shift_anywhere(shift_px, gamma):
    """Whatever the response is taken to be by what is read where the code is not."""
    reader = reader_of("contrast2", 10, 12, 20, shift_px=shift_px, gamma=gamma)
    assert not reader.learn()
    assert reader.shift_anywhere() == pytest.approx(shift_px, abs=0.6)


def test_no_shift_of_what_shows_no_code():
    reader = reader_of("contrast2", 10, 12, 20)
    reader.blocks.contrast[:] = np.random.default_rng(0).normal(0, 0.05, len(reader.blocks.order))
    assert reader.shift_anywhere() is None


def test_no_shift_where_two_are_alike():
    """Of all blocks only those are seen whose symbols are the same at both places."""
    reader, other = (reader_of("contrast2", 24, 24, 10, shift_px=shift_px, noise=0.0) for shift_px in (16.0, 40.0))
    alike = np.abs(reader.blocks.contrast - other.blocks.contrast) < 0.01
    names = ("root", "order", "place", "contrast", "variance", "brightness", "off")
    seen = replace(reader.blocks, **{name: getattr(reader.blocks, name)[alike] for name in names})
    assert reader.shift_anywhere() == pytest.approx(16.0, abs=0.5)
    assert CodeReader(seen, reader.code, code_and_columns("contrast2")[1]).shift_anywhere() is None


def test_the_first_code_lies_nowhere():
    reader = reader_of("contrast", 10, 12, 20)
    reader.learn()
    assert reader.shift_px == 0.0 and reader.shift_anywhere() is None and not reader.is_far


@each_code
def test_a_frame_without_blocks(name):
    code, columns = code_and_columns(name)
    none, whole = np.zeros(0), np.zeros(0, np.int64)
    reader = CodeReader(Blocks(whole, whole, np.zeros((0, 2)), *[none] * 4, whole, whole, none, none), code, columns)
    assert not reader.learn() and reader.shift_anywhere() is None
