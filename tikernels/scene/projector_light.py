"""Light that a simulated rig's projector sends to each place: its lens, its pixels, and the light between them.

Kernels take its optics as 31 numbers: those of `pack_lens`; fx, fy, cx, cy (px); and the offset of R, G and B from
their places (x and y of each, px).
"""

from tikernels._taichi import F32Array1, F32Array3, f32, i32, mat3, ti, vec2, vec3, vec8, vec21
from tikernels.depth.lens_distortion import LENS_NUMBERS, distorted

_MATRIX, _SHIFT = LENS_NUMBERS, LENS_NUMBERS + 4  # where these begin


@ti.func
def projector_pixel(p: vec3, rotation: mat3, translation: vec3, optics: F32Array1) -> vec2:
    """Return the projector's column and row that light a point, through its lens."""
    q = rotation @ p + translation
    bent = distorted(q.x / q.z, q.y / q.z, vec21([optics[i] for i in range(LENS_NUMBERS)]))
    return vec2(optics[_MATRIX] * bent.x + optics[_MATRIX + 2], optics[_MATRIX + 1] * bent.y + optics[_MATRIX + 3])


@ti.func
def light_at(light: F32Array3, pixel: vec2, optics: F32Array1) -> vec3:
    """Return what the projector sends to a place of its frame, each colour shifted by the lateral colour."""
    result = vec3(0.0)
    for channel in range(3):
        column, row = pixel.x - optics[_SHIFT + 2 * channel], pixel.y - optics[_SHIFT + 2 * channel + 1]
        result[channel] = sample(light, column, row, channel)
    return result


@ti.func
def interpolation_weights(fraction: f32) -> vec8:
    """Weights of eight Lagrange taps, -3..4 around the sample.

    Exact on polynomials of degree 7: on a sinusoid of 17 px per cycle the error is 3e-7, where cubic convolution leaves
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
