"""Turn phase into points: the camera's ray of a pixel meets the projector's surface of equal phase.

Without lens distortion that surface is a plane through the projector's centre and the meeting point is closed-form;
with it, the projector sees the camera's ray as a line, and the place on that line which lands in the row that the phase
names is found by one step of Chebyshev's method: of 900 mm that leaves 0.1 um for the lens of an ordinary projector,
7 um for k1 = 0.15 and 0.1 mm for k1 = 0.3. Lenses of more than five coefficients take the secant method, at four
times the cost.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import F32Array1, F32Array2, F32Array3, Static, f32, i32, mat3, ti, vec3, vec21
from tikernels.arrays import F32
from tikernels.depth.lens_distortion import LENS_NUMBERS, SHORT, distorted, needed_terms, pack_lens
from tikernels.launching import kernel
from tikernels.phase.phase_vector import PI
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.strips import STRIP, strip_at, strip_count

# Steps of the secant method, each of which takes the product of the two errors before it; and how far a lens may change
# the slope.
_SECANTS, _STEEPER = 4, 0.9
strip_of_floats = ti.types.vector(STRIP, ti.f32)


class ProjectorGeometry(NamedTuple):
    """The projector's pose, and the course of its phase."""

    rotation: npt.NDArray[np.float64]  # 3x3, X_projector = rotation X_camera + translation
    translation_mm: npt.NDArray[np.float64]  # 3
    focal_px: float  # along the axis on which the phase changes
    center_px: float  # on that axis
    distortion: npt.NDArray[np.float64]  # 5 or 14, OpenCV's
    period_px: float  # projector px per cycle
    axis: int  # 0: the phase changes with the column, 1: with the row

    def arguments(self) -> tuple[npt.NDArray[np.float32], int, int]:
        """Return the kernel arguments: `load_projector`'s array, the axis, and `needed_terms` of the lens.

        As one array they are passed ten times as fast as matrices.
        """
        lens = pack_lens(self.distortion)
        numbers = (self.rotation, self.translation_mm, lens, self.focal_px, self.center_px, self.period_px)
        packed = np.concatenate([np.ravel(values) for values in numbers]).astype(np.float32)
        return packed, self.axis, needed_terms(self.distortion)


@ti.func
def load_projector(packed: F32Array1):
    """Return rotation, translation, distortion, focal length, centre and period."""
    rotation = mat3([[packed[3 * i + j] for j in range(3)] for i in range(3)])
    translation = vec3(packed[9], packed[10], packed[11])
    lens = vec21([packed[12 + i] for i in range(LENS_NUMBERS)])
    after = 12 + LENS_NUMBERS
    return rotation, translation, lens, packed[after], packed[after + 1], packed[after + 2]


@ti.func
def projected(q: vec3, focal: f32, center: f32, lens: vec21, axis: i32) -> f32:
    """Projector row (axis 1) or column (axis 0) of a point in the projector's frame, px."""
    bent = distorted(q.x / q.z, q.y / q.z, lens)
    return focal * ti.select(axis == 0, bent.x, bent.y) + center


@ti.func
def ray_depth(
    ray: vec3,
    row: f32,
    rotation: mat3,
    translation: vec3,
    focal: f32,
    center: f32,
    lens: vec21,
    axis: Static,
    terms: Static,
) -> f32:
    """Depth (mm) at which a ray of unit depth meets a projector row; not positive where it does not."""
    direction = rotation @ ray
    along, offset = direction[axis], translation[axis]
    named = (row - center) / focal
    slope = named
    if ti.static(terms > 0):
        # The epipolar line: a = at + b tilt, b along the axis on which the phase changes.
        d, t = direction[1 - axis], translation[1 - axis]
        scale = 1.0 / (along * translation.z - offset * direction.z)
        tilt, at = (d * translation.z - t * direction.z) * scale, (along * t - offset * d) * scale
        if ti.static(terms == SHORT):
            across, along_axis = lens[2 + axis], lens[3 - axis]
            a, b = at + named * tilt, named
            r2, half_rise = a * a + b * b, a * tilt + b
            radial = r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
            growth = lens[0] + r2 * (2.0 * lens[1] + 3.0 * r2 * lens[4])  # of radial with r2
            moved = b * radial + 2.0 * across * a * b + along_axis * (r2 + 2.0 * b * b)
            steeper = (
                radial
                + 2.0 * b * growth * half_rise
                + 2.0 * across * (a + b * tilt)
                + along_axis * (2.0 * half_rise + 4.0 * b)
            )
            curved = growth * (4.0 * half_rise + 2.0 * b * (1.0 + tilt * tilt))
            step = moved * (1.0 - steeper + steeper * steeper)  # 1 / (1 + steeper)
            slope -= step + 0.5 * curved * step * step
        else:
            last_slope, last_missed, steep = named, 0.0, 1.0
            for k in ti.static(range(_SECANTS)):
                a, b = at + slope * tilt, slope
                missed = distorted(ti.select(axis == 0, b, a), ti.select(axis == 0, a, b), lens)[axis] - named
                if ti.static(k > 0):
                    moved = ti.select(slope == last_slope, 1.0, slope - last_slope)
                    change = (missed - last_missed) / moved
                    steep = ti.select(ti.abs(change - 1.0) < _STEEPER, change, steep)
                last_slope, last_missed = slope, missed
                slope -= missed / steep
    depth = (slope * translation.z - offset) / (along - slope * direction.z)
    return depth


@kernel
def triangulate_kernel(
    unwrapped_phase: F32Array2,  # (H, W) rad, absolute; NaN outside the mask
    rays: F32Array3,  # (H, W, 2) x, y at unit depth
    projector: F32Array1,
    axis: Static,
    terms: Static,
    out_points: F32Array3,  # (H, W, 3) mm
):
    """Place every pixel on its ray."""
    height, width = unwrapped_phase.shape[0], unwrapped_phase.shape[1]
    for t in range(height * strip_count(width, STRIP)):
        y, first, count = strip_at(t, width, STRIP)
        rotation, translation, lens, focal, center, period = load_projector(projector)
        row, depths = strip_of_floats(0.0), strip_of_floats(0.0)
        right, down = strip_of_floats(0.0), strip_of_floats(0.0)
        for k in range(count):
            row[k] = unwrapped_phase[y, first + k] * (period / (2.0 * PI))
            right[k], down[k] = rays[y, first + k, 0], rays[y, first + k, 1]
        for k in range(STRIP):
            ray = vec3(right[k], down[k], 1.0)
            depth = ray_depth(ray, row[k], rotation, translation, focal, center, lens, axis, terms)
            # Neither without a phase, which makes it NaN, nor behind the camera.
            depths[k] = ti.select(depth > 0.0, depth, ti.math.nan)
        for k in range(count):
            out_points[y, first + k, 0] = depths[k] * right[k]
            out_points[y, first + k, 1] = depths[k] * down[k]
            out_points[y, first + k, 2] = depths[k]


def triangulate(unwrapped_phase: F32, rays: F32, projector: ProjectorGeometry, out: F32 | None = None) -> F32:
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
        Output array.

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
    unwrapped_phase = checks.read_array("unwrapped_phase", unwrapped_phase, (None, None), np.float32)
    shape = (int(unwrapped_phase.shape[0]), int(unwrapped_phase.shape[1]))
    rays = checks.read_array("rays", rays, (*shape, 2), np.float32)
    out = checks.out_array("out", out, (*shape, 3), np.float32)
    triangulate_kernel(unwrapped_phase, rays, *projector.arguments(), out)
    return out


@kernel
def leave_out_blind_kernel(
    rays: F32Array3,  # (H, W, 2) x, y at unit depth
    out_phase: F32Array2,  # (H, W) rad; NO_PHASE outside the mask
):
    for y, x in ti.ndrange(out_phase.shape[0], out_phase.shape[1]):
        if ti.math.isnan(rays[y, x, 0]):
            out_phase[y, x] = NO_PHASE


def leave_out_blind(rays: F32, out: F32) -> None:
    """Take pixels without a ray, (H, W, 2) float32, NaN there, out of a phase, (H, W) float32: NO_PHASE.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    rays = checks.read_array("rays", rays, (None, None, 2), np.float32)
    phase = checks.out_buffer("phase", out, (int(rays.shape[0]), int(rays.shape[1])), np.float32)
    leave_out_blind_kernel(rays, phase)
