"""Intersect rays with a scene; find the surface's normal there, and whether something shades it.

Rays advance by the distance to the nearest surface until there is none left (J. C. Hart, Sphere tracing, The Visual
Computer 12, 1996, doi:10.1007/s003710050084).
"""

from functools import cache
from typing import Any

from tikernels._taichi import f32, i32, ti, vec3, vec4
from tikernels.scene.scene_shapes import scene_distance

#: Every scene lies between these depths: rays start at the first, end at the second, and cast no shadow before it.
NEAR_MM = 700.0
FAR_MM = 1200.0
# A hit is refined below this distance: 1e-3 mm is 1e-4 rad of phase on a rig with a 180 mm baseline.
_HIT_MM = 1e-3
_MAX_STEPS = 200
# The surface's own tolerance must not shadow it: a shadow's ray starts this far from it, goes on by half a millimetre
# at least, and meets a surface within a hundredth.
_SHADOW_START_MM, _SHADOW_STEP_MM, _SHADOW_HIT_MM = 2.0, 0.5, 0.01
# Normals are differences over this, mm.
_NORMAL_STEP_MM = 0.25


@cache
def ray_casting(scene: str) -> tuple[Any, Any, Any]:
    """Return the `ti.func`s `trace`, `shadowed` and `normal_at` of a scene.

    Their `pose` is how far the objects have moved, mm, and turned, rad.
    """
    distance_to = scene_distance(scene)

    @ti.func
    def trace(ray: vec3, pose: vec4) -> f32:
        """Depth of the first surface along a ray of unit depth; beyond FAR_MM: none."""
        length = ray.norm()
        depth = NEAR_MM
        gap = 1.0
        steps = 0
        while gap > _HIT_MM and depth < FAR_MM and steps < _MAX_STEPS:
            gap = distance_to(ray * depth, pose)
            depth += gap / length
            steps += 1
        return depth

    @ti.func
    def shadowed(p: vec3, direction: vec3, pose: vec4) -> i32:
        """Return whether something is between a point and the projector."""
        hidden = 0
        travelled = _SHADOW_START_MM
        while hidden == 0 and p.z + travelled * direction.z > NEAR_MM:
            gap = distance_to(p + travelled * direction, pose)
            if gap < _SHADOW_HIT_MM:
                hidden = 1
            travelled += ti.max(gap, _SHADOW_STEP_MM)
        return hidden

    @ti.func
    def normal_at(p: vec3, pose: vec4) -> vec3:
        """Direction in which the distance grows, of length one."""
        gradient = vec3(0.0)
        for k in range(4):  # corners of a tetrahedron; unrolled, a scene would take twice as long to compile
            x, y = 1.0 - 2.0 * (k // 2), 1.0 - 2.0 * (k % 2)
            corner = vec3(x, y, x * y)
            gradient += corner * distance_to(p + _NORMAL_STEP_MM * corner, pose)
        return gradient.normalized()

    return trace, shadowed, normal_at
