"""Places of surfaces next to what their matrices predict."""

from dataclasses import replace

import numpy as np
from support.colored_boards import MATRIX, PAINTS, surface_matrix

from tikernels.phase.surface_samples import SurfaceSamples, compare_samples

HARMONICS = np.arange(1, 5)
RNG = np.random.default_rng(5)
LIGHT = np.array([0.8, 0.12, 0.05, 0.02]) * np.exp(1j * np.outer([-2.1, 0.1, 2.0], HARMONICS))
MATRICES = np.stack([MATRIX, surface_matrix(PAINTS["orange"])])
AMBIENT = np.array([[4.0, 5.0, 6.0], [9.0, 3.0, 1.0]])
SIZE = 41


def channels(phase, contrast, matrix):
    """Return K p and its derivative by the phase, (3, S), in float64."""
    waves = LIGHT[:, :, None] * np.exp(1j * HARMONICS[:, None] * phase) * contrast ** HARMONICS[:, None] ** 2
    steep = 1j * HARMONICS[:, None] * waves
    return matrix @ (1 + waves.real.sum(axis=1)), matrix @ steep.real.sum(axis=1)


def places(noise=0.7):
    """Return places of both surfaces, their phases 0.05 rad off, and the true phases and brightness."""
    phase, brightness = RNG.uniform(-3.1, 3.1, (2, SIZE)), RNG.uniform(40, 120, (2, SIZE))
    contrast = RNG.uniform(0.9, 1.0, (2, SIZE))
    clean = [b * channels(p, c, m)[0] for b, p, c, m in zip(brightness, phase, contrast, MATRICES, strict=True)]
    seen = np.stack(clean) + AMBIENT[..., None] + noise * RNG.standard_normal((2, 3, SIZE))
    off = phase + 0.05 * RNG.standard_normal(phase.shape)
    arrays = (seen, RNG.uniform(0.5, 2.0, seen.shape), off, np.ones(phase.shape), contrast)
    return SurfaceSamples(*(np.asarray(part, np.float32) for part in arrays), np.ones(2), 0.1), phase, brightness


def test_phase_and_brightness_are_found(arch):
    samples, phase, brightness = places(noise=0.0)
    found = samples
    for _ in range(3):
        found = compare_samples(replace(samples, phase=found.phase), MATRICES, AMBIENT, LIGHT)
    np.testing.assert_allclose(found.phase, phase, atol=2e-4)
    np.testing.assert_allclose(found.brightness[:, 0], brightness, rtol=1e-4)
    assert np.abs(found.residual).max() < 1e-2


def test_what_is_left_and_its_derivatives(arch):
    """As the same in float64."""
    samples = places()[0]
    found = compare_samples(samples, MATRICES, AMBIENT, LIGHT)
    for surface, matrix in enumerate(MATRICES):
        weight = 1 / np.sqrt(samples.variance[surface].astype(np.float64))
        seen = (samples.light[surface] - AMBIENT[surface][:, None]) * weight
        contrast, phase = samples.contrast[surface].astype(np.float64), found.phase[surface].astype(np.float64)
        model, change = (weight * part for part in channels(phase, contrast, matrix))
        normal = np.cross(model, change, axis=0)
        normal /= np.linalg.norm(normal, axis=0)
        # By what changes with the brightness alone, and not with the phase.
        only = model - (model * change).sum(axis=0) / (change**2).sum(axis=0) * change
        brightness = (seen * only).sum(axis=0) / (model * only).sum(axis=0)
        swing = 0.1 * brightness * (normal * (model - weight * matrix.sum(axis=1)[:, None])).sum(axis=0)
        np.testing.assert_allclose(found.residual[surface, 0], (seen * normal).sum(axis=0), atol=2e-3)
        np.testing.assert_allclose(found.variance[surface, 0], 1 + swing**2, rtol=1e-3)
        np.testing.assert_allclose(found.brightness[surface, 0], brightness, rtol=1e-4)
        np.testing.assert_allclose(found.square[surface, 0], brightness**2 * (model**2).sum(axis=0), rtol=1e-3)
        np.testing.assert_allclose(found.across[surface], weight * normal, atol=1e-4)
        along = weight * only / ((model * only).sum(axis=0) * brightness)
        np.testing.assert_allclose(found.along[surface], along, atol=1e-5)
        np.testing.assert_allclose(matrix @ found.waves[surface], model / weight, atol=1e-4)
        left = contrast ** HARMONICS[:, None] ** 2
        turns = left * np.exp(1j * HARMONICS[:, None] * phase)
        np.testing.assert_allclose(found.turns[surface], np.concatenate([turns.real, turns.imag]), atol=1e-5)


def test_a_step_is_limited(cpu):
    """Places that begin far away do not go astray."""
    samples = places()[0]
    far = replace(samples, phase=samples.phase + np.float32(0.5))
    found = compare_samples(far, MATRICES, AMBIENT, LIGHT)
    assert np.abs(found.phase - far.phase).max() <= 0.2 + 1e-6
