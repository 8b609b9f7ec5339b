"""Lens distortion of rays: OpenCV's model, at unit depth, in the order of OpenCV's coefficients.

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
       + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4

y' likewise with p1 and p2 exchanged, and s3 and s4; a tilted sensor then turns the picture by tau_x and tau_y (D. C.
Brown, Decentering distortion of lenses, Photogrammetric Engineering 32, 1966; cv::projectPoints). Most lenses need five
numbers, k1 k2 p1 p2 k3, and kernels then leave out the rest.
"""

import numpy as np
import numpy.typing as npt

from tikernels._taichi import f32, ti, vec2, vec21

#: What kernels take of a lens: twelve coefficients, and the tilted sensor's 3x3 matrix.
LENS_NUMBERS = 21
#: How many of its coefficients most lenses need, and the longest list of them.
SHORT, ALL = 5, 14


def needed_terms(distortion: npt.NDArray[np.float64]) -> int:
    """Return which of its coefficients a kernel needs: 0, the first 5, or all 14."""
    if np.any(distortion[SHORT:]):
        return ALL
    return SHORT if np.any(distortion) else 0


def pack_lens(distortion: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return what kernels take of a lens of up to 14 coefficients, (21,)."""
    k = np.zeros(14)
    k[: len(distortion)] = distortion
    (cx, cy), (sx, sy) = np.cos(k[12:]), np.sin(k[12:])
    turn = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    # Along the tilted axis back into the picture: OpenCV's matTilt.
    back = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
    return np.concatenate([k[:12], (back @ turn).ravel()])


@ti.func
def distorted(x: f32, y: f32, lens: vec21) -> vec2:
    """Return where a ray through (x, y) at unit depth appears to go."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
    radial /= 1.0 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[7]))
    bent_x = x * radial + 2.0 * lens[2] * x * y + lens[3] * (r2 + 2.0 * x * x) + r2 * (lens[8] + r2 * lens[9])
    bent_y = y * radial + lens[2] * (r2 + 2.0 * y * y) + 2.0 * lens[3] * x * y + r2 * (lens[10] + r2 * lens[11])
    turned_x = lens[12] * bent_x + lens[13] * bent_y + lens[14]
    turned_y = lens[15] * bent_x + lens[16] * bent_y + lens[17]
    return vec2(turned_x, turned_y) / (lens[18] * bent_x + lens[19] * bent_y + lens[20])
