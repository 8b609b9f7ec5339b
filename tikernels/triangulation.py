"""Turn phase into points: the camera's ray of a pixel meets the projector's surface of equal phase.

Without lens distortion that surface is a plane through the projector's centre and the meeting point is closed-form;
with it, the row where the ray's point really lands is compared with the row that the phase names, and the plane is
moved by the difference, five times: each turn leaves a few per cent of the error.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import _checks
from tikernels._taichi import F32Array2, F32Array3, f32, i32, mat3, ti, vec3, vec5
from tikernels.phase_vector import PI


class ProjectorGeometry(NamedTuple):
    """Where the projector stands and how its phase runs."""

    rotation: npt.NDArray[np.float64]  # 3x3, X_projector = rotation X_camera + translation
    translation_mm: npt.NDArray[np.float64]  # 3
    focal_px: float  # along the axis on which the phase changes
    center_px: float  # on that axis
    distortion: npt.NDArray[np.float64]  # 5, OpenCV's
    period_px: float  # projector px a cycle
    axis: int  # 0: the phase changes with the column, 1: with the row

    def arguments(self) -> tuple[Any, ...]:
        """Return the kernel arguments, in order."""
        return (
            mat3(self.rotation.tolist()),
            vec3(self.translation_mm.tolist()),
            self.focal_px,
            self.center_px,
            vec5(self.distortion.tolist()),
            self.period_px,
            self.axis,
        )


@ti.func
def projected(q: vec3, focal: f32, center: f32, lens: vec5, axis: i32) -> f32:
    """Projector row (axis 1) or column (axis 0) of a point in the projector's frame, px."""
    a, b = q.x / q.z, q.y / q.z
    r2 = a * a + b * b
    radial = 1.0 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
    x = a * radial + 2.0 * lens[2] * a * b + lens[3] * (r2 + 2.0 * a * a)
    y = b * radial + lens[2] * (r2 + 2.0 * b * b) + 2.0 * lens[3] * a * b
    return focal * ti.select(axis == 0, x, y) + center


@ti.func
def ray_depth(
    ray: vec3, row: f32, rotation: mat3, translation: vec3, focal: f32, center: f32, lens: vec5, axis: i32
) -> f32:
    """Depth (mm) at which a ray of unit depth meets a projector row; not positive where it does not."""
    direction = rotation @ ray
    along, offset = direction.y, translation.y
    if axis == 0:
        along, offset = direction.x, translation.x
    slope = (row - center) / focal
    depth = (slope * translation.z - offset) / (along - slope * direction.z)
    if ti.abs(lens[0]) + ti.abs(lens[1]) + ti.abs(lens[2]) + ti.abs(lens[3]) + ti.abs(lens[4]) > 0.0:
        for _ in range(5):
            landed = projected(depth * direction + translation, focal, center, lens, axis)
            slope += (row - landed) / focal
            depth = (slope * translation.z - offset) / (along - slope * direction.z)
    return depth


@ti.kernel
def triangulate_kernel(
    unwrapped_phase: F32Array2,  # (H, W) rad, absolute; NaN outside the mask
    rays: F32Array3,  # (H, W, 2) x, y at unit depth
    rotation: mat3,
    translation: vec3,
    focal: f32,
    center: f32,
    lens: vec5,
    period: f32,
    axis: i32,
    out_points: F32Array3,  # (H, W, 3) mm
):
    height, width = unwrapped_phase.shape[0], unwrapped_phase.shape[1]
    for pixel in range(height * width):
        y, x = pixel // width, pixel % width
        phase = unwrapped_phase[y, x]
        point = vec3(ti.math.nan)
        if not ti.math.isnan(phase):
            ray = vec3(rays[y, x, 0], rays[y, x, 1], 1.0)
            row = phase * (period / (2.0 * PI))
            depth = ray_depth(ray, row, rotation, translation, focal, center, lens, axis)
            if depth > 0.0:
                point = depth * ray
        for k in ti.static(range(3)):
            out_points[y, x, k] = point[k]


def triangulate(unwrapped_phase: Any, rays: Any, projector: ProjectorGeometry, out: Any | None = None) -> Any:
    """Turn an absolute phase map into points.

    Parameters
    ----------
    unwrapped_phase : (H, W) float32
        rad, 0 at the centre of the projector's first row (or column); NaN outside the mask.
    rays : (H, W, 2) float32
        x and y of every camera pixel's ray at unit depth, lens distortion taken out.
    projector : ProjectorGeometry
        The projector.
    out : (H, W, 3) float32, optional
        Where the result goes.

    Returns
    -------
    (H, W, 3) float32
        mm in the camera's frame (x right, y down, z forward); NaN outside the mask and where the ray never meets the
        projector's row in front of the camera.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    unwrapped_phase = _checks.read_array("unwrapped_phase", unwrapped_phase, (None, None), np.float32)
    shape = (int(unwrapped_phase.shape[0]), int(unwrapped_phase.shape[1]))
    rays = _checks.read_array("rays", rays, (*shape, 2), np.float32)
    out = _checks.out_array("out", out, (*shape, 3), np.float32)
    triangulate_kernel(unwrapped_phase, rays, *projector.arguments(), out)
    return out
