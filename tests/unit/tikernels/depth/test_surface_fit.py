"""Surfaces fitted around every pixel, in windows as wide as they bend."""

import numpy as np
import pytest
import reference
from support.linked_pixels import all_linked

from pipeline.output.range_surface import links_within
from tikernels.depth import surface_fit
from tikernels.depth.step_cutting import DOWN
from tikernels.depth.surface_fit import fit_surface

SHAPE = (40, 44)


def noisy(depth, sigma_mm, seed=1):
    """Return depths with noise, and their standard deviation, mm."""
    noise = np.random.default_rng(seed).normal(0, sigma_mm, depth.shape)
    return (depth + noise).astype(np.float32), np.full(depth.shape, sigma_mm, np.float32)


def test_as_the_twin(arch):
    y, x = np.indices(SHAPE)
    depth, sigma = noisy(800 + 0.002 * (x - 20.0) ** 2 + np.where(x > 30, 3.0, 0.0), 0.1)
    sigma *= (1 + 0.5 * np.sin(y)).astype(np.float32)
    links = all_linked(SHAPE)
    links[:, 30] &= DOWN
    mask = np.ones(SHAPE, bool)
    fitted = fit_surface(depth, sigma, mask, links)
    checked = 0
    for place in np.random.default_rng(2).integers(0, SHAPE, (60, 2)):
        at = (int(place[0]), int(place[1]))
        level = float(fitted.level[at])
        if level != round(level) or level == 0:
            continue
        value, down, right, variance = reference.fit_quadric(depth, sigma, mask, links, at, 2 ** (int(level) - 1))
        assert fitted.depth[at] == pytest.approx(value, abs=5e-4)
        np.testing.assert_allclose(fitted.slope[at], (down, right), atol=2e-4)
        assert fitted.sigma[at] == pytest.approx(min(np.sqrt(variance), sigma[at]), rel=1e-3)
        checked += 1
    assert checked > 20


@pytest.mark.parametrize(("bend_mm", "levels"), [(0.0, {3}), (0.02, {0, 1})])
def test_the_window_is_the_twins(arch, bend_mm, levels):
    """A surface that is flat, and one with waves of 13 px and twenty standard deviations, alike everywhere."""
    depth, sigma = noisy(800 + bend_mm * np.sin(np.indices(SHAPE)[1] / 2), 1e-3)
    fitted = fit_surface(depth, sigma, np.ones(SHAPE, bool), all_linked(SHAPE))
    here = (depth, sigma, np.ones(SHAPE), all_linked(SHAPE))
    twins = [reference.choose_window(*here, (20, column)) for column in range(15, 28)]
    assert np.median(twins) in levels
    assert np.median(fitted.level[15:25, 15:28]) == np.median(twins)


def test_a_flat_surface_loses_most_of_its_noise(arch):
    """Independent noise of 0.1 mm: 49 samples leave 0.29 of it inside."""
    depth, sigma = noisy(np.full(SHAPE, 800.0), 0.1)
    fitted = fit_surface(depth, sigma, np.ones(SHAPE, bool), all_linked(SHAPE))
    assert np.std(fitted.depth[12:-12, 12:-12] - 800) < 0.35 * 0.1


def test_at_its_end_a_surface_is_a_plane_unless_its_bend_shows(arch):
    """The slopes of what is flat err half as much there; what is bent keeps its bend."""
    columns = np.indices(SHAPE)[1] - (SHAPE[1] - 1.0)
    errors = []
    for bend_mm in (0.0, 0.1):
        depth, sigma = noisy(800 + 0.3 * columns + bend_mm / 2 * columns**2, 0.05)
        # Sigma is often wider than what neighbours differ by.
        fitted = fit_surface(depth, 2 * sigma, np.ones(SHAPE, bool), all_linked(SHAPE))
        wrong = fitted.slope[..., 1] - (0.3 + bend_mm * columns)
        assert abs(wrong[:, -1].mean()) < 0.01
        errors.append(wrong[:, -1].std())
    assert errors[0] < 0.5 * errors[1]


def test_what_is_flattened_is_within_noise(arch):
    """Waves 8 px long, ten standard deviations high, lose 1.5 of them at most; a mean over 7 px would leave one."""
    x = np.indices(SHAPE)[1]
    waves = 0.1 * np.sin(2 * np.pi * x / 8)
    depth, sigma = noisy(800 + waves, 0.01)
    fitted = fit_surface(depth, sigma, np.ones(SHAPE, bool), all_linked(SHAPE))
    inside = np.s_[8:-8, 8:-8]
    kept = ((fitted.depth - 800) * waves)[inside].sum() / (waves**2)[inside].sum()
    assert kept > 0.85


def test_nothing_comes_over_a_step(arch):
    x = np.indices(SHAPE)[1]
    depth, sigma = noisy(np.where(x < 20, 800.0, 805.0), 0.05)
    links = all_linked(SHAPE)
    links[:, 19] &= DOWN
    fitted = fit_surface(depth, sigma, np.ones(SHAPE, bool), links)
    assert np.abs(fitted.depth - np.where(x < 20, 800, 805)).max() < 4 * 0.05
    assert np.abs(fitted.slope).max() < 0.1


def test_a_large_picture_is_fitted_in_pieces(arch, monkeypatch):
    y, x = np.indices(SHAPE)
    depth, sigma = noisy(800 + 0.01 * (x - 20.0) ** 2 + 0.3 * np.sin(y / 3), 0.1)
    mask = np.random.default_rng(3).random(SHAPE) > 0.02
    links = links_within(all_linked(SHAPE), mask)
    whole = fit_surface(depth, sigma, mask, links)
    monkeypatch.setattr(surface_fit, "_ROWS", 9)
    for name, value in fit_surface(depth, sigma, mask, links)._asdict().items():
        np.testing.assert_array_equal(value, getattr(whole, name), err_msg=name)


def test_pixels_off_the_mask_stay_as_they_are(arch):
    depth, sigma = noisy(np.full((9, 9), 800.0), 0.1)
    mask = np.zeros((9, 9), bool)
    fitted = fit_surface(depth, sigma, mask, np.zeros((9, 9), np.uint8))
    np.testing.assert_array_equal(fitted.depth, depth)
    assert not fitted.slope.any() and not fitted.level.any() and not fitted.sigma.any()


def test_menu(menu):
    depth, sigma = noisy(np.full((9, 11), 800.0), 0.1)

    def fit(**inputs):
        return fit_surface(**inputs).depth

    menu(fit, depth=depth, sigma=sigma, mask=np.ones((9, 11), bool), links=all_linked((9, 11)))
