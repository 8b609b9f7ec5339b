"""Range images as triangle meshes, cut at depth steps."""

import numpy as np
import pytest

from pipeline import Decoder
from pipeline.output.surface_mesh import frame_mesh, surface_mesh
from pipeline.simulation import TYPICAL_CROSSTALK, simulate_frame, simulated_rig

pytestmark = pytest.mark.usefixtures("cpu")


def sheet(depth, pitch_mm=0.5):
    """Return points of a sheet (H, W), a pitch apart, at some depth."""
    y, x = np.indices(depth.shape, np.float32) * np.float32(pitch_mm)
    return np.stack([x, y, depth], axis=-1)


def test_a_whole_sheet_has_two_triangles_to_four_pixels():
    depth = np.full((6, 9), 400, np.float32)
    everywhere = np.ones(depth.shape, bool)
    mesh = surface_mesh(depth, everywhere, sheet(depth), {"sigma_mm": np.ones(54, np.float32)})
    assert mesh.unit == "mm" and len(mesh.vertices) == 54 and len(mesh.faces) == 2 * 5 * 8
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(5 * 0.5 * 8 * 0.5, rel=1e-6)


@pytest.mark.parametrize(("rise_mm", "joined"), [(4.9, True), (5.1, False)])
def test_a_surface_steeper_than_ten_is_a_step(rise_mm, joined):
    depth = np.where(np.arange(8) < 4, 400, 400 + rise_mm) * np.ones((6, 1))
    depth = depth.astype(np.float32)
    mesh = surface_mesh(depth, np.ones(depth.shape, bool), sheet(depth), {})
    columns = mesh.vertices[mesh.faces][..., 0] / 0.5
    across = (columns.min(axis=1) <= 3) & (columns.max(axis=1) >= 4)
    assert across.any() == joined


def test_without_points_a_step_is_a_radian():
    phase = np.where(np.arange(8) < 4, 0.0, 1.2) * np.ones((6, 1))
    mesh = surface_mesh(phase.astype(np.float32), np.ones(phase.shape, bool), None, {})
    assert mesh.unit == "rad" and mesh.vertices[:, 0].max() == 7
    assert len(mesh.faces) == 2 * 5 * 6


def test_pixels_without_a_range_are_left_out():
    depth = np.full((4, 4), 400, np.float32)
    mask = np.ones(depth.shape, bool)
    mask[1, 1] = False
    points = sheet(depth)
    points[1, 1] = np.nan
    assert len(surface_mesh(depth, mask, points, {}).vertices) == 15
    assert len(surface_mesh(depth, np.zeros_like(mask), points, {}).vertices) == 0


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_frame_takes_its_standard_deviations_along(calibrated):
    rig = simulated_rig((128, 96), period_px=2 * 768 / 44)
    known = rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)}) if calibrated else None
    frame = Decoder(calibration=known, arch="cpu").decode(simulate_frame(rig).image)
    mesh = frame_mesh(frame)
    assert len(mesh.vertices) == frame.mask.sum()
    assert mesh.unit == ("mm" if calibrated else "rad")
    np.testing.assert_array_equal(mesh.properties["modulation"], frame.modulation[frame.mask])
    assert ("sigma_mm" in mesh.properties) == calibrated and "sigma_rad" in mesh.properties
