"""Uncertainty of each point: the phase's standard deviation, in millimetres along the pixel's ray.

    sigma_point = |dX / dphi| sigma_phase

The derivative is the difference quotient of `triangulation.py`'s own depth over a small step of the phase.
"""

import numpy as np

from tikernels import checks
from tikernels._taichi import F32Array1, F32Array2, F32Array3, Static, ti, vec3
from tikernels.arrays import F32
from tikernels.depth.triangulation import ProjectorGeometry, load_projector, ray_depth
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI
from tikernels.strips import STRIP, strip_at, strip_count

# The shift of a point is measured between its phase and this much more, rad: 0.15 mm, a thousand times what float32
# leaves of 900 mm, and straight enough.
_BESIDE = 0.02


@kernel
def point_sigma_kernel(
    phase: F32Array2,  # (H, W) rad, absolute
    phase_sigma: F32Array2,  # (H, W) rad
    points: F32Array3,  # (H, W, 3) mm
    rays: F32Array3,  # (H, W, 2) x, y at unit depth
    projector: F32Array1,
    axis: Static,
    terms: Static,
    out: F32Array2,  # (H, W) mm along the ray; NaN where there is no point
):
    """Move every pixel's phase a little, and see how far its point goes."""
    height, width = out.shape[0], out.shape[1]
    for t in range(height * strip_count(width, STRIP)):
        y, first, count = strip_at(t, width, STRIP)
        rotation, translation, lens, focal, center, period = load_projector(projector)
        for x in range(first, first + count):
            ray = vec3(rays[y, x, 0], rays[y, x, 1], 1.0)
            row = (phase[y, x] + _BESIDE) * (period / (2.0 * PI))
            depth = ray_depth(ray, row, rotation, translation, focal, center, lens, axis, terms)
            depth = ti.select(depth > 0.0, depth, ti.math.nan)
            shift = ti.abs(depth - points[y, x, 2]) * ti.sqrt(1.0 + ray.x * ray.x + ray.y * ray.y)
            out[y, x] = shift * phase_sigma[y, x] / _BESIDE


def point_sigma(
    phase: F32, phase_sigma: F32, points: F32, rays: F32, projector: ProjectorGeometry, out: F32 | None = None
) -> F32:
    """Return how far a standard deviation of the phase moves each point along its ray.

    Parameters
    ----------
    phase : (H, W) float32
        rad, absolute.
    phase_sigma : (H, W) float32
        rad.
    points : (H, W, 3) float32
        mm, what `triangulate` made of the phase.
    rays : (H, W, 2) float32
        x and y of every camera pixel's ray at unit depth.
    projector : ProjectorGeometry
        The projector.
    out : (H, W) float32, optional
        Output array.

    Returns
    -------
    (H, W) float32
        mm; NaN where there is no point. A buffer of the device if none is given.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    phase = checks.read_array("phase", phase, (None, None), np.float32)
    shape = (int(phase.shape[0]), int(phase.shape[1]))
    phase_sigma = checks.read_array("phase_sigma", phase_sigma, shape, np.float32)
    points = checks.read_array("points", points, (*shape, 3), np.float32)
    rays = checks.read_array("rays", rays, (*shape, 2), np.float32)
    out = checks.out_buffer("out", out, shape, np.float32)
    point_sigma_kernel(phase, phase_sigma, points, rays, *projector.arguments(), out)
    return out
