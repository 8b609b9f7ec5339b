"""The kernels that read a pattern's code, against their twins."""

import numpy as np
import pytest
import reference

from pipeline.orders.coded_orders import modulation_corrections
from tikernels import runtime
from tikernels.order_evidence.contrast_reading import (
    CANDIDATES,
    SLOPE_REACH,
    SLOTS,
    TABLED,
    adopt_pixels_kernel,
    correct_by_modulation_kernel,
    join_parts_kernel,
    match_stretches_kernel,
    measure_contrast_kernel,
)
from tikernels.phase.equalization import modulation_tables
from tikernels.phase.smoothing import measure_rates_kernel, rates_buffer
from tikernels.phase.wrapped_phase import NO_PHASE, STEP_PHASE
from tikernels.unwrapping.unwrapper import Unwrapper


def joined(phase):
    """Return an unwrapper that has joined a wrapped phase, and the phase's rates."""
    quality = np.ones(phase.shape, np.float32)
    unwrapper, rates = Unwrapper(*phase.shape), rates_buffer(phase.shape[0])
    measure_rates_kernel(phase, quality, rates)
    unwrapper.join(phase, quality, rates)
    return unwrapper, rates


@pytest.mark.parametrize("shape", [(64, 96), (51, 43)])
def test_contrast_as_the_twin(arch, shape):
    rng = np.random.default_rng(3)
    phase = reference.wrapped(reference.ramp(*shape, 11.0, tilt=0.05)).astype(np.float32)
    phase[rng.random(shape) < 0.05] = NO_PHASE
    image = rng.integers(20, 255, (*shape, 3)).astype(np.uint8)
    modulation = rng.uniform(5, 60, shape).astype(np.float32)
    inverse = (np.eye(3) + 0.1 * rng.standard_normal((3, 3))).astype(np.float32)
    gains = rng.uniform(0.8, 1.2, (-(-shape[0] // 8), -(-shape[1] // 8), 3)).astype(np.float32)
    unwrapper, _ = joined(phase)
    sums = runtime.empty((unwrapper.patch_count, SLOTS, 4), np.float32)
    patches = (unwrapper.labels, unwrapper.firsts, unwrapper.draft_bits)
    measure_contrast_kernel(True)(image, inverse, gains, 8, phase, modulation, *patches, sums)
    sums, firsts = runtime.to_host(sums), runtime.to_host(unwrapper.firsts)
    expected = reference.measure_contrast(
        image, inverse, gains, 8, phase, modulation, runtime.to_host(unwrapper.labels), SLOTS
    )
    bits = unwrapper.draft_bits
    for draft, own in expected.items():
        patch = firsts[0, draft >> bits] + (draft & ((1 << bits) - 1))
        np.testing.assert_allclose(sums[patch], own, rtol=1e-4, atol=1e-2)
    assert (sums[..., 0] > 0).any(axis=1).sum() == len([own for own in expected.values() if own[:, 0].max() > 0])


@pytest.mark.parametrize("count", [1, 700])
def test_stretches_find_their_windows(arch, count):
    rng = np.random.default_rng(count)
    windows = rng.normal(0, 0.2, (90, 5)).astype(np.float32)
    stretches = (windows[rng.integers(90, size=count)] + rng.normal(0, 0.03, (count, 5))).astype(np.float32)
    matches = np.empty((count, 3), np.float32)
    match_stretches_kernel(stretches, windows, matches)
    departures = ((stretches[:, None].astype(np.float64) - windows) ** 2).sum(axis=-1)
    np.testing.assert_array_equal(matches[:, 0], departures.argmin(axis=1))
    np.testing.assert_allclose(matches[:, 1:], np.sort(departures, axis=1)[:, :2], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_parts_as_the_twin(arch, seed):
    """A grid of patches, whose halves prefer different offsets, with noise: the same parts as the sequential twin's."""
    rng = np.random.default_rng(seed)
    rows, columns = 9, 14
    number = np.arange(rows * columns).reshape(rows, columns)
    ends = np.concatenate(
        [
            np.stack([number[:-1].ravel(), number[1:].ravel()]),
            np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()]),
        ],
        axis=1,
    ).astype(np.int32)
    ends = np.ascontiguousarray(ends[:, rng.permutation(ends.shape[1])])
    # Sixteenths: sums of float32 are then exact in any order.
    evidence = np.round(16 * rng.uniform(4, 9, (number.size, CANDIDATES + 1))) / 16
    right = (number % columns >= columns // 2).ravel()
    evidence[~right, 1] /= 8
    evidence[right, 2] /= 8
    evidence[:, -1] = 1
    evidence = (np.round(16 * evidence) / 16).astype(np.float32)
    top = (number // columns).ravel()
    orders = np.stack([top, top + 1], axis=1).astype(np.int32)
    expected = reference.join_parts(ends, 4, 20.0, 0.5, orders, evidence)
    parents = np.zeros(number.size, np.int32)
    join_parts_kernel(ends, 4, 20.0, 0.5, orders.copy(), evidence.copy(), parents)
    np.testing.assert_array_equal(parents, expected)
    assert len(np.unique(parents)) > 1


def test_correction_as_the_twin(arch):
    rng = np.random.default_rng(5)
    phase = rng.uniform(0, 2 * np.pi * 11, (33, 70))
    edges = np.linspace(-np.pi, np.pi, 257)
    table = (0.2 * np.sin(3 * edges) + 0.03 * np.sin(6 * edges)).astype(np.float32)
    tables = modulation_tables(table)
    departures = rng.uniform(-0.16, 0.16, 12)
    region = np.ones(phase.shape, np.int32)
    region[:, 35:] = 2
    region[0] = 0
    wrapped, unwrapped = reference.wrapped(phase).astype(np.float32), phase.astype(np.float32)
    known = np.array([0, 1, 0], np.int32)
    place = np.arange(11 * TABLED + 1) / TABLED
    corrections = modulation_corrections(np.interp(place, np.arange(12), departures), tables)
    correct_by_modulation_kernel(region, known, corrections.astype(np.float32), wrapped, unwrapped)
    expected = reference.correct_by_modulation(phase, departures, tables, 0.0, SLOPE_REACH)
    expected = np.where(region == 1, expected, phase)
    # Between the table's places a line stands for 0.03 rad of the sixth harmonic: 1e-4 rad; and float32 of 70 rad.
    np.testing.assert_allclose(unwrapped, expected, atol=3e-4)
    np.testing.assert_allclose(wrapped - reference.wrapped(phase), expected - phase, atol=3e-4)


def test_tables_undo_a_square_response():
    """The phase of cycles whose modulation departs by 16 % comes back to 2 mrad from what is 30 mrad without."""
    phase = np.linspace(-np.pi, np.pi, 4096, endpoint=False)
    shifts = np.array([-1, 0, 1]) * 2 * np.pi / 3

    def seen(modulation):
        light = (0.5 + modulation * np.cos(phase[:, None] + shifts)) ** 2
        return np.angle(light @ np.exp(-1j * shifts))

    usual = 0.43
    edges = np.linspace(-np.pi, np.pi, 257)
    bare = np.unwrap(seen(usual))
    table = np.interp(edges, bare, phase - bare, period=2 * np.pi).astype(np.float32)
    for modulation in (0.36, 0.5):
        measured = seen(modulation)
        corrected = measured + np.interp(measured, edges, table)
        departures, tables = np.full(3, modulation / usual - 1), modulation_tables(table)
        absolute = reference.wrapped(corrected) + 2 * np.pi
        better = reference.correct_by_modulation(absolute, departures, tables, 0.0, SLOPE_REACH)
        before, after = (np.abs(reference.wrapped(p - phase)).max() for p in (corrected, better))
        assert before > 0.025
        assert after < 0.008


def test_pixels_at_a_step_go_to_the_surface_that_they_continue(arch):
    """Of a dropped column beside a step each pixel goes to its own side; what fits neither stays out."""
    true = np.ascontiguousarray(reference.ramp(48, 64, 12.0)).astype(np.float32)
    true[:, 32:] += 2.0
    raw = reference.wrapped(true).astype(np.float32)
    phase, unwrapped = raw.copy(), true.copy()
    region = np.where(np.arange(64) < 32, 1, 2) * np.ones((48, 1), np.int64)
    region = region.astype(np.int32)
    dropped = np.zeros(true.shape, bool)
    dropped[:, 31:33] = True
    mixed = np.zeros(true.shape, bool)
    mixed[::5, 31] = True
    raw[mixed] = reference.wrapped(true[mixed] + 1.0)
    phase[dropped], region[dropped], unwrapped[dropped] = STEP_PHASE, 0, np.nan
    mask = (~dropped).astype(np.uint8)
    rates = np.zeros((7, 5), np.float32)
    rates[-1, 1] = 2 * np.pi / 12
    ones = np.ones(true.shape, np.float32)
    adopted = runtime.empty((*true.shape, 2), np.float32)
    absolute = np.array([0, 1, 1], np.int32)
    steps = np.ones((3, 48 // 16 * 64 // 8), np.int32)
    adopt_pixels_kernel(steps, phase, raw, ones, rates, absolute, adopted, unwrapped, mask, region)
    np.testing.assert_array_equal(mask != 0, ~mixed)
    np.testing.assert_allclose(unwrapped[~mixed], true[~mixed], atol=1e-4)
    assert (region[:, :32][~mixed[:, :32]] == 1).all() and (region[:, 32:] == 2).all()
    assert np.abs(phase[~mixed]).max() <= np.pi + 1e-5
