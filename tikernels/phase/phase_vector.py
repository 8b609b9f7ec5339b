"""The mathematics of one pixel: three sinusoids a third of a cycle apart, and the angle between two numbers.

    R, G, B = a + b cos(phi + delay),    delay = (-1, 0, 1) 2 pi/3 less the projector's lag

are linear in a, b cos(phi) and b sin(phi): `channel_waves` is the matrix that makes the channels of them,
`phase_weights` its inverse after the crosstalk has been undone, and `phase_vector` the same written out for channels
without lag and crosstalk (equation 3.3 of Je, Lee and Park, Color-phase analysis for sinusoidal structured light in
rapid range imaging, 2004). Every stage that looks at the phase of a pixel takes it from here.
"""

import math

import numpy as np
import numpy.typing as npt

from tikernels._taichi import AnyArray3, F32Array2, Static, f32, i32, mat3, ti, vec3

PI = math.pi
#: Divisors that may be zero are held above this, in levels, rad or their squares: what a frame shows is more.
TINY = 1e-12
#: What is further from what is expected than so many standard deviations is not noise.
SIGMAS = 3.0

# Odd minimax polynomial for the arctangent on [-1, 1]; its error is 1.7e-6 rad, where ti.atan2 is exact but costs ten
# times as much on the CPU.
_ATAN = (0.999977219, -0.332622823, 0.193540349, -0.116426418, 0.0526472864, -0.0117191117)
_SIGN = np.iinfo(np.int32).min  # the sign bit of a float32
# Taylor's series of sine over angle and of cosine, in the angle's square.
_SINE, _COSINE = (tuple((-1) ** n / math.factorial(2 * n + odd) for n in range(7)) for odd in (1, 0))


@ti.func
def with_sign_of(magnitude: f32, sign: f32) -> f32:
    """Return a non-negative number with another's sign; bits, because the CPU's selects cost three times as much."""
    return ti.bit_cast(ti.bit_cast(magnitude, ti.i32) | (ti.bit_cast(sign, ti.i32) & _SIGN), ti.f32)


@ti.func
def matrix_of(array: F32Array2):
    """Load a (3, 3) argument once a thread; as an array it is passed ten times as fast as a matrix."""
    return mat3([[array[i, j] for j in range(3)] for i in range(3)])


@ti.func
def color_at(image: AnyArray3, y: i32, x: i32) -> vec3:
    """Return a pixel's three channels as numbers."""
    return vec3(ti.cast(image[y, x, 0], ti.f32), ti.cast(image[y, x, 1], ti.f32), ti.cast(image[y, x, 2], ti.f32))


@ti.func
def arctangent(y: f32, x: f32) -> f32:
    """Angle of (x, y) in [-pi, pi]; pi/4 for (0, 0)."""
    # In the upper half plane the angle is pi/4 (right) or 3 pi/4 (left) less the arctangent of a ratio within [-1, 1].
    height = ti.abs(y)
    ratio = (x - with_sign_of(height, x)) / ti.max(ti.abs(x) + height, TINY)
    angle, square = 0.0, ratio * ratio
    for n in ti.static(range(len(_ATAN))):
        angle = angle * square + ti.static(_ATAN[-1 - n])
    angle *= ratio
    return with_sign_of(ti.max(0.5 * PI - with_sign_of(0.25 * PI, x) - angle, 0.0), y)


@ti.func
def absolute_lanes(values: Static):
    """Return lanes of absolute values: whole vectors have no bits of their signs."""
    return ti.max(values, 0.0 - values)


@ti.func
def wrap_lanes(angle: Static):
    """Return lanes of `wrap`."""
    return ti.select(angle > PI, angle - 2.0 * PI, ti.select(angle < -PI, angle + 2.0 * PI, angle))


@ti.func
def arctangent_lanes(y: Static, x: Static):
    """Return lanes of `arctangent`."""
    height = absolute_lanes(y)
    ratio = (x - ti.select(x < 0.0, 0.0 - height, height)) / ti.max(absolute_lanes(x) + height, TINY)
    square = ratio * ratio
    angle = 0.0 * square
    for n in ti.static(range(len(_ATAN))):
        angle = angle * square + ti.static(_ATAN[-1 - n])
    angle *= ratio
    upper = ti.max(ti.select(x < 0.0, 0.75 * PI - angle, 0.25 * PI - angle), 0.0)
    return ti.select(y < 0.0, 0.0 - upper, upper)


@ti.func
def cosine_and_sine(angle):
    """Return both, for angles within a tenth beyond [-pi, pi], a number or lanes; error 2e-6."""
    half = 0.5 * angle
    square = half * half
    sine, cosine = 0.0 * square, 0.0 * square
    for n in ti.static(range(len(_SINE))):
        sine = sine * square + ti.static(_SINE[-1 - n])
        cosine = cosine * square + ti.static(_COSINE[-1 - n])
    sine *= half
    return cosine * cosine - sine * sine, 2.0 * sine * cosine


@ti.func
def wrap(angle: f32) -> f32:
    """Bring an angle within (-3 pi, 3 pi) back to [-pi, pi]."""
    return angle - ti.select(ti.abs(angle) > PI, with_sign_of(2.0 * PI, angle), 0.0)


@ti.func
def channel_mean(channels: Static):
    """Return the mean of three channels, numbers or lanes."""
    return (channels[0] + channels[1] + channels[2]) / 3.0


@ti.func
def phase_vector(light: vec3) -> vec3:
    """Return b cos(phi), b sin(phi) and the background a of R, G, B = a + b cos(phi + (-1, 0, 1) 2 pi/3)."""
    background = channel_mean(light)
    return vec3(light.y - background, (light.x - light.z) / ti.sqrt(3.0), background)


@ti.func
def modulation_of(vector: vec3) -> f32:
    """Return b, given b cos(phi), b sin(phi) and the background."""
    return ti.sqrt(vector.x * vector.x + vector.y * vector.y)


def channel_delays(lag: npt.NDArray[np.float64] | None = None) -> npt.NDArray[np.float64]:
    """Return (3,) rad: by how much the phase of R, G, B is ahead of the pattern's.

    Parameters
    ----------
    lag : (3,), optional
        Lag of the fringe of R, G, B behind its place, rad: the projector's lateral colour.
    """
    return np.asarray(np.array([-1, 0, 1]) * 2 * np.pi / 3 - (0 if lag is None else lag))


def channel_waves(lag: npt.NDArray[np.float64] | None = None) -> npt.NDArray[np.float64]:
    """Return the (3, 3) matrix that makes R, G, B of a, b cos phi and b sin phi; see `channel_delays`."""
    angles = channel_delays(lag)
    return np.stack([np.ones(3), np.cos(angles), -np.sin(angles)], axis=1)


def phase_weights(
    inverse: npt.NDArray[np.float64], lag: npt.NDArray[np.float64] | None = None
) -> npt.NDArray[np.float64]:
    """Return the (3, 3) weights that take balanced camera channels to b (cos phi, sin phi) and the background a.

    Parameters
    ----------
    inverse : (3, 3)
        Undoes the crosstalk.
    lag : (3,), optional
        See `channel_delays`.
    """
    return np.asarray(np.linalg.inv(channel_waves(lag))[[1, 2, 0]] @ inverse)
