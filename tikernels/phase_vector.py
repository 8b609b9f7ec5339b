"""The mathematics of one pixel: three sinusoids a third of a cycle apart, and the angle between two numbers.

Shared by every stage that looks at the phase of a pixel.
"""

from tikernels._taichi import ti

vec2 = ti.types.vector(2, ti.f32)
vec3 = ti.types.vector(3, ti.f32)
mat3 = ti.types.matrix(3, 3, ti.f32)

PI = 3.141592653589793

# Odd minimax polynomial for the arctangent on [0, 1]; its error is 1.7e-6 rad, where ti.atan2 is exact but costs ten
# times as much on the CPU.
_ATAN = (0.999977219, -0.332622823, 0.193540349, -0.116426418, 0.0526472864, -0.0117191117)


@ti.func
def arctangent(y: ti.f32, x: ti.f32) -> ti.f32:
    """Angle of (x, y) in [-pi, pi]; 0 for (0, 0)."""
    ax, ay = ti.abs(x), ti.abs(y)
    ratio = ti.min(ax, ay) / ti.max(ti.max(ax, ay), 1e-30)
    s = ratio * ratio
    angle = ratio * (
        _ATAN[0] + s * (_ATAN[1] + s * (_ATAN[2] + s * (_ATAN[3] + s * (_ATAN[4] + s * _ATAN[5]))))
    )
    angle = ti.select(ay > ax, 0.5 * PI - angle, angle)
    angle = ti.select(x < 0.0, PI - angle, angle)
    return ti.select(y < 0.0, -angle, angle)


@ti.func
def phase_vector(light: vec3):
    """Return b (cos phi, sin phi) and the background a of R, G, B = a + b cos(phi + (-1, 0, 1) 2 pi/3)."""
    r, g, b = light.x, light.y, light.z
    return vec2((2.0 * g - r - b) / 3.0, (r - b) * 0.5773502691896258), (r + g + b) / 3.0


@ti.func
def wrap(angle: ti.f32) -> ti.f32:
    """Bring an angle within (-3 pi, 3 pi) back to [-pi, pi]."""
    angle = ti.select(angle > PI, angle - 2.0 * PI, angle)
    return ti.select(angle < -PI, angle + 2.0 * PI, angle)
