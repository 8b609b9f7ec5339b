"""Standard deviations of points: how far a standard deviation of the phase really moves them."""

import numpy as np
import pytest
import reference

from pipeline.simulation import simulated_rig
from tikernels import ShapeError, runtime, triangulate
from tikernels.depth.point_uncertainty import point_sigma

SHAPE = (41, 67)


def case(stripes="horizontal"):
    """Return phase, points, rays and projector of a plane at 900 mm."""
    made = simulated_rig(SHAPE[::-1], stripes=stripes, projector_distortion=(-0.1, 0.05, 0.001, -0.002, 0.01))
    rays, projector = made.geometry().camera.rays(), made.geometry().for_triangulation()
    points = np.concatenate([rays, np.ones((*SHAPE, 1))], axis=-1) * 900
    phase = (2 * np.pi / projector.period_px * reference.projector_px(points, projector)).astype(np.float32)
    return phase, rays, projector


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_the_sigma_of_points_is_how_far_a_sigma_of_phase_moves_them(arch, stripes):
    phase, rays, projector = case(stripes)
    phase[3, 4] = np.nan
    sigma = np.full(SHAPE, 0.02, np.float32)
    found = triangulate(phase, rays, projector)
    out = point_sigma(phase, sigma, found, rays, projector)
    moved = reference.triangulate(phase + sigma, rays, projector) - reference.triangulate(phase, rays, projector)
    # Two rounded depths of 900 mm, 0.06 um each, make a difference of some 0.14 mm.
    np.testing.assert_allclose(runtime.to_host(out), np.linalg.norm(moved, axis=-1), rtol=0.02)
    assert np.isnan(runtime.to_host(out)[3, 4])


def test_menu(menu):
    phase, rays, projector = case()
    points, sigma = triangulate(phase, rays, projector), np.full(SHAPE, 0.02, np.float32)

    def measure(out=None, **inputs):
        return (
            runtime.to_host(point_sigma(**inputs, projector=projector, out=out))
            if out is None
            else point_sigma(**inputs, projector=projector, out=out)
        )

    menu(measure, np.empty(SHAPE, np.float32), phase=phase, phase_sigma=sigma, points=points, rays=rays)


def test_another_size_is_refused(arch):
    phase, rays, projector = case()
    points = triangulate(phase, rays, projector)
    with pytest.raises(ShapeError, match="phase_sigma has shape"):
        point_sigma(phase, np.zeros((3, 3), np.float32), points, rays, projector)
