"""Equalisation against the interpolated distribution, and what its constant does."""

import numpy as np
import pytest
import reference

import tikernels
from tikernels.phase.equalization import correction_table


def bent_ramp(amplitude: float = 0.2, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return a noisy phase bent by a third harmonic, and the true one: whole cycles, every phase as often."""
    true = reference.ramp(96, 113, 12.0, tilt=2 * np.pi / 113)
    noise = 0.01 * np.random.default_rng(seed).standard_normal(true.shape)
    return reference.wrapped(true + amplitude * np.sin(3 * true) + noise), true


@pytest.mark.parametrize("harmonics", [None, 3, 9])
@pytest.mark.parametrize("bins", [8, 100, 256])
def test_as_the_twin(arch, bins, harmonics):
    bent, _ = bent_ramp()
    mask = np.random.default_rng(2).random(bent.shape) > 0.1
    harmonics = harmonics if harmonics is None else min(harmonics, bins // 2 - 1)
    found = tikernels.equalize_phase(bent, mask, bins, harmonics=harmonics)
    expected = reference.equalize_phase(bent, mask, bins, harmonics)
    # A pixel that rounding puts into the next bin moves the table by 2 pi / 9,000; two may.
    assert np.abs(reference.wrapped_difference(found, expected)).max() < 1.5e-3


def test_a_third_harmonic_is_taken_out(arch):
    """0.2 rad of harmonic, 0.14 RMS, is what gamma 1.8 does; a tenth, 0.1 mm of depth, may stay."""
    bent, true = bent_ramp()
    found = tikernels.equalize_phase(bent, np.ones(bent.shape, bool))
    assert np.sqrt(np.mean(reference.wrapped_difference(bent, true) ** 2)) > 0.13
    assert np.sqrt(np.mean(reference.wrapped_difference(found, true) ** 2)) < 0.02


def test_an_even_distribution_stays(arch):
    """Thirteen thousand evenly spread phases: a bin is even to one count, 5e-4 rad, and interpolation adds the same."""
    even = np.linspace(-np.pi, np.pi, 101 * 131, endpoint=False, dtype=np.float32).reshape(101, 131)
    found = tikernels.equalize_phase(even, np.ones(even.shape, bool))
    assert np.abs(reference.wrapped_difference(found, even)).max() < 1e-3


def test_the_phase_does_not_shift_with_the_branch_cut(arch):
    """The mean correction is zero, so turning the cycle turns the result: two counts of 10,000 are 1.3e-3 rad."""
    bent, _ = bent_ramp()
    mask = np.ones(bent.shape, bool)
    found = tikernels.equalize_phase(bent, mask)
    assert abs(reference.wrapped_difference(found, bent).mean()) < 1e-3
    turned = tikernels.equalize_phase(reference.wrapped(bent + np.pi / 2), mask)
    np.testing.assert_allclose(reference.wrapped_difference(turned, found), np.pi / 2, atol=5e-3)


def test_low_harmonics_leave_the_pixel_grid_alone():
    """A fringe of exactly 12 px shows 12 phases only; with no limit each would be pulled by up to half a twelfth."""
    histogram = np.zeros(256, np.int64)
    np.add.at(histogram, ((np.arange(12) + 0.3) / 12 * 256).astype(int), 1000)
    # 256 bins are no multiple of twelve phases, so the places of the counts are off by half a bin: 0.012 rad.
    assert np.abs(correction_table(histogram, harmonics=9)).max() < 0.025
    assert np.abs(correction_table(histogram)).max() > 0.2


def test_too_few_counts_change_nothing(arch):
    bent, _ = bent_ramp()
    mask = np.zeros(bent.shape, bool)
    np.testing.assert_array_equal(tikernels.equalize_phase(bent, mask), bent)
    mask[:10, :10] = True  # a hundred pixels in 256 bins are no distribution
    np.testing.assert_array_equal(tikernels.equalize_phase(bent, mask), bent)


def test_outside_the_mask_nothing_changes(arch):
    bent, _ = bent_ramp()
    mask = np.random.default_rng(3).random(bent.shape) > 0.3
    bent[~mask] = np.nan
    found = tikernels.equalize_phase(bent, mask)
    np.testing.assert_array_equal(found[~mask], bent[~mask])
    assert (np.abs(found[mask]) <= np.float32(np.pi) + 1e-6).all()


@pytest.mark.parametrize("shape", [(1, 4001), (4001, 1)])
def test_slim_images(arch, shape):
    true = np.linspace(-np.pi, np.pi, 4001).reshape(shape)
    found = tikernels.equalize_phase(reference.wrapped(true + 0.2 * np.sin(3 * true)), np.ones(shape, bool))
    # A bin, 0.025 rad, holds 16 of 4001 pixels, so its edge is known to a sixteenth of it.
    assert np.abs(reference.wrapped_difference(found, true)).max() < 0.01


def test_menu(menu):
    bent, _ = bent_ramp()
    menu(
        lambda wrapped_phase, mask, out=None: tikernels.equalize_phase(wrapped_phase, mask, 16, out=out),
        np.empty_like(bent),
        wrapped_phase=bent,
        mask=np.random.default_rng(4).random(bent.shape) > 0.2,
    )


def test_too_few_bins(arch):
    with pytest.raises(tikernels.ShapeError, match="bins is 7: take 8 or more"):
        tikernels.equalize_phase(np.zeros((4, 4), np.float32), np.ones((4, 4), bool), 7)
