"""Render what the camera of a fringe-projection rig sees, with exact truth.

A scene is a signed distance field in the camera's frame (mm); every camera ray is traced to its surface (J. C. Hart,
Sphere tracing, The Visual Computer 12, 1996, doi:10.1007/s003710050084), the point is carried into the projector, whose
light is read off there, and a second ray towards the projector finds the shadows. Because image and truth come from the
same surface point, the truth is exact whatever the tracing's own tolerance.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import _checks
from tikernels._taichi import F32Array1, F32Array2, F32Array3, F32Array4, U8Array2, f32, i32, mat3, ti, vec3, vec8

SCENES = ("bust", "plane", "waves", "objects", "ball")


# Every scene lies between these depths: rays start at the first, end at the second, and cast no shadow before it.
_NEAR_MM = 700.0
_FAR_MM = 1200.0
# A hit is refined below this distance: 1e-3 mm is 1e-4 rad of phase on a rig with a 180 mm baseline.
_HIT_MM = 1e-3
# Depth of the upright axis that objects turn about.
_AXIS_MM = 880.0


class SceneTruth(NamedTuple):
    """Buffers that `render_scene` fills, all float32 unless said."""

    light: npt.NDArray[np.float32]  # (H, W, 3) linear light that reaches the camera, before blur and noise
    projector_px: npt.NDArray[np.float32]  # (H, W, 2) column, row in the projector; NaN where nothing is seen
    points: npt.NDArray[np.float32]  # (H, W, 3) mm, camera frame; NaN where nothing is seen
    reflectance: npt.NDArray[np.float32]  # (H, W, 3) per camera channel
    lit: npt.NDArray[np.uint8]  # (H, W) 1 where the projector's light arrives


@ti.func
def ellipsoid(p: vec3, radii: vec3) -> f32:
    """Distance to an ellipsoid, to first order."""
    outer = (p / radii).norm()
    inner = (p / (radii * radii)).norm()
    return outer * (outer - 1.0) / ti.max(inner, 1e-6)


@ti.func
def smooth_union(a: f32, b: f32, blend_mm: f32) -> f32:
    """Return the smaller of two distances, with a fillet."""
    h = ti.max(blend_mm - ti.abs(a - b), 0.0) / blend_mm
    return ti.min(a, b) - h * h * blend_mm * 0.25


@ti.func
def smooth_cut(a: f32, b: f32, blend_mm: f32) -> f32:
    """Return a with b taken away, with a fillet."""
    return -smooth_union(-a, b, blend_mm)


@ti.func
def bust(p: vec3) -> f32:
    """Head and shoulders around (0, 0, 850) mm, face towards the camera."""
    q = p - vec3(0.0, -5.0, 850.0)
    mirrored = vec3(ti.abs(q.x), q.y, q.z)
    head = ellipsoid(q - vec3(0.0, -30.0, 10.0), vec3(72.0, 98.0, 88.0))
    jaw = ellipsoid(q - vec3(0.0, 38.0, -14.0), vec3(52.0, 48.0, 56.0))
    skull = smooth_union(head, jaw, 28.0)
    distance = skull
    # No feature of the face stands out by 30 mm, so further away none is worth computing.
    if q.z < 10.0 and skull < 40.0:
        cheek = ellipsoid(mirrored - vec3(36.0, 2.0, -52.0), vec3(22.0, 24.0, 18.0))
        distance = smooth_union(distance, cheek, 22.0)
        brow = ellipsoid(mirrored - vec3(20.0, -40.0, -70.0), vec3(20.0, 8.0, 11.0))
        distance = smooth_union(distance, brow, 14.0)
        socket = ellipsoid(mirrored - vec3(29.0, -22.0, -88.0), vec3(21.0, 14.0, 20.0))
        distance = smooth_cut(distance, socket, 14.0)
        eye = (mirrored - vec3(28.0, -22.0, -58.0)).norm() - 14.0
        distance = smooth_union(distance, eye, 4.0)
        nose = ellipsoid(q - vec3(0.0, -4.0, -80.0), vec3(10.0, 30.0, 16.0))
        distance = smooth_union(distance, nose, 14.0)
        tip = ellipsoid(mirrored - vec3(6.0, 14.0, -86.0), vec3(12.0, 10.0, 14.0))
        distance = smooth_union(distance, tip, 9.0)
        lips = ellipsoid(q - vec3(0.0, 41.0, -66.0), vec3(25.0, 9.0, 13.0))
        distance = smooth_union(distance, lips, 8.0)
        mouth = ellipsoid(q - vec3(0.0, 41.0, -82.0), vec3(24.0, 2.5, 10.0))
        distance = smooth_cut(distance, mouth, 5.0)
        chin = ellipsoid(q - vec3(0.0, 70.0, -52.0), vec3(22.0, 16.0, 18.0))
        distance = smooth_union(distance, chin, 14.0)
    neck = ti.sqrt(q.x * q.x + (q.z - 18.0) * (q.z - 18.0)) - 46.0
    neck = ti.max(neck, ti.abs(q.y - 100.0) - 80.0)
    distance = smooth_union(distance, neck, 20.0)
    shoulders = ellipsoid(q - vec3(0.0, 190.0, 30.0), vec3(190.0, 76.0, 66.0))
    distance = smooth_union(distance, shoulders, 34.0)
    if q.z < 10.0 and skull >= 40.0:
        distance = ti.min(distance, skull - 30.0)
    return distance


@ti.func
def wall(p: vec3, depth_mm: f32) -> f32:
    """Distance to a wall that leans back a little."""
    return (depth_mm + 0.06 * p.x - 0.04 * p.y - p.z) / ti.sqrt(1.0 + 0.06 * 0.06 + 0.04 * 0.04)


@ti.func
def interpolation_weights(fraction: f32) -> vec8:
    """Weights of eight Lagrange taps, -3..4 around the sample.

    Exact on polynomials of degree 7: on a sinusoid of 17 px a cycle the error is 3e-7, where cubic convolution leaves
    0.012 rad of phase.
    """
    weights = vec8(1.0)
    for tap in range(8):
        for other in ti.static(range(8)):
            if other != tap:
                weights[tap] *= (fraction - (other - 3.0)) / ti.cast(tap - other, ti.f32)
    return weights


@ti.func
def sample(light: F32Array3, column: f32, row: f32, channel: i32) -> f32:
    """Read the projector's light between its pixels; nothing is projected outside its frame."""
    height, width = light.shape[0], light.shape[1]
    value = 0.0
    if column >= -0.5 and column <= width - 0.5 and row >= -0.5 and row <= height - 0.5:
        left, top = ti.floor(column), ti.floor(row)
        across, down = interpolation_weights(column - left), interpolation_weights(row - top)
        for i in range(8):
            y = ti.min(ti.max(ti.cast(top, ti.i32) + (i - 3), 0), height - 1)
            line = 0.0
            for j in ti.static(range(8)):
                x = ti.min(ti.max(ti.cast(left, ti.i32) + (j - 3), 0), width - 1)
                line += across[j] * light[y, x, channel]
            value += down[i] * line
    return ti.min(ti.max(value, 0.0), 1.0)


@ti.func
def surface_color(p: vec3, color: vec3, texture: f32) -> vec3:
    """Reflectance that varies slowly by +-texture, with one redder, darker blotch of some 30 mm."""
    slow = ti.sin(0.021 * p.x + 0.4) * ti.cos(0.026 * p.y + 0.011 * p.x)
    blotch = ti.exp(-((p.x - 35.0) ** 2 + (p.y - 15.0) ** 2) / 800.0)
    tint = vec3(0.10, 0.35, 0.35) * blotch
    return color * (1.0 + texture * slow) * (1.0 - ti.min(4.0 * texture, 1.0) * tint)


@ti.func
def at_rest(p: vec3, motion: vec3, turn: f32) -> vec3:
    """Carry a point back to before the objects turned (rad, about an upright axis through them) and moved."""
    q = p - motion - vec3(0.0, 0.0, _AXIS_MM)
    c, s = ti.cos(turn), ti.sin(turn)
    return vec3(c * q.x - s * q.z, q.y, s * q.x + c * q.z + _AXIS_MM)


def _scene(scene: str) -> Any:
    """Return a `ti.func`: the distance to a scene whose objects, but not its wall, have moved."""
    if scene == "bust":

        @ti.func
        def distance_to(p: vec3, motion: vec3, turn: f32) -> f32:
            return ti.min(bust(at_rest(p, motion, turn)), wall(p, 985.0))

    elif scene == "plane":

        @ti.func
        def distance_to(p: vec3, motion: vec3, turn: f32) -> f32:
            q = at_rest(p, motion, turn)
            return (900.0 + 0.25 * q.x + 0.2 * q.y - q.z) / ti.sqrt(1.0 + 0.0625 + 0.04)

    elif scene == "waves":

        @ti.func
        def distance_to(p: vec3, motion: vec3, turn: f32) -> f32:
            q = at_rest(p, motion, turn)
            height = 9.0 * ti.sin(q.x * 0.055) * ti.cos(q.y * 0.05) + 5.0 * ti.sin(q.x * 0.02 + q.y * 0.08)
            return (900.0 + height - q.z) * 0.75  # the slope stays under 0.8

    elif scene == "objects":

        @ti.func
        def distance_to(p: vec3, motion: vec3, turn: f32) -> f32:
            q = at_rest(p, motion, turn)
            ball = (q - vec3(-130.0, -60.0, 880.0)).norm() - 62.0
            egg = ellipsoid(q - vec3(120.0, 45.0, 930.0), vec3(85.0, 60.0, 50.0))
            box = ti.abs(q - vec3(-70.0, 100.0, 960.0) - vec3(0.2 * q.y, 0.0, 0.3 * q.x)) - vec3(70.0, 32.0, 40.0)
            rounded = ti.max(box, 0.0).norm() + ti.min(ti.max(box.x, ti.max(box.y, box.z)), 0.0) - 10.0
            return ti.min(ball, ti.min(egg, rounded * 0.8))

    else:

        @ti.func
        def distance_to(p: vec3, motion: vec3, turn: f32) -> f32:
            ball = (at_rest(p, motion, turn) - vec3(0.0, 0.0, 880.0)).norm() - 85.0
            return ti.min(ball, wall(p, 985.0))

    return distance_to


@cache
def _render_scene_kernel(scene: str, views: int, fields: int, narrow_band: bool) -> Any:
    """Specialise the renderer.

    `views` is 3 where camera channels see along rays of their own, else 1; `fields` is 3 where the projector shows its
    colours one after another, else 1.
    """
    distance_to = _scene(scene)

    @ti.func
    def trace(ray: vec3, motion: vec3, turn: f32) -> f32:
        """Depth of the first surface along a ray of unit depth; beyond _FAR_MM: none."""
        length = ray.norm()
        depth = _NEAR_MM
        gap = 1.0
        steps = 0
        while gap > _HIT_MM and depth < _FAR_MM and steps < 200:
            gap = distance_to(ray * depth, motion, turn)
            depth += gap / length
            steps += 1
        return depth

    @ti.func
    def shadowed(p: vec3, direction: vec3, motion: vec3, turn: f32) -> i32:
        """Whether something stands between a point and the projector."""
        hidden = 0
        # The surface's own tolerance must not shadow it: the first 2 mm are skipped.
        travelled = 2.0
        while hidden == 0 and p.z + travelled * direction.z > _NEAR_MM:
            gap = distance_to(p + travelled * direction, motion, turn)
            if gap < 0.01:
                hidden = 1
            travelled += ti.max(gap, 0.5)
        return hidden

    @ti.func
    def normal_at(p: vec3, motion: vec3, turn: f32) -> vec3:
        step = 0.25
        gradient = vec3(0.0)
        for k in ti.static(range(4)):
            corner = vec3((1, 1, -1, -1)[k], (1, -1, 1, -1)[k], (1, -1, -1, 1)[k])
            gradient += corner * distance_to(p + step * corner, motion, turn)
        return gradient.normalized()

    @ti.kernel
    def render_scene_kernel(
        rays: F32Array4,  # (views, H, W, 2) unit-depth rays, lens distortion taken out
        light: F32Array3,  # (Hp, Wp, 3) linear projector light, 0..1
        crosstalk: mat3,
        rotation: mat3,  # X_projector = rotation X_camera + translation
        translation: vec3,  # mm
        lens: F32Array1,  # fx, fy, cx, cy, k1, k2, p1, p2, k3 of the projector
        projector_shift: F32Array2,  # (3, 2) px, lateral colour
        color: vec3,
        texture: f32,
        ambient: f32,
        falloff_mm: f32,  # distance at which the projector's light counts 1
        place: vec3,  # mm that the objects, but not the wall, have moved
        turn: f32,  # rad that they have turned
        field_motion: vec3,  # mm that the objects move from one colour field to the next
        out_light: F32Array3,
        out_projector_px: F32Array3,
        out_points: F32Array3,
        out_reflectance: F32Array3,
        out_lit: U8Array2,
    ):
        height, width = out_lit.shape[0], out_lit.shape[1]
        centre = -(rotation.transpose() @ translation)
        for pixel in range(height * width):
            y, x = pixel // width, pixel % width
            radiance = vec3(0.0)
            out_lit[y, x] = ti.cast(0, ti.u8)
            for k in ti.static(range(3)):
                out_points[y, x, k] = ti.math.nan
                out_reflectance[y, x, k] = 0.0
            out_projector_px[y, x, 0] = ti.math.nan
            out_projector_px[y, x, 1] = ti.math.nan
            for view in range(views):
                ray = vec3(rays[view, y, x, 0], rays[view, y, x, 1], 1.0)
                for field in range(fields):
                    motion = place + field_motion * ti.cast(field, ti.f32)
                    depth = trace(ray, motion, turn)
                    if depth < _FAR_MM:
                        p = ray * depth
                        towards = centre - p
                        distance = towards.norm()
                        direction = towards / distance
                        slope = normal_at(p, motion, turn).dot(direction)
                        reflectance = surface_color(at_rest(p, motion, turn), color, texture)
                        # The projector's lens, as OpenCV distorts.
                        q = rotation @ p + translation
                        a, b = q.x / q.z, q.y / q.z
                        r2 = a * a + b * b
                        radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
                        u = lens[0] * (a * radial + 2 * lens[6] * a * b + lens[7] * (r2 + 2 * a * a)) + lens[2]
                        v = lens[1] * (b * radial + lens[6] * (r2 + 2 * b * b) + 2 * lens[7] * a * b) + lens[3]
                        inside = u >= -0.5 and u <= light.shape[1] - 0.5 and v >= -0.5 and v <= light.shape[0] - 0.5
                        lit = 0
                        if slope > 0.0 and inside:
                            lit = 1 - shadowed(p, direction, motion, turn)
                        irradiance = vec3(ambient)
                        if lit == 1:
                            shade = slope * (falloff_mm / distance) ** 2
                            for j in ti.static(range(3)):
                                irradiance[j] += shade * sample(
                                    light, u - projector_shift[j, 0], v - projector_shift[j, 1], j
                                )
                        if fields == 3:  # only this field's colour; ambient light is there all the time
                            for j in ti.static(range(3)):
                                if j != field:
                                    irradiance[j] = 0.0
                        seen = vec3(0.0)
                        if ti.static(narrow_band):
                            seen = crosstalk @ (reflectance * irradiance)
                        else:
                            seen = reflectance * (crosstalk @ irradiance)
                        for i in ti.static(range(3)):
                            if views == 1 or i == view:
                                radiance[i] += seen[i]
                        if field == 0 and (views == 1 or view == 1):
                            out_lit[y, x] = ti.cast(lit, ti.u8)
                            out_projector_px[y, x, 0] = u
                            out_projector_px[y, x, 1] = v
                            for k in ti.static(range(3)):
                                out_points[y, x, k] = p[k]
                                out_reflectance[y, x, k] = reflectance[k]
            for i in ti.static(range(3)):
                out_light[y, x, i] = radiance[i]

    return render_scene_kernel


def render_scene(
    scene: str,
    rays: npt.NDArray[np.float32],
    light: npt.NDArray[np.float32],
    *,
    crosstalk_matrix: npt.NDArray[np.float64],
    rotation: npt.NDArray[np.float64],
    translation_mm: npt.NDArray[np.float64],
    projector_matrix: npt.NDArray[np.float64],
    projector_distortion: npt.NDArray[np.float64],
    projector_shift_px: npt.NDArray[np.float64],
    color: tuple[float, float, float],
    texture: float,
    ambient: float,
    falloff_mm: float,
    object_motion_mm: tuple[float, float, float],
    object_turn_deg: float,
    field_motion_mm: tuple[float, float, float],
    narrow_band: bool,
) -> SceneTruth:
    """Render a scene under a projector's light.

    Parameters
    ----------
    scene : str
        One of `SCENES`.
    rays : (V, H, W, 2) float32
        x and y of every pixel's ray at unit depth; V = 3 where the camera's channels see along rays of their own.
    light : (Hp, Wp, 3) float32
        Linear light of every projector pixel, 0..1.
    crosstalk_matrix, rotation, translation_mm, projector_matrix, projector_distortion
        The rig, as in a calibration.
    projector_shift_px : (3, 2)
        Lateral colour: where R, G and B of the projector land, relative to its lens.
    color : 3 floats
        Reflectance in the camera's channels; `texture` is how far it varies, as a fraction.
    ambient : float
        Light that the projector does not send, relative to its white.
    falloff_mm : float
        Distance at which the projector's light counts one.
    object_motion_mm, object_turn_deg : 3 floats, float
        How far the objects, but not the wall behind them, have moved, and turned about an upright axis.
    field_motion_mm : 3 floats
        How far the objects move from one of the projector's colour fields to the next; zeros for a projector that shows
        all three at once. The truth is that of the first field.
    narrow_band : bool
        Whether the reflectance acts on the projector's primaries, before the crosstalk, or on the camera's channels.

    Returns
    -------
    SceneTruth
        The light at the camera, and the truth.

    Raises
    ------
    ShapeError
        An array has another shape or dtype.
    """
    views, height, width = (int(n) for n in rays.shape[:3])
    rays = _checks.read_array("rays", rays, (views, height, width, 2), np.float32)
    light = _checks.read_array("light", light, (None, None, 3), np.float32)
    truth = SceneTruth(
        np.empty((height, width, 3), np.float32),
        np.empty((height, width, 2), np.float32),
        np.empty((height, width, 3), np.float32),
        np.empty((height, width, 3), np.float32),
        np.empty((height, width), np.uint8),
    )
    m = projector_matrix
    lens = np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *projector_distortion], np.float32)
    fields = 3 if any(field_motion_mm) else 1
    _render_scene_kernel(scene, views, fields, narrow_band)(
        rays,
        light,
        mat3(crosstalk_matrix.tolist()),
        mat3(rotation.tolist()),
        vec3(translation_mm.tolist()),
        lens,
        projector_shift_px.astype(np.float32),
        vec3(color),
        texture,
        ambient,
        falloff_mm,
        vec3(object_motion_mm),
        float(np.radians(object_turn_deg)),
        vec3(field_motion_mm),
        *truth,
    )
    return truth
