"""Phase to points: closed form, lens distortion, and back through OpenCV's projection."""

import numpy as np
import pytest
import reference

import tikernels
from pipeline.simulation import simulated_rig

STRAIGHT = (0.0,) * 5
LENS = (-0.1, 0.05, 0.001, -0.002, 0.01)
RATIONAL = (12.1, 40.2, 0.001, -0.002, 3.5, 12.2, 41.5, 5.1)
TILTED = (0.3, -0.2, 0.001, 0.002, 0.1, 0.4, -0.1, 0.1, 0.02, -0.01, 0.01, 0.03, 0.08, -0.05)
LENSES = pytest.mark.parametrize("lens", [STRAIGHT, LENS, RATIONAL, TILTED])


def rig(stripes="horizontal", lens=STRAIGHT):
    """Return a small rig's rays and projector; a tilted one, so that no term of the rotation is zero."""
    made = simulated_rig(
        (73, 51), stripes=stripes, tilt_deg=3, camera_distortion=(0.05, -0.1, 0, 0, 0),
        projector_distortion=lens,
    )  # fmt: skip
    return made.geometry().camera.rays(), made.geometry().for_triangulation()


def bumpy_points(rays: np.ndarray) -> np.ndarray:
    """Return points on the rays at 880 to 900 mm."""
    depth = 880 + 20 * np.random.default_rng(1).random(rays.shape[:2])
    return np.concatenate([rays, np.ones((*depth.shape, 1))], axis=-1) * depth[..., None]


def phase_of(points: np.ndarray, projector) -> np.ndarray:
    return 2 * np.pi / projector.period_px * reference.projector_px(points, projector)


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
@LENSES
def test_as_the_twin(arch, stripes, lens):
    rays, projector = rig(stripes, lens)
    phase = phase_of(bumpy_points(rays), projector).astype(np.float32)
    found = tikernels.triangulate(phase, rays, projector)
    # A micrometre is what float32 and two turns leave of 900 mm; a hundredth of what the best phase gives.
    np.testing.assert_allclose(found, reference.triangulate(phase, rays, projector), atol=2e-3)


@LENSES
def test_there_and_back(arch, lens):
    """Points to phase and back: 2 um of 900 mm, a hundredth of the information limit."""
    rays, projector = rig(lens=lens)
    points = bumpy_points(rays)
    found = tikernels.triangulate(phase_of(points, projector).astype(np.float32), rays, projector)
    np.testing.assert_allclose(found, points, atol=2e-3)


def test_one_millimetre_is_a_seventh_of_a_radian(arch):
    """The rig's sensitivity, 0.138 rad a mm, which every bound in millimetres rests on."""
    projector = simulated_rig((65, 49)).geometry().for_triangulation()
    rays = np.zeros((1, 2, 2), np.float32)
    near = np.array([[[0, 0, 900.0], [0, 0, 901.0]]])
    phase = phase_of(near, projector)
    assert abs(phase[0, 1] - phase[0, 0]) == pytest.approx(0.138, abs=0.002)
    found = tikernels.triangulate(phase.astype(np.float32), rays, projector)
    assert found[0, 1, 2] - found[0, 0, 2] == pytest.approx(1, abs=2e-3)


def test_nothing_where_nothing_is_known(arch):
    rays, projector = rig()
    phase = phase_of(bumpy_points(rays), projector).astype(np.float32)
    phase[3, 4] = np.nan
    phase[5] = -1e4  # rows that the ray meets behind the camera only
    found = tikernels.triangulate(phase, rays, projector)
    expected = reference.triangulate(phase, rays, projector)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    assert np.isnan(found[3, 4]).all()
    assert np.isnan(tikernels.triangulate(np.full_like(phase, np.nan), rays, projector)).all()


def test_menu(menu):
    rays, projector = rig()
    phase = phase_of(bumpy_points(rays), projector).astype(np.float32)
    menu(
        lambda unwrapped_phase, rays, out=None: tikernels.triangulate(unwrapped_phase, rays, projector, out),
        np.empty((*phase.shape, 3), np.float32),
        unwrapped_phase=phase,
        rays=rays,
    )
