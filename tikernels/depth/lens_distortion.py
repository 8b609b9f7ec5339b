"""How a lens bends rays: OpenCV's five numbers k1, k2, p1, p2, k3.

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2),    y' likewise with p1 and p2 exchanged

at unit depth (D. C. Brown, Decentering distortion of lenses, Photogrammetric Engineering 32, 1966).
"""

from tikernels._taichi import f32, ti, vec2, vec5


@ti.func
def distorted(x: f32, y: f32, lens: vec5) -> vec2:
    """Return where a ray through (x, y) at unit depth appears to go."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
    return vec2(
        x * radial + 2.0 * lens[2] * x * y + lens[3] * (r2 + 2.0 * x * x),
        y * radial + lens[2] * (r2 + 2.0 * y * y) + 2.0 * lens[3] * x * y,
    )
