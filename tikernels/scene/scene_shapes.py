"""The scenes as signed distance fields in the camera's frame (mm).

A distance field is negative inside a surface, positive outside, and nowhere steeper than one, so that a ray may always
go on by it. A scene's objects, but not the wall behind them, may have moved.
"""

from functools import cache
from typing import Any

from tikernels._taichi import f32, ti, vec3, vec4
from tikernels.scene.portrait import person
from tikernels.scene.solids import ellipsoid, smooth_cut, smooth_union

#: Shapes of one colour, nearly.
SHAPES = ("bust", "plane", "waves", "objects", "ball")
#: The portrait is a person (`portrait.py`).
SCENES = (*SHAPES, "portrait")

# Depth of the upright axis that objects turn about.
_AXIS_MM = 880.0
# Further than this from what holds the person their own distance is not worth computing; a film renders a fifth faster.
_AROUND_MM = 10.0


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
def around_person(p: vec3) -> f32:
    """Distance to a sphere that holds the head, and to a corner that holds neck and shoulders."""
    sphere = (p - vec3(0.0, -25.0, 845.0)).norm() - 126.0
    return ti.min(sphere, ti.max(764.0 - p.z, 70.0 - p.y))


@ti.func
def wall(p: vec3, depth_mm: f32) -> f32:
    """Distance to a wall that leans back a little."""
    return (depth_mm + 0.06 * p.x - 0.04 * p.y - p.z) / ti.sqrt(1.0 + 0.06 * 0.06 + 0.04 * 0.04)


@ti.func
def at_rest(p: vec3, pose: vec4) -> vec3:
    """Carry a point back to before the objects moved and turned.

    `pose` is how far they have moved, mm, and turned, rad, about an upright axis through them.
    """
    q = p - vec3(pose.x, pose.y, pose.z) - vec3(0.0, 0.0, _AXIS_MM)
    c, s = ti.cos(pose.w), ti.sin(pose.w)
    return vec3(c * q.x - s * q.z, q.y, s * q.x + c * q.z + _AXIS_MM)


@cache
def scene_distance(scene: str) -> Any:
    """Return a `ti.func`: the distance to a scene whose objects, but not its wall, have moved."""
    if scene == "bust":

        @ti.func
        def distance_to(p: vec3, pose: vec4) -> f32:
            return ti.min(bust(at_rest(p, pose)), wall(p, 985.0))

    elif scene == "portrait":

        @ti.func
        def distance_to(p: vec3, pose: vec4) -> f32:
            q = at_rest(p, pose)
            distance = around_person(q)
            if distance < _AROUND_MM:
                distance = person(q)
            return ti.min(distance, wall(p, 985.0))

    elif scene == "plane":

        @ti.func
        def distance_to(p: vec3, pose: vec4) -> f32:
            q = at_rest(p, pose)
            return (900.0 + 0.25 * q.x + 0.2 * q.y - q.z) / ti.sqrt(1.0 + 0.0625 + 0.04)

    elif scene == "waves":

        @ti.func
        def distance_to(p: vec3, pose: vec4) -> f32:
            q = at_rest(p, pose)
            height = 9.0 * ti.sin(q.x * 0.055) * ti.cos(q.y * 0.05) + 5.0 * ti.sin(q.x * 0.02 + q.y * 0.08)
            return (900.0 + height - q.z) * 0.75  # the slope stays under 0.8

    elif scene == "objects":

        @ti.func
        def distance_to(p: vec3, pose: vec4) -> f32:
            q = at_rest(p, pose)
            ball = (q - vec3(-130.0, -60.0, 880.0)).norm() - 62.0
            egg = ellipsoid(q - vec3(120.0, 45.0, 930.0), vec3(85.0, 60.0, 50.0))
            box = ti.abs(q - vec3(-70.0, 100.0, 960.0) - vec3(0.2 * q.y, 0.0, 0.3 * q.x)) - vec3(70.0, 32.0, 40.0)
            rounded = ti.max(box, 0.0).norm() + ti.min(ti.max(box.x, ti.max(box.y, box.z)), 0.0) - 10.0
            return ti.min(ball, ti.min(egg, rounded * 0.8))

    else:

        @ti.func
        def distance_to(p: vec3, pose: vec4) -> f32:
            ball = (at_rest(p, pose) - vec3(0.0, 0.0, 880.0)).norm() - 85.0
            return ti.min(ball, wall(p, 985.0))

    return distance_to
