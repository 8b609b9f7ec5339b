"""The colour of every scene: reflectances in the camera's channels that move with the objects."""

from functools import cache
from typing import Any

from tikernels._taichi import ti, vec3, vec4
from tikernels.scene.portrait import portrait_color


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
def painted(p: vec3, surface: vec4) -> vec3:
    """Return the colour of a portrait whose skin is the surface."""
    return portrait_color(p, surface_color(p, surface))


@cache
def scene_color(scene: str) -> Any:
    """Return the `ti.func` that colours a scene: from a point at rest, and the surface, to its reflectance."""
    return painted if scene == "portrait" else surface_color
