"""Light that has bounced off several surfaces before the camera sees it.

Paths are followed from the camera in random directions (J. T. Kajiya 1986, doi:10.1145/15922.15902); at every place
they reach, the projector's light there is added. All surfaces are matt, so a path's weight is the product of its
reflectances; the paths with the same paints share one 3x3 matrix, computed at 1 nm like that of a single bounce.
"""

from functools import cache

import cv2
import numpy as np
from film import F32, IdealLight, Light, RowLight, pixel_grid
from ray_samples import NOTHING, Room, paints_of
from spectra import effective_matrix, reflectance

# Paths a pixel, and the blur, px, that evens out what their chance leaves. Light from another surface changes slowly.
_PATHS = 16
_EVEN_OUT_PX = 2.0


def indirect_light(room: Room, light: Light, row_light: RowLight | IdealLight, seed: int = 0) -> F32:
    """Return the camera's linear light, (H, W, 3), that has bounced more than once."""
    size = room.geometry.camera.size_px
    rng = np.random.default_rng(seed)
    total = np.zeros((size[1] * size[0], 3))
    for _ in range(_PATHS):
        total += _one_path_each(room, light, row_light, rng)
    film = (total / _PATHS).reshape(size[1], size[0], 3).astype(np.float32)
    return cv2.GaussianBlur(film, (0, 0), _EVEN_OUT_PX, borderType=cv2.BORDER_REPLICATE)


def _one_path_each(room: Room, light: Light, row_light, rng: np.random.Generator) -> np.ndarray:
    """Return what one path through a random place of every pixel brings."""
    paints = paints_of(room.scene)

    @cache
    def matrix_of(code: int) -> np.ndarray:
        """Return the matrix of all paths that met each paint as often as the code's digits say."""
        rho = 1.0
        for name in paints:
            code, times = divmod(code, room.scene.bounces + 1)
            rho = rho * reflectance(name) ** times
        return effective_matrix(light.projector, light.camera, rho)

    grid = pixel_grid(room.geometry.camera.size_px, 1)
    grid += rng.uniform(-0.5, 0.5, grid.shape)
    matrix = room.geometry.camera.matrix
    directions = np.column_stack([(grid - matrix[:2, 2]) / matrix[[0, 1], [0, 1]], np.ones(len(grid))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.zeros_like(directions)
    result = np.zeros((len(grid), 3))
    alive = np.arange(len(grid))
    codes = np.zeros(len(grid), np.int64)
    for bounce in range(room.scene.bounces):
        samples, places, normals = room.follow(origins, directions)
        hit = samples.paint != NOTHING
        alive, codes = alive[hit], codes[hit] + (room.scene.bounces + 1) ** samples.paint[hit].astype(np.int64)
        if bounce > 0:  # the first meeting with light is the film's
            arriving = row_light.at(samples.row[hit]) * samples.diffuse[hit, None]
            for code in np.unique(codes):
                on = codes == code
                result[alive[on]] += arriving[on] @ matrix_of(int(code)).T
        origins = places[hit] + 1e-3 * normals[hit]
        directions = _around(normals[hit], rng)
    return result


def _around(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return random directions, as likely as the cosine to the normals: a point of the unit sphere about their tips."""
    ball = rng.normal(size=normals.shape)
    directions = normals + ball / np.linalg.norm(ball, axis=1, keepdims=True)
    return directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
