"""Render what the camera of a fringe-projection rig sees, with exact truth.

A scene is a signed distance field (`scene_shapes.py`); every camera ray is traced to its surface (`ray_casting.py`),
the point is carried into the projector, whose light is read off there (`projector_light.py`), and a second ray towards
the projector finds the shadows. A surface of reflectance r, turned by the angle theta from the projector at distance d,
sends r (a + L cos(theta) (falloff / d)^2) back of the projector's light L and ambient light a: Lambert's law and the
inverse square's. Because image and truth come from the same surface point, the truth is exact whatever the tracing's
own tolerance.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import (
    F32Array1,
    F32Array3,
    F32Array4,
    Static,
    U8Array2,
    f32,
    i32,
    mat3,
    ti,
    vec2,
    vec3,
    vec4,
)
from tikernels.arrays import F32
from tikernels.depth.lens_distortion import pack_lens
from tikernels.errors import ShapeError
from tikernels.launching import kernel
from tikernels.scene.projector_light import light_at, projector_pixel
from tikernels.scene.ray_casting import FAR_MM, ray_casting
from tikernels.scene.scene_colors import scene_color
from tikernels.scene.scene_shapes import SCENES, at_rest


class SceneTruth(NamedTuple):
    """Buffers that `render_scene` fills, all float32 unless said."""

    light: npt.NDArray[np.float32]  # (H, W, 3) linear light that reaches the camera, before blur and noise
    projector_px: npt.NDArray[np.float32]  # (H, W, 2) column, row in the projector; NaN where nothing is seen
    points: npt.NDArray[np.float32]  # (H, W, 3) mm, camera frame; NaN where nothing is seen
    reflectance: npt.NDArray[np.float32]  # (H, W, 3) per camera channel
    lit: npt.NDArray[np.uint8]  # (H, W) 1 where the projector's light arrives


@ti.func
def write_truth(
    y: i32,
    x: i32,
    pixel: vec2,
    p: vec3,
    reflectance: vec3,
    lit: i32,
    out_projector_px: F32Array3,
    out_points: F32Array3,
    out_reflectance: F32Array3,
    out_lit: U8Array2,
):
    """Note what a camera pixel sees."""
    out_lit[y, x] = ti.cast(lit, ti.u8)
    for k in ti.static(range(2)):
        out_projector_px[y, x, k] = pixel[k]
    for k in ti.static(range(3)):
        out_points[y, x, k] = p[k]
        out_reflectance[y, x, k] = reflectance[k]


@ti.func
def inside_frame(pixel: vec2, light: F32Array3) -> i32:
    """Return whether the projector has a pixel there."""
    across = pixel.x >= -0.5 and pixel.x <= light.shape[1] - 0.5
    return across and pixel.y >= -0.5 and pixel.y <= light.shape[0] - 0.5


@ti.func
def only_field(irradiance: vec3, field: i32, fields: Static) -> vec3:
    """Keep the colour that the projector shows, where it shows one at a time; ambient light is there all the time."""
    result = irradiance
    if ti.static(fields == 3):
        for j in ti.static(range(3)):
            if j != field:
                result[j] = 0.0
    return result


@ti.func
def only_view(seen: vec3, view: i32, views: Static) -> vec3:
    """Keep the channel that sees along these rays, where each has rays of its own."""
    result = seen
    if ti.static(views == 3):
        for i in ti.static(range(3)):
            if i != view:
                result[i] = 0.0
    return result


@ti.func
def sent_back(irradiance: vec3, reflectance: vec3, crosstalk: mat3, narrow_band: Static) -> vec3:
    """Return the camera's channels of a surface under this light of the projector's primaries."""
    seen = vec3(0.0)
    if ti.static(narrow_band):
        seen = crosstalk @ (reflectance * irradiance)
    else:
        seen = reflectance * (crosstalk @ irradiance)
    return seen


@cache
def _render_scene_kernel(scene: str, views: int, fields: int, narrow_band: bool) -> Any:
    """Specialise the renderer.

    `views` is 3 where camera channels see along rays of their own, else 1; `fields` is 3 where the projector shows its
    colours one after another, else 1.
    """
    trace, shadowed, normal_at = ray_casting(scene)
    color_of = scene_color(scene)

    @ti.func
    def light_on(p: vec3, pose: vec4, centre: vec3, pixel: vec2, light: F32Array3, falloff: f32):
        """Return whether the projector lights a point, and which share of its light arrives if it does."""
        towards = centre - p
        distance = towards.norm()
        direction = towards / distance
        slope = normal_at(p, pose).dot(direction)
        lit = 0
        if slope > 0.0 and inside_frame(pixel, light):
            lit = 1 - shadowed(p, direction, pose)
        return lit, slope * (falloff / distance) ** 2

    # Without flow analysis frames of a seed would differ in single levels.
    @kernel(flow_analysis=True)
    def render_scene_kernel(
        rays: F32Array4,  # (views, H, W, 2) unit-depth rays, lens distortion taken out
        light: F32Array3,  # (Hp, Wp, 3) linear projector light, 0..1
        crosstalk: mat3,
        rotation: mat3,  # X_projector = rotation X_camera + translation
        translation: vec3,  # mm
        optics: F32Array1,  # (31,) the projector's, see `projector_light.py`
        falloff_mm: f32,  # distance at which the projector's light counts 1
        surface: vec4,  # reflectance in the camera's channels, texture
        ambient: f32,
        first_pose: vec4,  # mm that the objects, but not the wall, have moved; rad that they have turned
        field_motion: vec3,  # mm that the objects move from one colour field to the next
        out_light: F32Array3,
        out_projector_px: F32Array3,
        out_points: F32Array3,
        out_reflectance: F32Array3,
        out_lit: U8Array2,
    ):
        """Trace every pixel's rays; the truth is that of the first field, as green sees it."""
        height, width = out_lit.shape[0], out_lit.shape[1]
        centre = -(rotation.transpose() @ translation)
        truth = ti.static((out_projector_px, out_points, out_reflectance, out_lit))
        for number in range(height * width):
            y, x = number // width, number % width
            radiance = vec3(0.0)
            write_truth(y, x, vec2(ti.math.nan), vec3(ti.math.nan), vec3(0.0), 0, *truth)
            for view in range(views):
                ray = vec3(rays[view, y, x, 0], rays[view, y, x, 1], 1.0)
                for field in range(fields):
                    motion = field_motion * ti.cast(field, ti.f32)
                    pose = first_pose + vec4(motion.x, motion.y, motion.z, 0.0)
                    depth = trace(ray, pose)
                    if depth < FAR_MM:
                        p = ray * depth
                        reflectance = color_of(at_rest(p, pose), surface)
                        pixel = projector_pixel(p, rotation, translation, optics)
                        lit, shade = light_on(p, pose, centre, pixel, light, falloff_mm)
                        irradiance = vec3(ambient)
                        if lit == 1:
                            irradiance += shade * light_at(light, pixel, optics)
                        irradiance = only_field(irradiance, field, fields)
                        seen = sent_back(irradiance, reflectance, crosstalk, narrow_band)
                        radiance += only_view(seen, view, views)
                        if field == 0 and (views == 1 or view == 1):
                            write_truth(y, x, pixel, p, reflectance, lit, *truth)
            for i in ti.static(range(3)):
                out_light[y, x, i] = radiance[i]

    return render_scene_kernel


def render_scene(
    scene: str,
    rays: F32,
    light: F32,
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
        Distance by which the objects, but not the wall behind them, have moved, and angle about an upright axis.
    field_motion_mm : 3 floats
        Motion of the objects from one of the projector's colour fields to the next; zeros for a projector that shows
        all three at once. The truth is that of the first field.
    narrow_band : bool
        True if the reflectance acts on the projector's primaries, before the crosstalk, or on the camera's channels.

    Returns
    -------
    SceneTruth
        The light at the camera, and the truth.

    Raises
    ------
    ShapeError
        An array has another shape or dtype, or no scene has that name.
    """
    if scene not in SCENES:
        raise ShapeError(f"scene is {scene!r}: choose {', '.join(SCENES)}")
    views, height, width = (int(n) for n in rays.shape[:3])
    rays = checks.read_array("rays", rays, (views, height, width, 2), np.float32)
    light = checks.read_array("light", light, (None, None, 3), np.float32)
    truth = SceneTruth(
        np.empty((height, width, 3), np.float32),
        np.empty((height, width, 2), np.float32),
        np.empty((height, width, 3), np.float32),
        np.empty((height, width, 3), np.float32),
        np.empty((height, width), np.uint8),
    )
    m = projector_matrix
    optics = (*pack_lens(projector_distortion), m[0, 0], m[1, 1], m[0, 2], m[1, 2], *np.ravel(projector_shift_px))
    fields = 3 if any(field_motion_mm) else 1
    _render_scene_kernel(scene, views, fields, narrow_band)(
        rays,
        light,
        mat3(crosstalk_matrix.tolist()),
        mat3(rotation.tolist()),
        vec3(translation_mm.tolist()),
        np.array(optics, np.float32),
        falloff_mm,
        vec4(*color, texture),
        ambient,
        vec4(*object_motion_mm, float(np.radians(object_turn_deg))),
        vec3(field_motion_mm),
        *truth,
    )
    return truth
