"""Columns of the projector along the stripe, against exact projection."""

import numpy as np
import pytest

from pipeline.orders.stripe_columns import StripeColumns, column_at
from pipeline.simulation import simulated_rig
from tikernels.order_evidence.contrast_reading import BLOCK_WIDTH

SIZE = (320, 240)
LENSES = {
    "camera_distortion": (-0.12, 0.08, 0.001, -0.0008, 0.0),
    "projector_distortion": (-0.06, 0.05, -0.001, 5e-4, 0.0),
}


def geometry_of(tilt_deg=0.0, stripes="horizontal", **lenses):
    return simulated_rig(
        SIZE, period_px=2 * 768 / 44, code="contrast2", tilt_deg=tilt_deg, stripes=stripes, **lenses
    ).geometry()


def columns_of(geometry):
    """Return the columns, and the rays, both with stripes along the rows."""
    rays = geometry.camera.rays(np.zeros(2))
    if geometry.phase_axis == 0:
        rays = np.ascontiguousarray(rays.swapaxes(0, 1))
    return StripeColumns(geometry, rays), rays


def projected(geometry, points):
    """Return (order, column) of points by pinhole and lens, an oracle of its own."""
    x, y, z = (points @ geometry.rotation.T + geometry.translation_mm).T
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = geometry.projector.distortion[:5]
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    x, y = (
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    )
    matrix = geometry.projector.matrix
    pixel = np.stack([matrix[0, 0] * x + matrix[0, 2], matrix[1, 1] * y + matrix[1, 2]])
    return pixel[geometry.phase_axis] / geometry.pattern.period_px, pixel[1 - geometry.phase_axis]


@pytest.mark.parametrize("tilt_deg", [0.0, 3.0, 15.0])
@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
@pytest.mark.parametrize("lenses", [{}, LENSES], ids=["pinhole", "distorted"])
def test_columns_are_those_that_points_project_to(tilt_deg, stripes, lenses):
    """At depths of 0.6 to 1.5 m, within a hundredth of a cell."""
    geometry = geometry_of(tilt_deg, stripes, **lenses)
    columns, rays = columns_of(geometry)
    rng = np.random.default_rng(0)
    place = rng.uniform(0, np.array(rays.shape[:2]) - 1, (400, 2)).round()
    row, column = place.astype(int).T
    points = np.column_stack([rays[row, column], np.ones(len(row))]) * rng.uniform(600, 1500, (len(row), 1))
    order, expected = projected(geometry, points)
    inside = (order > 0) & (order < columns.cycles)
    assert inside.sum() > 150
    found = column_at(columns.terms(place), order)
    np.testing.assert_allclose(found[inside], expected[inside], atol=0.01 * geometry.pattern.cell_px)


def test_columns_at_many_orders_at_once():
    """The other orders of a place are those of the same ray at other depths."""
    geometry = geometry_of(tilt_deg=5.0)
    columns, rays = columns_of(geometry)
    depths = np.linspace(700, 1200, 6)
    order, expected = projected(geometry, np.append(rays[100, 200], 1.0) * depths[:, None])
    terms = columns.terms(np.array([[100.0, 200.0], [100.0, 200.0]]))
    found = column_at(terms, np.stack([order, order[::-1]]))
    assert np.ptp(expected) > 1
    np.testing.assert_allclose(found, [expected, expected[::-1]], atol=0.05)


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_how_much_of_the_pattern_a_block_sees(stripes):
    geometry = geometry_of(stripes=stripes)
    columns, rays = columns_of(geometry)
    assert columns.cycles == pytest.approx({"horizontal": 768, "vertical": 1024}[stripes] / geometry.pattern.period_px)
    middle = np.array(rays.shape[:2]) // 2
    ends = [np.append(rays[middle[0], middle[1] + step], 1.0) * 900 for step in (0, BLOCK_WIDTH)]
    _, seen = projected(geometry, np.array(ends))
    assert columns.block_px == pytest.approx(abs(seen[1] - seen[0]), rel=0.05)


def test_what_looks_past_the_pattern_has_no_column():
    geometry = geometry_of()
    columns, rays = columns_of(geometry)
    away = StripeColumns(geometry, rays + np.float32(50.0))
    assert np.isnan(away.terms(np.array([[100.0, 200.0]]))).all()
    assert np.isfinite(columns.terms(np.array([[0.0, 0.0], [239.0, 319.0]]))).all()
