"""Phases of places whose modulation is not the usual one, against the twin and a closed form."""

import numpy as np
import pytest
import reference

import tikernels
from tikernels.order_evidence import correct_by_modulation, follow_phase
from tikernels.order_evidence.modulation_correction import NODE_PX, TABLED, CodeRipples, measure_bends
from tikernels.phase.equalization import modulation_tables

EDGES = np.linspace(-np.pi, np.pi, 257)
RESPONSE = (0.2 * np.sin(3 * EDGES) + 0.03 * np.sin(6 * EDGES)).astype(np.float32)


def nodes_of(shape):
    return np.zeros((shape[0] // NODE_PX + 2, shape[1] // NODE_PX + 2, 4), np.float32)


def columns_at(nodes, shape, cycles):
    """Return the columns of all pixels: the terms bilinear between nodes, then the polynomial."""
    y, x = (np.arange(n) / NODE_PX for n in shape)
    row, column = y.astype(int), x.astype(int)
    down, right = (y - row)[:, None, None], (x - column)[:, None]
    upper, lower = (nodes[r][:, column] * (1 - right) + nodes[r][:, column + 1] * right for r in (row, row + 1))
    terms = upper * (1 - down) + lower * down
    return (terms * cycles[..., None] ** np.arange(4)).sum(axis=-1)


def test_correction_as_the_twin(arch):
    """In one of two regions, of a code of five places along the stripe whose columns change with place and order."""
    rng = np.random.default_rng(5)
    shape = (2 * NODE_PX + 7, NODE_PX + 13)
    cycles = rng.uniform(-0.5, 11.5, shape)
    table = rng.uniform(-0.16, 0.16, (11 * TABLED + 1, 5, 3)).astype(np.float32)
    shares = np.array([0.9, 0.05, -0.1], np.float32)
    nodes = nodes_of(shape)
    nodes[:] = 0.3 * np.arange(nodes.shape[0])[:, None, None] + 0.2 * np.arange(nodes.shape[1])[:, None]
    nodes *= np.array([1, 0.05, 1e-3, 1e-4], np.float32)
    ripples = CodeRipples(table, modulation_tables(RESPONSE), shares, nodes)
    region = np.ones(shape, np.int32)
    region[:, 35:] = 2
    region[0] = 0
    phase, unwrapped = rng.uniform(-np.pi, np.pi, shape).astype(np.float32), (2 * np.pi * cycles).astype(np.float32)
    corrected = phase.copy()
    correct_by_modulation(region, unwrapped, np.array([False, True, False]), ripples, out=corrected)
    along = columns_at(nodes.astype(float), shape, cycles)
    expected = reference.correct_by_modulation(cycles, table, TABLED, along, ripples.within, shares)
    np.testing.assert_array_equal(corrected[region != 1], phase[region != 1])
    # But beside the border of two places, which float32 may see elsewhere.
    sure = (region == 1) & (np.abs(np.mod(5 * along + 0.5, 1) - 0.5) > 1e-3)
    assert sure.sum() > 0.97 * (region == 1).sum()
    np.testing.assert_allclose((corrected - phase)[sure], expected[sure], atol=1e-4)


def test_bends_as_the_twin(arch):
    """Of every sixteenth column and every fourth row, where a pixel and those half a cycle away lie in one region."""
    rng = np.random.default_rng(7)
    shape, half, most = (2 * NODE_PX + 7, 2 * NODE_PX + 13), 5, 0.3
    y, x = np.indices(shape)
    cycles = 0.5 + (y + 0.1 * x) / 12
    nodes = nodes_of(shape)
    nodes[:] = 0.3 * np.arange(nodes.shape[0])[:, None, None] + 0.2 * np.arange(nodes.shape[1])[:, None]
    nodes *= np.array([1, 0.05, 1e-3, 1e-4], np.float32)
    table = rng.uniform(-0.16, 0.16, (11 * TABLED + 1, 5, 3)).astype(np.float32)
    ripples = CodeRipples(table, modulation_tables(RESPONSE), np.zeros(3, np.float32), nodes)
    region = 1 + (x > 40).astype(np.int32) + (y > 50)
    unwrapped = (2 * np.pi * cycles).astype(np.float32)
    phase = np.angle(np.exp(1j * (unwrapped + rng.normal(0, 0.1, shape)))).astype(np.float32)
    found = measure_bends(phase, unwrapped, region, np.array([False, True, False, True]), ripples, half, most)
    along = columns_at(nodes.astype(float), shape, cycles)
    expected = [reference.correct_by_modulation(cycles, table, TABLED, along, ripples.within, one) for one in np.eye(3)]
    absolute = 2 * np.pi * cycles + reference.wrapped(phase - 2 * np.pi * cycles)

    def bend(values):
        return values[: -2 * half] - 2 * values[half:-half] + values[2 * half :]

    seen = np.stack([np.ones_like(bend(absolute)), bend(absolute) + bend(expected[0]), *map(bend, expected)])
    middle, above, below = region[half:-half], region[: -2 * half], region[2 * half :]
    counts = (middle == above) & (middle == below) & (middle % 2 == 1) & (np.abs(seen[1]) < most)
    counts &= (x[half:-half] % 16 == 0) & ((x[half:-half] // 16 + y[half:-half]) % 4 == 0)
    assert 20 < counts.sum() < 0.9 * counts.size / 64
    np.testing.assert_allclose(found, seen[:, counts] @ seen[:, counts].T, rtol=1e-3, atol=1e-3)


def test_tables_undo_a_square_response():
    """The phase of cycles whose modulation departs by 16 % comes back to 8 mrad from what is 25 mrad without."""
    phase = np.linspace(-np.pi, np.pi, 4096, endpoint=False)
    shifts = np.array([-1, 0, 1]) * 2 * np.pi / 3

    def seen(modulation):
        light = (0.5 + modulation * np.cos(phase[:, None] + shifts)) ** 2
        return np.angle(light @ np.exp(-1j * shifts))

    usual = 0.43
    bare = np.unwrap(seen(usual))
    table = np.interp(EDGES, bare, phase - bare, period=2 * np.pi).astype(np.float32)
    for modulation in (0.36, 0.5):
        measured = seen(modulation)
        corrected = measured + np.interp(measured, EDGES, table)
        ripples = np.zeros((2 * TABLED + 1, 1, 3))
        ripples[..., 0] = modulation / usual - 1
        cycles = reference.wrapped(corrected) / (2 * np.pi) + 1
        better = corrected + reference.correct_by_modulation(
            cycles, ripples, TABLED, 0 * cycles, modulation_tables(table), np.array([1.0, 0, 0])
        )
        before, after = (np.abs(reference.wrapped(p - phase)).max() for p in (corrected, better))
        assert before > 0.025
        assert after < 0.008


def test_a_ramp_of_ripples_is_interpolated(arch):
    """Of 0.1 a cycle from the middle of the first cycle on, 2 rad at a share of 2: n cycles get 0.2 n, and that is all.

    Before the first cycle's middle it stays.
    """
    cycles = np.random.default_rng(1).uniform(-0.5, 10, (20, 40))
    unwrapped, phase = (2 * np.pi * cycles).astype(np.float32), np.zeros((20, 40), np.float32)
    table = np.zeros((10 * TABLED + 1, 1, 3), np.float32)
    table[:, 0, 1] = 0.1 * np.arange(10 * TABLED + 1) / TABLED
    ripples = CodeRipples(table, np.zeros((2, 257), np.float32), np.array([1, 2, 0], np.float32), nodes_of((20, 40)))
    correct_by_modulation(np.ones((20, 40), np.int32), unwrapped, np.array([False, True]), ripples, out=phase)
    np.testing.assert_allclose(phase, 0.2 * np.maximum(cycles, 0), atol=1e-5)


@pytest.mark.parametrize("width", [70, 64])
def test_the_unwrapped_phase_follows(arch, width):
    """Where there is one, by what smoothing has changed, and not where that is the other side of a step."""
    shape = (40, width)
    rng = np.random.default_rng(2)
    phase, unwrapped = (rng.uniform(-3, 3, shape).astype(np.float32) for _ in range(2))
    change = rng.uniform(-0.3, 0.3, shape).astype(np.float32)
    change[5, 7], change[6, 7] = 2.0, -1.7
    unwrapped[:, ::10] = np.nan
    followed = unwrapped.copy()
    follow_phase(phase + change, phase, out=followed)
    follows = np.abs(change) < np.pi / 2
    np.testing.assert_allclose(followed, np.where(follows, unwrapped + change, unwrapped), atol=1e-6)
    assert not follows[5, 7] and not follows[6, 7] and follows.mean() > 0.99


def test_what_is_refused(arch):
    region, known = np.ones((4, 5), np.int32), np.array([False, True])
    none = np.zeros((2, 257), np.float32), np.zeros(3, np.float32)
    ripples = CodeRipples(np.zeros((9, 1, 3), np.float32), *none, nodes_of((4, 5)))
    phase = np.zeros((4, 5), np.float32)
    read_only = phase.copy()
    read_only.setflags(write=False)
    for out in (phase[1:], read_only, phase.astype(np.float64)):
        with pytest.raises(tikernels.ShapeError):
            correct_by_modulation(region, phase.copy(), known, ripples, out=out)
        with pytest.raises(tikernels.ShapeError):
            follow_phase(phase.copy(), phase.copy(), out=out)
    with pytest.raises(tikernels.ShapeError, match="region has shape"):
        correct_by_modulation(region[1:], phase.copy(), known, ripples, out=phase)
    with pytest.raises(tikernels.ShapeError, match="smoothed has shape"):
        follow_phase(phase[1:], phase, out=phase.copy())
