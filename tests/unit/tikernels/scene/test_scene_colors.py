"""Reflectances: even without texture, and a person's where a person is painted."""

import numpy as np
import pytest

from tikernels._taichi import F32Array2, ti, vec3, vec4
from tikernels.scene.scene_colors import scene_color

SKIN = (0.75, 0.52, 0.42)


def colors(scene: str, points: list[tuple[float, float, float]], texture: float) -> np.ndarray:
    """Return the reflectances of (N, 3) points at rest, mm."""
    color_of = scene_color(scene)

    @ti.kernel
    def color_kernel(points: F32Array2, surface: vec4, out: F32Array2):
        for i in range(out.shape[0]):
            color = color_of(vec3(points[i, 0], points[i, 1], points[i, 2]), surface)
            for k in ti.static(range(3)):
                out[i, k] = color[k]

    found = np.empty((len(points), 3), np.float32)
    color_kernel(np.array(points, np.float32), vec4(*SKIN, texture), found)
    return found


def test_colour_without_texture_is_even(arch):
    places = [(3.0 * i, 2.0 * i, 880.0) for i in range(50)]
    np.testing.assert_allclose(colors("bust", places, 0.0), np.tile(SKIN, (50, 1)), rtol=1e-6)
    assert 0.05 < np.ptp(colors("bust", places, 0.1)[:, 0]) / SKIN[0] < 0.25


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.0, 65.0, 780.0), SKIN),
        ((10.0, 42.0, 780.0), (0.66, 0.38, 0.34)),  # the lower lip
        ((0.0, -120.0, 820.0), (0.50, 0.36, 0.26)),  # hair
        ((-80.0, -10.0, 855.0), SKIN),  # an ear
        ((-100.0, 165.0, 860.0), (0.56, 0.57, 0.60)),  # the shirt
        ((22.5, -26.0, 790.0), (0.72, 0.68, 0.66)),  # the white of an eye
        ((31.0, -26.0, 790.0), (0.18, 0.19, 0.20)),  # its pupil
        ((-150.0, -100.0, 980.0), (0.45, 0.47, 0.46)),  # the wall
    ],
)
def test_the_portrait_is_a_person(arch, place, expected):
    """To 0.03: skin varies smoothly."""
    np.testing.assert_allclose(colors("portrait", [place], 0.0)[0], expected, atol=0.03)


def test_skin_is_flushed_on_cheeks_and_nose(arch):
    chin, *flushed = colors("portrait", [(0.0, 60.0, 780.0), (40.0, 5.0, 790.0), (0.0, 7.0, 760.0)], 0.0)
    for color in flushed:
        assert color[0] / color[1] > 1.05 * chin[0] / chin[1]
