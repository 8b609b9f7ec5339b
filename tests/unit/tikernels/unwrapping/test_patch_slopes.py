"""Slopes of patches."""

import numpy as np
import reference
from support.wrapped_surfaces import join

from tikernels.unwrapping.patch_slopes import measure_slopes

SHAPE = (97, 131)


def test_slopes_of_a_bent_plane(arch):
    """Two planes that meet in a column: patches of either side have its slopes."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    true = 0.5 * y + np.where(x < 64, 0.02, -0.06) * (x - 64)
    phase = reference.wrapped(true).astype(np.float32)
    patches, _ = join(phase, np.ones(SHAPE, np.float32))
    along, across = measure_slopes(phase, patches.labels, patches.cell_table, patches.draft_bits, patches.count)
    graph = patches.graph()
    assert len(along) == patches.count
    large, left = graph.pixels >= 100, graph.first % SHAPE[1] < 64
    np.testing.assert_allclose(across[large], 0.5, rtol=0.02)
    np.testing.assert_allclose(along[large & left], 0.02, atol=0.002)
    np.testing.assert_allclose(along[large & ~left], -0.06, atol=0.004)


def test_patches_of_a_pixel_have_no_slope(arch):
    """Noise, whose patches are small."""
    phase = np.random.default_rng(0).uniform(-np.pi, np.pi, SHAPE).astype(np.float32)
    patches, _ = join(phase, np.ones(SHAPE, np.float32))
    slopes = measure_slopes(phase, patches.labels, patches.cell_table, patches.draft_bits, patches.count)
    assert np.isfinite(slopes).all()
    np.testing.assert_allclose(slopes[:, patches.graph().pixels == 1], 0, atol=1e-4)
