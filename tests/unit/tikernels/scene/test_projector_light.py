"""The projector's light between its pixels, and where points lie in its frame."""

import cv2
import numpy as np

from tikernels._taichi import F32Array1, F32Array2, F32Array3, mat3, ti, vec2, vec3
from tikernels.depth.lens_distortion import pack_lens
from tikernels.scene.projector_light import light_at, projector_pixel

LENS = np.array((0.3, -0.2, 0.001, 0.002, 0.1, 0.4, -0.1, 0.1, 0.02, -0.01, 0.01, 0.03, 0.08, -0.05))
OPTICS = (*pack_lens(LENS), 1500.0, 1480.0, 511.5, 383.5)


@ti.kernel
def read_light_kernel(light: F32Array3, places: F32Array2, optics: F32Array1, out: F32Array2):
    for i in range(places.shape[0]):
        color = light_at(light, vec2(places[i, 0], places[i, 1]), optics)
        for k in ti.static(range(3)):
            out[i, k] = color[k]


@ti.kernel
def find_pixels_kernel(points: F32Array2, rotation: mat3, translation: vec3, optics: F32Array1, out: F32Array2):
    for i in range(points.shape[0]):
        pixel = projector_pixel(vec3(points[i, 0], points[i, 1], points[i, 2]), rotation, translation, optics)
        out[i, 0] = pixel.x
        out[i, 1] = pixel.y


def test_a_sinusoid_is_read_between_its_pixels(arch):
    """17 px a cycle, to 3e-6 of its amplitude: float32, and the interpolation's own 3e-7."""
    rows = np.arange(80)[:, None, None]
    light = np.broadcast_to(0.5 + 0.4 * np.cos(2 * np.pi * rows / 17), (80, 60, 3)).astype(np.float32)
    places = (np.random.default_rng(1).uniform(10, 50, (200, 2))).astype(np.float32)
    shift = np.array([[0, 0.3], [0, 0], [0.2, -0.4]])
    found = np.empty((200, 3), np.float32)
    read_light_kernel(light, places, np.array((*OPTICS, *shift.ravel()), np.float32), found)
    expected = 0.5 + 0.4 * np.cos(2 * np.pi * (places[:, 1:] - shift[:, 1]) / 17)
    np.testing.assert_allclose(found, expected, atol=3e-6)


def test_nothing_is_projected_outside_the_frame(arch):
    places = np.array([[-0.6, 5], [60, 5], [5, -0.6], [5, 80], [-0.4, 5]], np.float32)
    found = np.empty((5, 3), np.float32)
    read_light_kernel(np.ones((80, 60, 3), np.float32), places, np.array((*OPTICS, *[0] * 6), np.float32), found)
    np.testing.assert_allclose(found, np.repeat([[0], [0], [0], [0], [1]], 3, axis=1), atol=1e-6)


def test_points_land_where_opencv_projects_them(arch):
    """To a hundredth of a pixel, which float32 leaves of 1,000."""
    points = np.random.default_rng(2).uniform((-200, -150, 800), (200, 150, 1000), (100, 3)).astype(np.float32)
    turn, translation = np.array([0.2, -0.1, 0.05]), np.array([10.0, 180.0, -20.0])
    rotation = cv2.Rodrigues(turn)[0]
    found = np.empty((100, 2), np.float32)
    optics = np.array((*OPTICS, *[0] * 6), np.float32)
    find_pixels_kernel(points, mat3(rotation.tolist()), vec3(translation.tolist()), optics, found)
    matrix = np.array([[1500.0, 0, 511.5], [0, 1480.0, 383.5], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points.astype(np.float64), turn, translation, matrix, LENS)
    np.testing.assert_allclose(found, expected[:, 0], atol=0.01)
