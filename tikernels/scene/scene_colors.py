"""The colour of every scene: reflectances in the camera's channels that move with the objects."""

from functools import cache
from typing import Any

from tikernels._taichi import f32, ti, vec2, vec3, vec4

# The middle of the bust's head (`scene_shapes.bust`), mm; its face is drawn in coordinates from there, y downwards.
_HEAD_MM = (0.0, -5.0, 850.0)
# Whatever lies behind the shoulders is the wall, wherever the bust has turned to.
_WALL_FROM_MM = 930.0
# Paint fades over this part of an ellipse's radius, 0.2 to 4 mm, and a border over so many millimetres.
_FADE, _BORDER_MM = 0.15, 4.0


@ti.func
def surface_color(p: vec3, surface: vec4) -> vec3:
    """Reflectance that varies slowly by +-texture, with one redder, darker blotch of about 30 mm.

    `surface` is the reflectance in the camera's channels, and the texture.
    """
    color, texture = vec3(surface.x, surface.y, surface.z), surface.w
    slow = ti.sin(0.021 * p.x + 0.4) * ti.cos(0.026 * p.y + 0.011 * p.x)
    blotch = ti.exp(-((p.x - 35.0) ** 2 + (p.y - 15.0) ** 2) / 800.0)
    tint = vec3(0.10, 0.35, 0.35) * blotch
    return color * (1.0 + texture * slow) * (1.0 - ti.min(4.0 * texture, 1.0) * tint)


@ti.func
def ramp(x: f32) -> f32:
    """Rise from 0 at -1 to 1 at 1, smoothly."""
    t = ti.min(ti.max(0.5 + 0.5 * x, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@ti.func
def spot(place: vec2, middle: vec2, radii: vec2) -> f32:
    """Return 1 inside an ellipse, 0 outside, with a soft rim."""
    return ramp((1.0 - ((place - middle) / radii).norm()) / _FADE)


@ti.func
def glow(place: vec2, middle: vec2, sigma_mm: f32) -> f32:
    """Return a Gaussian around a place."""
    return ti.exp(-0.5 * ((place - middle) / sigma_mm).norm_sqr())


@ti.func
def portrait_color(p: vec3, surface: vec4) -> vec3:
    """Paint the bust: skin of the surface's colour, flushed here and there, hair, brows, eyes, lips, a shirt.

    The paints are reflectances of people and cloth under white light, read off as red, green and blue.
    """
    q = p - vec3(_HEAD_MM[0], _HEAD_MM[1], _HEAD_MM[2])
    face, mirrored = vec2(q.x, q.y), vec2(ti.abs(q.x), q.y)
    hair, iris = vec3(0.15, 0.11, 0.08), vec3(0.14, 0.20, 0.24)
    flush = ti.max(glow(mirrored, vec2(40.0, 10.0), 16.0), 0.8 * glow(face, vec2(0.0, 12.0), 10.0))
    color = surface_color(p, surface) * (1.0 - flush * vec3(0.05, 0.20, 0.18))
    color *= 1.0 - spot(mirrored, vec2(28.0, -23.0), vec2(20.0, 14.0)) * vec3(0.12, 0.22, 0.20)
    color = ti.math.mix(color, vec3(0.60, 0.30, 0.30), spot(face, vec2(0.0, 41.0), vec2(24.0, 9.0)))
    color = ti.math.mix(color, vec3(0.35, 0.16, 0.16), spot(face, vec2(0.0, 41.0), vec2(23.0, 1.5)))
    color = ti.math.mix(color, hair, spot(mirrored, vec2(29.0, -42.0 - 0.06 * (mirrored.x - 29.0)), vec2(18.0, 3.5)))
    eye = spot(mirrored, vec2(28.0, -21.0), vec2(12.0, 4.8))
    color = ti.math.mix(color, vec3(0.70, 0.66, 0.64), eye)
    color = ti.math.mix(color, iris, eye * spot(mirrored, vec2(28.0, -22.0), vec2(5.5, 5.5)))
    color = ti.math.mix(color, 0.3 * iris, eye * spot(mirrored, vec2(28.0, -22.0), vec2(2.2, 2.2)))
    # The hairline falls from the forehead to the temples; the neckline is deepest in front.
    color = ti.math.mix(color, hair, ramp((0.012 * q.x * q.x - 76.0 - q.y) / _BORDER_MM))
    neckline = 112.0 + 26.0 * ti.exp(-((q.x / 40.0) ** 2))
    color = ti.math.mix(color, vec3(0.25, 0.35, 0.50), ramp((q.y - neckline) / _BORDER_MM))
    if p.z > _WALL_FROM_MM:
        color = vec3(0.45, 0.47, 0.46)
    return color


@cache
def scene_color(scene: str) -> Any:
    """Return the `ti.func` that colours a scene: from a point at rest, and the surface, to its reflectance."""
    return portrait_color if scene == "portrait" else surface_color
