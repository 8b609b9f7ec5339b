"""Where the orders of regions begin: closed forms."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import join, orders, written

from tikernels import ProjectorGeometry, ShapeError
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.unwrapping.patches import MIN_REGION_PX


def test_the_reliable_patch_nearest_the_centre_has_order_zero(arch):
    """The cell at the centre is dark: the next one is the start, whose first pixel keeps its wrapped phase."""
    phase = reference.wrapped(reference.ramp(96, 80))
    quality = np.ones(phase.shape, np.float32)
    for dark, start in (((0, 0), (48, 40)), ((48, 40), (48, 32))):
        lit = quality.copy()
        lit[dark[0] : dark[0] + 16, dark[1] : dark[1] + 8] = 0.1
        patches, rates = join(phase, lit)
        order = orders(written(patches, phase, rates)[0], phase)
        assert order[start] == 0


def test_regions_are_numbered_by_their_size(arch):
    """Three surfaces with gaps between them; a fourth is too small to be one."""
    true = reference.ramp(64, 100)
    phase = reference.wrapped(true)
    phase[:, 20:24] = phase[:, 70:74] = phase[:, 96] = NO_PHASE
    patches, rates = join(phase)
    unwrapped, mask, region = written(patches, phase, rates)
    assert (region[:, 24:70] == 1).all() and (region[:, 74:96] == 2).all() and (region[:, :20] == 3).all()
    assert 64 * 3 > MIN_REGION_PX and (region[:, 97:] == 4).all()
    np.testing.assert_array_equal(mask != 0, region > 0)
    for number in range(1, 5):
        assert np.ptp((unwrapped - true)[region == number]) < 1e-4  # rad, float32 of 33


@pytest.mark.parametrize("depth_mm", [700.0, 950.0])
def test_a_plane_at_a_depth_gets_its_absolute_orders(arch, depth_mm):
    """A plane that faces camera and projector, side by side: the phase is where each ray meets it."""
    shape, focal = (64, 80), 700.0
    rays = np.stack(np.meshgrid(*[(np.arange(n) - n / 2) / 400 for n in shape[::-1]]), axis=-1).astype(np.float32)
    projector = ProjectorGeometry(np.eye(3), np.array([0.0, 90.0, 0.0]), focal, 380.0, np.zeros(5), 14.0, 1)
    row = focal * (depth_mm * rays[..., 1] + 90.0) / depth_mm + 380.0
    true = 2 * np.pi * row / 14.0
    phase = reference.wrapped(true)
    patches, rates = join(phase)
    patches.place(phase, rays, projector, depth_mm + 5.0)  # half a cycle is 60 mm away
    unwrapped, _, _ = written(patches, phase, rates)
    np.testing.assert_allclose(unwrapped, true, atol=1e-3)  # rad, float32 of 210
    with pytest.raises(ShapeError, match="rays has shape"):
        patches.place(phase, rays[:-1], projector, depth_mm)
