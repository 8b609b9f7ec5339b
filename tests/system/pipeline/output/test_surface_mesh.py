"""Frames as triangle meshes: surfaces, and not pixels."""

import warnings
from dataclasses import asdict

import numpy as np
import pytest

from pipeline import Decoder
from pipeline.errors import SettingsError
from pipeline.output.mesh import FILLED, SMOOTHED
from pipeline.output.surface_mesh import MeshOptions, counted_mesh, frame_mesh, surface_mesh
from pipeline.simulation import TYPICAL_CROSSTALK, simulate_frame, simulated_rig

pytestmark = pytest.mark.usefixtures("cpu")
SHAPE = (40, 50)
AS_MEASURED = MeshOptions(smoothed=False)


def sheet(depth, pitch=1e-3):
    """Return points of a sheet (H, W) at some depth, mm, on rays that are a pitch apart."""
    y, x = np.indices(depth.shape, np.float32) * np.float32(pitch)
    return (np.stack([x, y, np.ones(depth.shape)], axis=-1) * depth[..., None]).astype(np.float32)


def meshed(depth, mask=None, sigma_mm=0.05, **more):
    """Return the mesh of a sheet whose noise is known."""
    mask = np.ones(depth.shape, bool) if mask is None else mask
    properties = {
        "sigma_mm": np.full(mask.sum(), sigma_mm, np.float32),
        "modulation": np.arange(mask.sum(), dtype="f4"),
    }
    points = sheet(depth.astype(np.float32))
    points[~mask] = np.nan
    return surface_mesh(points[..., 2], mask, points, properties, **more)[0]


def bust(calibrated):
    """Return what is decoded of a simulated frame."""
    truth = simulate_frame(simulated_rig((320, 240), code="contrast", period_px=2 * 768 / 44))
    known = truth.rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Decoder(calibration=known if calibrated else None, arch="cpu").decode(truth.image)


def test_a_whole_sheet_has_two_triangles_to_four_pixels():
    mesh = meshed(np.full(SHAPE, 800.0))
    assert mesh.unit == "mm" and len(mesh.vertices) == 40 * 50 and len(mesh.faces) == 2 * 39 * 49
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(39 * 0.8 * 49 * 0.8, rel=1e-4)
    np.testing.assert_allclose(mesh.normals, [[0, 0, -1]] * 2000, atol=1e-3)


@pytest.mark.parametrize(("rise_mm", "joined"), [(0.7, True), (1.6, False)])
def test_a_step_that_nothing_beside_it_explains_is_cut(rise_mm, joined):
    """Less than a pixel's width, 0.8 mm, and twice that."""
    depth = np.where(np.arange(50) < 25, 800, 800 + rise_mm) * np.ones((40, 1))
    mesh = meshed(depth, options=AS_MEASURED)
    across = np.ptp(mesh.vertices[mesh.faces][..., 2], axis=1) > 0.5
    assert across.any() == joined


def test_a_slope_as_steep_is_whole():
    mesh = meshed(800 + 1.6 * np.arange(50) * np.ones((40, 1)))
    assert len(mesh.faces) == 2 * 39 * 49


def test_regions_are_not_joined():
    region = np.where(np.arange(50) < 25, 1, 2).astype(np.int32) * np.ones((40, 1), np.int32)
    assert len(meshed(np.full(SHAPE, 800.0), region=region).faces) == 2 * 39 * 48


def test_without_points_a_step_is_a_radian():
    phase = np.where(np.arange(50) < 25, 0.0, 1.2) * np.ones((40, 1))
    sigma = {"sigma_rad": np.full(2000, 0.01, np.float32)}
    mesh, _ = surface_mesh(phase.astype(np.float32), np.ones(SHAPE, bool), None, sigma)
    assert mesh.unit == "rad" and mesh.vertices[:, 0].max() == 49
    assert len(mesh.faces) == 2 * 39 * 48
    np.testing.assert_allclose(mesh.normals, [[0, 0, -1]] * 2000, atol=1e-3)


def test_noise_is_smoothed_and_said_to_be():
    noise = np.random.default_rng(1).normal(0, 0.05, SHAPE)
    rough, smooth = (meshed(800 + noise, options=options) for options in (AS_MEASURED, MeshOptions()))
    assert np.std(smooth.vertices[:, 2]) < 0.5 * np.std(rough.vertices[:, 2])
    assert (smooth.flags & SMOOTHED != 0).mean() > 0.99 and not rough.flags.any()
    np.testing.assert_array_equal(smooth.properties["sigma_mm"], rough.properties["sigma_mm"])
    rays = [mesh.vertices[:, :2] / mesh.vertices[:, 2:] for mesh in (rough, smooth)]
    np.testing.assert_allclose(*rays, atol=1e-7)


def test_a_small_hole_is_filled_and_said_to_be():
    mask = np.ones(SHAPE, bool)
    mask[18:21, 20:24] = False
    mesh = meshed(800 + 0.02 * np.arange(50) * np.ones((40, 1)), mask)
    filled = mesh.flags & FILLED != 0
    assert filled.sum() == 12 and len(mesh.faces) == 2 * 39 * 49
    column = np.rint(mesh.vertices[filled, 0] / mesh.vertices[filled, 2] / 1e-3)
    np.testing.assert_allclose(mesh.vertices[filled, 2], 800 + 0.02 * column, atol=1e-3)
    assert np.isin(mesh.properties["modulation"][filled], mesh.properties["modulation"][~filled]).all()


def test_specks_and_teeth_are_left_out():
    mask = np.zeros(SHAPE, bool)
    mask[:, :30] = True
    mask[5:9, 40:44] = mask[20, 30] = True
    mesh = meshed(np.full(SHAPE, 800.0), mask)
    assert len(mesh.vertices) == 40 * 30 and mesh.vertices[:, 0].max() < 30 * 0.8


def test_nothing_is_an_empty_mesh():
    mesh = meshed(np.full(SHAPE, 800.0), np.zeros(SHAPE, bool))
    assert len(mesh.vertices) == len(mesh.faces) == len(mesh.normals) == len(mesh.flags) == 0


def test_what_is_outside_the_box_and_the_wall_are_left_out():
    y, x = np.indices(SHAPE)
    inside = (np.abs(x - 25) < 12) & (np.abs(y - 20) < 12)
    depth = np.where(inside, 700 + 0.02 * (x - 25) ** 2, 800)
    alone = meshed(depth, options=MeshOptions(without_background=True))
    assert len(alone.vertices) == inside.sum() and alone.vertices[:, 2].max() < 750
    boxed = meshed(depth, options=MeshOptions(crop_mm=(-1, -1, 600, 100, 100, 750)))
    np.testing.assert_array_equal(boxed.vertices, alone.vertices)
    fewer = meshed(depth, options=MeshOptions(without_background=True, max_triangles=100))
    assert len(fewer.faces) <= 100


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_frame_takes_its_standard_deviations_along(calibrated):
    frame = bust(calibrated)
    mesh, counts = counted_mesh(frame)
    assert mesh.unit == ("mm" if calibrated else "rad")
    assert ("sigma_mm" in mesh.properties) == calibrated and "sigma_rad" in mesh.properties
    assert 0.97 * frame.mask.sum() < len(mesh.vertices) < 1.01 * frame.mask.sum()
    assert counts.vertices == len(mesh.vertices) and counts.triangles == len(mesh.faces)
    # A filled pixel that moves to the rim counts there; without smoothing none moves.
    unmoved = counted_mesh(frame, MeshOptions(smoothed=False))[1]
    assert unmoved.vertices == counts.vertices and unmoved.rim == 0
    assert unmoved.vertices - unmoved.filled + unmoved.specks + unmoved.teeth == frame.mask.sum()
    assert set(asdict(counts)) >= {"smoothed", "filled", "cropped", "background"}
    if not calibrated:
        for options in (MeshOptions(without_background=True), MeshOptions(crop_mm=(0, 0, 0, 1, 1, 1))):
            with pytest.raises(SettingsError, match="mesh in mm only: give a calibration"):
                frame_mesh(frame, options)
