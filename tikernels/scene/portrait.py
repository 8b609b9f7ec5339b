"""A person, head and shoulders around (0, 0, 850) mm, face towards the camera: shape and paint.

The masses of the head are ellipsoids joined with fillets; what is finer is added to the distance as smooth bumps. Eyes
and lips are drawn once, as curves in a plane before the face, which shape and paint share.
"""

from tikernels._taichi import f32, ti, vec2, vec3, vec4
from tikernels.scene.solids import ellipsoid, smooth_cut, smooth_union

# The middle of the head; all places below are relative to it, x to the right, y downwards, z away from the camera, mm.
_HEAD_MM = (0.0, -5.0, 850.0)
# Whatever lies behind the shoulders is the wall, wherever the person has turned to.
_WALL_FROM_MM = 930.0
# Bumps, which are up to so high, make the distance grow by up to 1.6 per mm: what a ray may go on by near to them.
_BUMPS_MM, _SAFE = 15.0, 0.75
# No feature of the face stands out by as much as the second, so further from the head than the first none is computed.
_FEATURES_MM, _STAND_OUT_MM = 45.0, 30.0
_EYE = (31.0, -21.0)
_MOUTH_HALF_MM = 25.0


@ti.func
def ramp(x: f32) -> f32:
    """Rise from 0 at -1 to 1 at 1, smoothly."""
    t = ti.min(ti.max(0.5 + 0.5 * x, 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@ti.func
def glow(place: vec2, middle: vec2, sigma: vec2) -> f32:
    """Return a Gaussian around a place."""
    return ti.exp(-0.5 * ((place - middle) / sigma).norm_sqr())


@ti.func
def bump(q: vec3, middle: vec3, sigma: vec3) -> f32:
    """Return a Gaussian around a point."""
    return ti.exp(-0.5 * ((q - middle) / sigma).norm_sqr())


@ti.func
def eye_opening(face: vec2) -> f32:
    """Return how far inside the almond between the lids a place is, mm; `face` has x mirrored to one side."""
    t = face.x - _EYE[0]
    across = 1.0 - (t / 13.0) ** 2
    y = face.y - _EYE[1] + 0.07 * t
    return ti.min(y + 4.7 * across, 3.7 * across - y)


@ti.func
def lips(face: vec2) -> vec4:
    """Return the lips' fullness, 1 in the middle and 0 at the corners, and y of their upper, middle and lower line."""
    full = ti.max(1.0 - (face.x / _MOUTH_HALF_MM) ** 2, 0.0)
    seam = 42.0 - 1.2 * full + 1.4 * ti.exp(-((face.x / 7.0) ** 2))
    bow = 1.6 * ti.exp(-(((ti.abs(face.x) - 6.5) / 4.0) ** 2))
    return vec4(full, seam - 5.5 * full - bow, seam, seam + 8.6 * full)


@ti.func
def neckline(x: f32) -> f32:
    """Return y of the shirt's edge, deepest in front."""
    return 112.0 + 24.0 * ti.exp(-((x / 42.0) ** 2))


@ti.func
def strands(q: vec3) -> f32:
    """Return how the hair lies, -1 to 1."""
    return ti.sin(0.32 * q.x + 0.16 * q.y + 1.4 * ti.sin(0.06 * q.y + 0.03 * q.x))


@ti.func
def hair_edge(q: vec3) -> f32:
    """Return how far above the hairline a point is, mm; it falls to the temples, and leaves the ears free."""
    return 0.0125 * q.x * q.x - 78.0 - 24.0 * ramp((ti.abs(q.x) - 76.0) / 8.0) + 3.0 * strands(q) - q.y


@ti.func
def with_features(q: vec3, head: f32) -> f32:
    """Add nose, eyes, mouth and chin to the distance to a head without a face."""
    # Bumps on both sides meet in the middle without an edge.
    face, mirrored = vec2(ti.abs(q.x), q.y), vec3(ti.sqrt(q.x * q.x + 9.0), q.y, q.z)
    distance = smooth_union(head, ellipsoid(mirrored - vec3(40.0, 6.0, -44.0), vec3(22.0, 18.0, 18.0)), 26.0)
    distance = smooth_union(distance, ellipsoid(q - vec3(0.0, 44.0, -52.0), vec3(29.0, 25.0, 22.0)), 18.0)
    distance = smooth_union(distance, ellipsoid(q - vec3(0.0, 74.0, -50.0), vec3(21.0, 14.0, 18.0)), 18.0)
    distance -= 3.5 * bump(mirrored, vec3(25.0, -42.0, -74.0), vec3(15.0, 5.0, 16.0))
    distance += 9.0 * bump(mirrored, vec3(30.0, -22.0, -68.0), vec3(13.0, 9.0, 18.0))
    # The nose: its back, its tip, its wings, and the shadow of a nostril.
    back = vec3(0.0, 36.0, -15.0)
    along = ti.math.clamp((q - vec3(0.0, -26.0, -74.0)).dot(back) / back.norm_sqr(), 0.0, 1.0)
    nose = (q - vec3(0.0, -26.0, -74.0) - along * back).norm() - 5.0 - 3.0 * along
    distance = smooth_union(distance, nose, 14.0)
    distance = smooth_union(distance, (q - vec3(0.0, 12.0, -89.0)).norm() - 8.6, 8.0)
    distance = smooth_union(distance, ellipsoid(mirrored - vec3(10.5, 16.0, -78.0), vec3(6.0, 6.5, 9.0)), 9.0)
    distance = smooth_cut(distance, ellipsoid(mirrored - vec3(6.0, 23.0, -84.0), vec3(4.0, 4.0, 6.0)), 4.0)
    # Between the lids lies the eye's own sphere.
    open_ = ramp(eye_opening(face) / 0.9)
    eye = (mirrored - vec3(_EYE[0], _EYE[1], -59.0)).norm() - 13.6 + 1.5 * open_
    distance = smooth_union(distance, eye, 8.0)
    distance += 0.8 * ti.exp(-(((eye_opening(face) + 3.4) / 1.5) ** 2)) * ramp((_EYE[1] - face.y) / 3.0 - 1.0)
    # The mouth: two ridges, the line between them, the groove above and the one below.
    full, upper, seam, lower = lips(face)
    if q.z < -30.0:
        distance -= 2.6 * full * full * ti.exp(-(((face.y - 0.45 * upper - 0.55 * seam) / 3.4) ** 2))
        distance -= 3.6 * full * full * ti.exp(-(((face.y - 0.45 * lower - 0.55 * seam) / 4.4) ** 2))
        distance += 2.0 * ramp(full / 0.2 - 1.0) * ti.exp(-(((face.y - seam) / 1.5) ** 2))
        distance += 1.0 * glow(face, vec2(0.0, 29.0), vec2(2.6, 4.5))
        distance += 1.6 * glow(face, vec2(0.0, 58.0), vec2(12.0, 3.0))
        distance += 0.8 * glow(face, vec2(28.0, 42.0), vec2(4.0, 4.0))
    return distance


@ti.func
def person(p: vec3) -> f32:
    """Return the distance to the person."""
    q = p - vec3(_HEAD_MM[0], _HEAD_MM[1], _HEAD_MM[2])
    side = ti.abs(q.x)
    cranium = ellipsoid(q - vec3(0.0, -32.0, 12.0), vec3(72.0, 94.0, 88.0))
    jaw = ellipsoid(q - vec3(0.0, 36.0, -14.0), vec3(53.0, 50.0, 56.0))
    distance = smooth_union(cranium, jaw, 32.0)
    neck = ti.sqrt(q.x * q.x + (q.z - 16.0 - 0.1 * q.y) ** 2) - 47.0
    distance = smooth_union(distance, ti.max(neck, ti.abs(q.y - 100.0) - 80.0), 18.0)
    shoulders = ellipsoid(q - vec3(0.0, 196.0, 30.0), vec3(196.0, 82.0, 70.0))
    distance = smooth_union(distance, shoulders, 60.0)
    if q.y > 80.0:  # a shirt lies on the skin, thickest at its collar
        below = q.y - neckline(q.x)
        distance -= 1.5 * ramp(below / 6.0) + 1.5 * ti.exp(-(((below - 9.0) / 5.0) ** 2))
    elif q.y < 20.0:
        inside = hair_edge(q)
        distance -= (4.0 + 0.09 * ti.max(inside, 0.0) + 0.6 * strands(q)) * ramp(inside / 8.0)
    if q.z < 10.0 and q.y < 110.0:
        distance = with_features(q, distance) if distance < _FEATURES_MM else distance - _STAND_OUT_MM
    if side > 50.0 and q.y < 60.0:  # an ear is a dish that opens outwards and to the front
        e = vec3(side - 74.0, q.y + 8.0, q.z + 4.0)
        turned = vec3(0.77 * e.x - 0.64 * e.z, e.y - 0.2 * e.z, 0.64 * e.x + 0.77 * e.z)
        dish = ellipsoid(turned - vec3(13.0, -3.0, 0.0), vec3(10.0, 23.0, 13.0))
        ear = smooth_cut(ellipsoid(turned, vec3(8.0, 31.0, 20.0)), dish, 5.0)
        distance = smooth_union(distance, ear, 24.0)
    return ti.max(_SAFE * distance, distance - _BUMPS_MM)


@ti.func
def portrait_color(p: vec3, skin: vec3) -> vec3:
    """Paint the person: skin that is flushed here and there, hair, brows, eyes, lips, a shirt; and the wall behind.

    The paints are reflectances of people and cloth under white light, read off as red, green and blue.
    """
    q = p - vec3(_HEAD_MM[0], _HEAD_MM[1], _HEAD_MM[2])
    face = vec2(ti.abs(q.x), q.y)
    hair, iris = vec3(0.50, 0.36, 0.26), vec3(0.36, 0.38, 0.40)
    flush = ti.max(glow(face, vec2(40.0, 12.0), vec2(16.0)), 0.8 * glow(face, vec2(0.0, 12.0), vec2(10.0)))
    color = skin * (1.0 - flush * vec3(0.03, 0.13, 0.12))
    color *= 1.0 - glow(face, vec2(_EYE[0], _EYE[1]), vec2(13.0, 8.0)) * vec3(0.12, 0.20, 0.18)
    full, upper, seam, lower = lips(face)
    mouth = ti.min(face.y - upper, lower - face.y)
    color = ti.math.mix(color, vec3(0.66, 0.38, 0.34), ramp(mouth / 1.5) * ramp(full / 0.1 - 1.0))
    color *= 1.0 - 0.25 * ramp(full / 0.1 - 1.0) * ti.exp(-(((face.y - seam) / 1.2) ** 2))
    t = (face.x - 30.0) / 18.0
    brow = 2.6 - 1.2 * t - ti.abs(face.y + 43.0 - 4.5 * t * t + 2.0 * t)
    color = ti.math.mix(color, vec3(0.75, 0.70, 0.64) * color, ramp(brow / 2.0) * ramp((1.0 - ti.abs(t)) / 0.15))
    opening = ramp(eye_opening(face) / 0.8)
    gaze = (face - vec2(_EYE[0], _EYE[1])).norm()
    eye = ti.math.mix(vec3(0.72, 0.68, 0.66), iris, ramp((5.8 - gaze) / 0.7))
    eye = ti.math.mix(eye, 0.5 * iris, ramp((2.5 - gaze) / 0.6))
    color = ti.math.mix(color, eye, opening)
    ear = ramp((face.x - 75.0) / 2.0) * ramp((q.y + 46.0) / 4.0)
    color = ti.math.mix(color, hair, ramp((hair_edge(q) + 2.0) / 10.0) * (1.0 - ear))
    color = ti.math.mix(color, vec3(0.56, 0.57, 0.60), ramp((q.y - neckline(q.x)) / 7.0))
    if p.z > _WALL_FROM_MM:
        color = vec3(0.45, 0.47, 0.46)
    return color
