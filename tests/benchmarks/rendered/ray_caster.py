"""What the camera's rays find, and the light that comes back: rays against bodies in double precision, as kernels.

A pixel is the mean of rays spread over its area and the camera lens's blur. A ray ends on a body, from where another
one asks whether the projector is seen; its light is read off pictures of the pattern, blurred by the projector's lens.
Rays near the border look beyond it, so the blur has all that it needs there.
"""

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import numpy.typing as npt

from pipeline.calibration.model import Geometry
from tikernels._taichi import ti

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]

#: Kinds of bodies.
BOX, BALL, CAPSULE, RELIEF = range(4)
#: No body.
NOTHING = 255
# Light is one on a surface that faces the projector at this distance, mm.
_REFERENCE_MM = 900.0
#: Rays a pixel; pairs of them lie opposite each other.
RAYS = 32
# Along a relief a ray goes in steps of this many grid cells, then by secants.
_STRIDE, _HALVES = 2.0, 9
_FAR = 1e9

vec3 = ti.types.vector(3, ti.f64)
F64Array1, F64Array2, F64Array3, F64Array4 = (ti.types.ndarray(dtype=ti.f64, ndim=n) for n in range(1, 5))
F32Array4 = ti.types.ndarray(dtype=ti.f32, ndim=4)
U8Array3 = ti.types.ndarray(dtype=ti.u8, ndim=3)
I32Array2 = ti.types.ndarray(dtype=ti.i32, ndim=2)

# Numbers of a body, in a row of `Bodies.numbers`: turn from the world (9), origin (3), sizes (3), grid cells a mm.
_TURN, _ORIGIN, _SIZES, _CELLS, _GLOSS, _SHININESS = 0, 9, 12, 15, 16, 17


@dataclass(frozen=True)
class Bodies:
    """What stands before the camera; see `bodies.py`."""

    kinds: npt.NDArray[np.int32]  # (N, 3) kind, the relief's number, the paint map's number
    numbers: F64  # (N, 18)
    reliefs: F64  # (R, G, G) mm towards the body's -z; -1e4: none
    maps: npt.NDArray[np.uint8]  # (M, G, G) numbers of paints, over the body's x and y


@dataclass(frozen=True)
class Truth:
    """What is true at the pixels' centres, (H, W)."""

    place: F64  # projector px along the phase; NaN where there is nothing
    depth_mm: F32
    lit: npt.NDArray[np.bool_]
    body: npt.NDArray[np.uint8]  # NOTHING
    paint: npt.NDArray[np.uint8]
    mm_per_rad: F32  # by how much the depth along the ray changes with the phase


@ti.func
def relief_at(reliefs: ti.template(), number: ti.i32, x: ti.f64, y: ti.f64, cells: ti.f64) -> ti.f64:
    """Return the height of a relief, linear between the places of its grid."""
    size = reliefs.shape[1]
    gx, gy = x * cells + 0.5 * (size - 1), y * cells + 0.5 * (size - 1)
    height = ti.f64(-1e4)
    if (gx >= 0) & (gy >= 0) & (gx < size - 1) & (gy < size - 1):
        i, j = ti.i32(gx), ti.i32(gy)
        fx, fy = gx - i, gy - j
        upper = reliefs[number, j, i] * (1 - fx) + reliefs[number, j, i + 1] * fx
        lower = reliefs[number, j + 1, i] * (1 - fx) + reliefs[number, j + 1, i + 1] * fx
        height = upper * (1 - fy) + lower * fy
    return height


@ti.func
def into_body(numbers: ti.template(), k: ti.i32, place: vec3, is_place: ti.f64) -> vec3:
    """Return a place, or a direction, in a body's own frame."""
    origin = vec3(numbers[k, _ORIGIN], numbers[k, _ORIGIN + 1], numbers[k, _ORIGIN + 2])
    away = place - is_place * origin
    found = vec3(0.0)
    for i in ti.static(range(3)):
        for j in ti.static(range(3)):
            found[i] += numbers[k, _TURN + 3 * i + j] * away[j]
    return found


@ti.func
def out_of_body(numbers: ti.template(), k: ti.i32, direction: vec3) -> vec3:
    """Return a direction of a body's frame in the world's."""
    found = vec3(0.0)
    for i in ti.static(range(3)):
        for j in ti.static(range(3)):
            found[j] += numbers[k, _TURN + 3 * i + j] * direction[i]
    return found


@ti.func
def meet_box(o: vec3, d: vec3, half: vec3):
    """Return where a ray enters a box, and the normal there."""
    nearest, farthest, axis = ti.f64(-_FAR), ti.f64(_FAR), 0
    for i in ti.static(range(3)):
        slope = ti.select(ti.abs(d[i]) < 1e-12, 1e-12, d[i])
        one, other = (-half[i] - o[i]) / slope, (half[i] - o[i]) / slope
        enters = ti.min(one, other)
        if enters > nearest:
            nearest, axis = enters, i
        farthest = ti.min(farthest, ti.max(one, other))
    normal = vec3(0.0)
    for i in ti.static(range(3)):
        if i == axis:
            normal[i] = ti.select(d[i] > 0, -1.0, 1.0)
    return ti.select((nearest < farthest) & (nearest > 0), nearest, ti.f64(_FAR)), normal


@ti.func
def meet_ball(o: vec3, d: vec3, radius: ti.f64):
    """Return where a ray of unit direction enters a ball, and the normal there."""
    b, c = o.dot(d), o.dot(o) - radius * radius
    root = b * b - c
    t = ti.f64(_FAR)
    if root > 0:
        t = -b - ti.sqrt(root)
    return ti.select(t > 0, t, ti.f64(_FAR)), (o + t * d) / radius


@ti.func
def meet_capsule(o: vec3, d: vec3, radius: ti.f64, half: ti.f64):
    """Return where a ray enters a rod with round ends along x, and the normal there."""
    t, normal = ti.f64(_FAR), vec3(0.0, 0.0, -1.0)
    a = d.y * d.y + d.z * d.z
    b, c = o.y * d.y + o.z * d.z, o.y * o.y + o.z * o.z - radius * radius
    root = b * b - a * c
    if root > 0:
        side = (-b - ti.sqrt(root)) / a
        at = o + side * d
        if (side > 0) & (ti.abs(at.x) < half):
            t, normal = side, vec3(0.0, at.y, at.z) / radius
    for end in ti.static((-1.0, 1.0)):
        middle = vec3(end * half, 0.0, 0.0)
        cap, there = meet_ball(o - middle, d, radius)
        if cap < t:
            t, normal = cap, there
    return t, normal


@ti.func
def meet_relief(reliefs: ti.template(), number: ti.i32, o: vec3, d: vec3, sizes: vec3, cells: ti.f64):
    """Return where a ray falls through a relief from above (its -z side), and the normal there."""
    enter, leave = ti.f64(0.0), ti.f64(_FAR)
    for i in ti.static(range(3)):
        slope = ti.select(ti.abs(d[i]) < 1e-12, 1e-12, d[i])
        low = ti.select(i == 2, -sizes[2], -sizes[i])
        high = ti.select(i == 2, ti.f64(1e-3), sizes[i])
        one, other = (low - o[i]) / slope, (high - o[i]) / slope
        enter, leave = ti.max(enter, ti.min(one, other)), ti.min(leave, ti.max(one, other))
    t, normal = ti.f64(_FAR), vec3(0.0, 0.0, -1.0)
    if enter < leave:
        step = _STRIDE / cells / ti.max(ti.sqrt(d.x * d.x + d.y * d.y), 0.2)
        before = enter
        at = o + before * d
        above = -at.z - relief_at(reliefs, number, at.x, at.y, cells)
        while (before < leave) & (t == _FAR):
            after = before + step
            at = o + after * d
            height = -at.z - relief_at(reliefs, number, at.x, at.y, cells)
            if (above > 0) & (height <= 0):
                low, high, high_at = before, after, height
                for _ in range(_HALVES):  # the secant's place, of which the relief between grid places needs few
                    middle = low + (high - low) * ti.min(ti.max(above / (above - high_at), 0.05), 0.95)
                    at = o + middle * d
                    here = -at.z - relief_at(reliefs, number, at.x, at.y, cells)
                    if here > 0:
                        low, above = middle, here
                    else:
                        high, high_at = middle, here
                at = o + high * d
                if ti.abs(-at.z - relief_at(reliefs, number, at.x, at.y, cells)) < 0.05:  # not a cliff at its end
                    t, cell = high, 1.0 / cells
                    slope_x = relief_at(reliefs, number, at.x + cell, at.y, cells)
                    slope_x -= relief_at(reliefs, number, at.x - cell, at.y, cells)
                    slope_y = relief_at(reliefs, number, at.x, at.y + cell, cells)
                    slope_y -= relief_at(reliefs, number, at.x, at.y - cell, cells)
                    normal = vec3(-0.5 * cells * slope_x, -0.5 * cells * slope_y, -1.0).normalized()
            before, above = after, height
    return t, normal


@ti.func
def meet(kinds: ti.template(), numbers: ti.template(), reliefs: ti.template(), origin: vec3, direction: vec3):
    """Return how far a ray of unit direction goes, the body that it meets, and the normal there."""
    nearest, found, normal = ti.f64(_FAR), ti.i32(-1), vec3(0.0)
    for k in range(kinds.shape[0]):
        o, d = into_body(numbers, k, origin, 1.0), into_body(numbers, k, direction, 0.0)
        sizes = vec3(numbers[k, _SIZES], numbers[k, _SIZES + 1], numbers[k, _SIZES + 2])
        t, facing = ti.f64(_FAR), vec3(0.0)
        if kinds[k, 0] == BOX:
            t, facing = meet_box(o, d, sizes)
        elif kinds[k, 0] == BALL:
            t, facing = meet_ball(o, d, sizes[0])
        elif kinds[k, 0] == CAPSULE:
            t, facing = meet_capsule(o, d, sizes[0], sizes[1])
        else:
            t, facing = meet_relief(reliefs, kinds[k, 1], o, d, sizes, numbers[k, _CELLS])
        if t < nearest:
            nearest, found, normal = t, k, out_of_body(numbers, k, facing)
    return nearest, found, normal


@ti.func
def paint_at(kinds: ti.template(), numbers: ti.template(), maps: ti.template(), k: ti.i32, place: vec3) -> ti.i32:
    """Return the number of the paint at a place on a body."""
    at = into_body(numbers, k, place, 1.0)
    size = maps.shape[1]
    cells = size / (2 * ti.max(numbers[k, _SIZES], numbers[k, _SIZES + 1]))
    i = ti.min(ti.max(ti.i32(at.x * cells + 0.5 * size), 0), size - 1)
    j = ti.min(ti.max(ti.i32(at.y * cells + 0.5 * size), 0), size - 1)
    return ti.i32(maps[kinds[k, 2], j, i])


@ti.func
def projected(projector: ti.template(), place: vec3) -> vec3:
    """Return where a place is in the projector's picture, px, and its depth there."""
    at = vec3(0.0)
    for i in ti.static(range(3)):
        at[i] = projector[9 + i]
        for j in ti.static(range(3)):
            at[i] += projector[3 * i + j] * place[j]
    x, y = at.x / at.z, at.y / at.z
    r2 = x * x + y * y
    bent = 1 + r2 * (projector[16] + r2 * (projector[17] + r2 * projector[20]))
    u = x * bent + 2 * projector[18] * x * y + projector[19] * (r2 + 2 * x * x)
    v = y * bent + projector[18] * (r2 + 2 * y * y) + 2 * projector[19] * x * y
    return vec3(projector[12] * u + projector[14], projector[13] * v + projector[15], at.z)


@ti.func
def light_in(light: ti.template(), sharp: ti.i32, x: ti.f64, y: ti.f64, primary: ti.i32) -> ti.f64:
    """Return one primary's light at a place of the pictures of a level, linear between their steps."""
    i = ti.min(ti.max(ti.i32(ti.floor(x)), 0), light.shape[2] - 2)
    j = ti.min(ti.max(ti.i32(ti.floor(y)), 0), light.shape[1] - 2)
    fx, fy = ti.min(ti.max(x - i, 0.0), 1.0), ti.min(ti.max(y - j, 0.0), 1.0)
    upper = light[sharp, j, i, primary] * (1 - fx) + light[sharp, j, i + 1, primary] * fx
    lower = light[sharp, j + 1, i, primary] * (1 - fx) + light[sharp, j + 1, i + 1, primary] * fx
    return upper * (1 - fy) + lower * fy


@ti.func
def light_of(light: ti.template(), x: ti.f64, y: ti.f64, primary: ti.i32, level: ti.f64) -> ti.f64:
    """Return one primary's light at a place (in the pictures' steps), under a blur (in their levels) more."""
    sharp = ti.min(ti.i32(level), light.shape[0] - 1)
    found = light_in(light, sharp, x, y, primary)
    if level > sharp and sharp < light.shape[0] - 1:
        found += (level - sharp) * (light_in(light, sharp + 1, x, y, primary) - found)
    return found


@ti.func
def irradiance(
    kinds: ti.template(), numbers: ti.template(), reliefs: ti.template(), projector: ti.template(), place: vec3,
    normal: vec3, to_camera: vec3, k: ti.i32,
):  # fmt: skip
    """Return what of the projector's light arrives, what a clear coat mirrors of it, and whence it comes (u, v, z)."""
    lamp = vec3(projector[21], projector[22], projector[23])
    to_lamp = lamp - place
    reach = to_lamp.norm()
    to_lamp = to_lamp / reach
    at = projected(projector, place)
    cosine = normal.dot(to_lamp)
    diffuse, glossy = ti.f64(0.0), ti.f64(0.0)
    inside = (at.z > 0) & (at.x > -0.5) & (at.y > -0.5) & (at.x < projector[24] - 0.5) & (at.y < projector[25] - 0.5)
    if inside & (cosine > 0):
        blocked, _, _ = meet(kinds, numbers, reliefs, place + 1e-3 * normal, to_lamp)
        if blocked > reach:
            diffuse = cosine * (_REFERENCE_MM / reach) ** 2
            if numbers[k, _GLOSS] > 0:  # Blinn's lobe, and Schlick's rise towards grazing
                half = (to_lamp + to_camera).normalized()
                lobe = ti.max(normal.dot(half), 0.0) ** numbers[k, _SHININESS] * (numbers[k, _SHININESS] + 8) / 8
                bent = 1 - ti.min(ti.max(to_lamp.dot(half), 0.0), 1.0)
                glossy = diffuse * lobe * (numbers[k, _GLOSS] + (1 - numbers[k, _GLOSS]) * bent**5)
    return diffuse, glossy, at


@ti.kernel
def photograph(
    rays: F64Array3,  # (H + 2, W + 2, 2) at unit depth, a pixel of margin
    offsets: F64Array2,  # (S, 2) px, of the rays of a pixel
    magnified: F64Array1,  # (3,) of the camera's channels, lateral colour; equal: one ray does for all
    kinds: I32Array2,
    numbers: F64Array2,
    reliefs: F64Array3,
    maps: U8Array3,
    projector: F64Array1,  # see `_projector_numbers`
    shifted: F64Array1,  # (3,) magnification of the projector's primaries
    light: F32Array4,  # (levels of blur, rows, columns, K * 3)
    table: F64Array1,  # steps a px, margin px, px of blur a level
    matrices: F64Array3,  # (P, 3, 3) of each paint
    clear: F64Array2,  # (3, 3) of a mirror
    ambient: F64Array2,  # (P, 3)
    scatter: F64Array2,  # (P, 3) mm by which a paint's light spreads, of each primary
    film: F32Array4,  # out: (K, H, W, 3) linear light; (K * 3, H, W, 3): each primary's, with a third of the room's
):
    """Take all patterns at once."""
    patterns, height, width = light.shape[3] // 3, film.shape[1], film.shape[2]
    films = film.shape[0] // patterns  # of a pattern
    for y, x in ti.ndrange(height, width):
        together = magnified[0] == magnified[1] and magnified[1] == magnified[2]
        across_x, across_y = (
            0.5 * (rays[y + 1, x + 2, 0] - rays[y + 1, x, 0]),
            0.5 * (rays[y + 1, x + 2, 1] - rays[y + 1, x, 1]),
        )
        down_x, down_y = (
            0.5 * (rays[y + 2, x + 1, 0] - rays[y, x + 1, 0]),
            0.5 * (rays[y + 2, x + 1, 1] - rays[y, x + 1, 1]),
        )
        for p in range(film.shape[0]):
            for c in ti.static(range(3)):
                film[p, y, x, c] = 0.0
        for group in range(ti.select(together, 1, 3)):
            for s in range(offsets.shape[0]):
                ray = vec3(
                    rays[y + 1, x + 1, 0] + offsets[s, 0] * across_x + offsets[s, 1] * down_x,
                    rays[y + 1, x + 1, 1] + offsets[s, 0] * across_y + offsets[s, 1] * down_y,
                    1.0,
                )
                ray.x /= magnified[group]
                ray.y /= magnified[group]
                ray = ray.normalized()
                far, k, normal = meet(kinds, numbers, reliefs, vec3(0.0), ray)
                if k >= 0:
                    place = far * ray
                    paint = paint_at(kinds, numbers, maps, k, place)
                    diffuse, glossy, at = irradiance(kinds, numbers, reliefs, projector, place, normal, -ray, k)
                    columns, rows, levels = vec3(0.0), vec3(0.0), vec3(0.0)
                    for j in ti.static(range(3)):
                        u = projector[14] + (at.x - projector[14]) * shifted[j]
                        v = projector[15] + (at.y - projector[15]) * shifted[j]
                        columns[j] = (u + 0.5 + table[1]) * table[0] - 0.5
                        rows[j] = (v + 0.5 + table[1]) * table[0] - 0.5
                        levels[j] = scatter[paint, j] * projector[12] / at.z / table[2]
                    for p in range(patterns):
                        arrives = vec3(0.0)
                        if diffuse > 0:
                            for j in ti.static(range(3)):
                                arrives[j] = light_of(light, columns[j], rows[j], 3 * p + j, levels[j])
                        for c in ti.static(range(3)):
                            if together or c == group:
                                seen = ti.f64(0.0)
                                for j in ti.static(range(3)):
                                    seen += ambient[paint, c] / 3
                                    seen += (matrices[paint, c, j] * diffuse + clear[c, j] * glossy) * arrives[j]
                                    if films == 3 or j == 2:
                                        film[films * p + (films - 1) * j // 2, y, x, c] += ti.f32(
                                            seen / offsets.shape[0]
                                        )
                                        seen = 0.0


@ti.kernel
def gather(
    rays: F64Array3,
    directions: F64Array2,  # (N, 3) about a normal along z, as likely as their cosine
    kinds: I32Array2,
    numbers: F64Array2,
    reliefs: F64Array3,
    maps: U8Array3,
    projector: F64Array1,
    light: F32Array4,
    table: F64Array1,
    matrices: F64Array4,  # (P * P, 3, 3, 1) of light that one paint sends to another
    spacing: ti.i32,
    found: F32Array4,  # out: (K, Hg, Wg, 3) linear light that another surface has sent here
):
    """Gather the light of one bounce more, at every so many pixels."""
    paints = ti.cast(ti.sqrt(ti.cast(matrices.shape[0], ti.f64)) + 0.5, ti.i32)
    for gy, gx in ti.ndrange(found.shape[1], found.shape[2]):
        y, x = ti.min(gy * spacing, rays.shape[0] - 3), ti.min(gx * spacing, rays.shape[1] - 3)
        ray = vec3(rays[y + 1, x + 1, 0], rays[y + 1, x + 1, 1], 1.0).normalized()
        far, k, normal = meet(kinds, numbers, reliefs, vec3(0.0), ray)
        for p in range(found.shape[0]):
            for c in ti.static(range(3)):
                found[p, gy, gx, c] = 0.0
        if k >= 0:
            here = paint_at(kinds, numbers, maps, k, far * ray)
            above = far * ray + 1e-3 * normal
            side = vec3(0.0, 1.0, 0.0).cross(normal).normalized()
            up = normal.cross(side)
            for n in range(directions.shape[0]):
                out = directions[n, 0] * side + directions[n, 1] * up + directions[n, 2] * normal
                reach, other, facing = meet(kinds, numbers, reliefs, above, out)
                if other >= 0:
                    place = above + reach * out
                    there = paint_at(kinds, numbers, maps, other, place)
                    diffuse, _, at = irradiance(kinds, numbers, reliefs, projector, place, facing, -out, other)
                    column, row = (at.x + 0.5 + table[1]) * table[0] - 0.5, (at.y + 0.5 + table[1]) * table[0] - 0.5
                    if diffuse > 0:
                        for p in range(found.shape[0]):
                            for c in ti.static(range(3)):
                                for j in ti.static(range(3)):
                                    sent = matrices[here * paints + there, c, j, 0] * diffuse
                                    sent *= light_of(light, column, row, 3 * p + j, 0.0) / directions.shape[0]
                                    found[p, gy, gx, c] += ti.f32(sent)


@ti.kernel
def look(
    rays: F64Array3,
    kinds: I32Array2,
    numbers: F64Array2,
    reliefs: F64Array3,
    maps: U8Array3,
    projector: F64Array1,
    axis: ti.i32,
    found: F64Array3,  # out: (H, W, 6) place along the phase, depth, irradiance, body, paint, px a mm of depth
):
    """Find what is true at the pixels' centres."""
    for y, x in ti.ndrange(found.shape[0], found.shape[1]):
        ray = vec3(rays[y + 1, x + 1, 0], rays[y + 1, x + 1, 1], 1.0)
        far, k, normal = meet(kinds, numbers, reliefs, vec3(0.0), ray.normalized())
        found[y, x, 3] = NOTHING
        if k >= 0:
            place = far * ray.normalized()
            diffuse, _, at = irradiance(kinds, numbers, reliefs, projector, place, normal, -ray.normalized(), k)
            found[y, x, 0] = at[axis]
            found[y, x, 1] = place.z
            found[y, x, 2] = diffuse
            found[y, x, 3] = k
            found[y, x, 4] = paint_at(kinds, numbers, maps, k, place)
            found[y, x, 5] = (
                projected(projector, place + 0.5 * ray)[axis] - projected(projector, place - 0.5 * ray)[axis]
            )


def rays_of(geometry: Geometry) -> F64:
    """Return (H + 2, W + 2, 2) where the pixels' centres look, with a pixel of margin."""
    width, height = geometry.camera.size_px
    x, y = np.meshgrid(np.arange(-1.0, width + 1), np.arange(-1.0, height + 1))
    return geometry.camera.rays_through(np.stack([x.ravel(), y.ravel()], axis=-1)).reshape(height + 2, width + 2, 2)


def rows_of_rays(rays: F64, rows: slice) -> F64:
    """Return the rays of some rows, with their margin."""
    first, end, _ = rows.indices(rays.shape[0] - 2)
    return np.ascontiguousarray(rays[first : end + 2])


def pixel_rays(blur_px: float, rays: int = RAYS) -> F64:
    """Return (S, 2) places of a pixel's rays: even over its area, spread by the lens's blur.

    They follow a sequence that fills space evenly (M. Roberts 2018, the generalised golden ratio).
    """
    normal = np.vectorize(NormalDist().inv_cdf)
    number = np.arange(1, rays // 2 + 1)[:, None]
    plastic = 1.324717957244746
    even = (0.5 + number / plastic ** np.arange(1, 5)) % 1
    half = even[:, :2] - 0.5 + blur_px * normal(even[:, 2:])
    return np.concatenate([half, -half])


def cosine_directions(count: int) -> F64:
    """Return (count, 3) directions about z, as likely as their cosine (R2 sequence)."""
    number, plastic = np.arange(count), 1.324717957244746
    first, second = (0.5 + number / plastic) % 1, (0.5 + number / plastic**2) % 1
    radius, turn = np.sqrt(first), 2 * np.pi * second
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - first)], axis=-1)


def projector_numbers(geometry: Geometry) -> F64:
    """Return what kernels know of the projector: turn, translation, lens, centre, size."""
    lens = geometry.projector
    matrix = lens.matrix
    return np.array(
        [
            *geometry.rotation.ravel(), *geometry.translation_mm,
            matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *lens.distortion,
            *(-geometry.rotation.T @ geometry.translation_mm), *lens.size_px,
        ]
    )  # fmt: skip


def true_at_centers(geometry: Geometry, bodies: Bodies, rays: F64 | None = None) -> Truth:
    """Return the truth of what is seen, by all rays or those of some rows."""
    rays = rays_of(geometry) if rays is None else rays
    found = np.zeros((rays.shape[0] - 2, rays.shape[1] - 2, 6))
    seen = (bodies.kinds, bodies.numbers, bodies.reliefs, bodies.maps)
    look(rays, *seen, projector_numbers(geometry), geometry.phase_axis, found)
    nowhere = found[..., 3] == NOTHING
    with np.errstate(divide="ignore"):
        slope = 2 * np.pi / geometry.pattern.period_px * found[..., 5]
        mm_per_rad = np.where(nowhere, np.nan, 1 / slope).astype(np.float32)
    return Truth(
        place=np.where(nowhere, np.nan, found[..., 0]),
        depth_mm=np.where(nowhere, np.nan, found[..., 1]).astype(np.float32),
        lit=found[..., 2] > 0,
        body=found[..., 3].astype(np.uint8),
        paint=found[..., 4].astype(np.uint8),
        mm_per_rad=mm_per_rad,
    )
