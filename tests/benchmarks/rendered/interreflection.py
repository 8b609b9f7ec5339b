"""Light that has bounced off several surfaces before the camera sees it.

Paths are followed from the camera in many directions (J. T. Kajiya 1986, doi:10.1145/15922.15902); at every place they
reach, the projector's light there is added. All surfaces are matt, so a path's weight is the product of its
reflectances; the paths with the same paints share one 3x3 matrix, computed at 1 nm like that of a single bounce. Where
a path meets light, the light depends on the projector's row only, so that what is kept of all paths is how much of
each row's light arrives: any pattern then follows by one multiplication.

Light from other surfaces changes slowly, so that a grid of places is enough; between them it is interpolated, on each
body by itself. All places send their paths in the same directions, whose error then has no grain.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
from camera_film import F32, IdealLight, Light, RowLight
from ray_samples import NOTHING, Room, paints_of, rig
from rendered_scenes import RenderedScene, scenes
from spectra import effective_matrix, reflectance

# Px between the places of the grid, and paths from each.
_STEP_PX = 6
_PATHS = 1024
# Places at a time.
_CHUNK = 800


@dataclass(frozen=True)
class Transport:
    """How much of each projector row's light reaches each place of the grid after several bounces."""

    pixels: npt.NDArray[np.float64]  # (N, 2)
    shape: tuple[int, int]  # of the grid, rows and columns
    body: npt.NDArray[np.uint8]  # (N,) what the places lie on
    by_paints: dict[int, F32]  # for each kind of path, (N, rows); see `_matrix_of`


def indirect_light(scene: RenderedScene, light: Light, row_light: RowLight | IdealLight) -> F32:
    """Return the camera's linear light, (H, W, 3), that has bounced more than once."""
    transport = _transport(scene.name)
    rows = next(iter(transport.by_paints.values())).shape[1]
    projected = row_light.at(np.arange(rows, dtype=np.float32))
    arriving = np.zeros((len(transport.pixels), 3), np.float32)
    for code, weights in transport.by_paints.items():
        arriving += (weights @ projected) @ _matrix_of(code, scene, light).T.astype(np.float32)
    return _between(transport, arriving)


def _matrix_of(code: int, scene: RenderedScene, light: Light) -> npt.NDArray[np.float64]:
    """Return the matrix of all paths that met each paint as often as the code's digits say."""
    rho = 1.0
    for name in paints_of(scene):
        code, times = divmod(code, scene.bounces + 1)
        rho = rho * reflectance(name) ** times
    return effective_matrix(light.projector, light.camera, rho)


def _between(transport: Transport, values: F32) -> F32:
    """Interpolate (N, 3) values of the grid at every pixel, from places on the pixel's own body."""
    geometry = rig().geometry()
    width, height = geometry.camera.size_px
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    at = (x / _STEP_PX, y / _STEP_PX)
    bodies = transport.body.reshape(transport.shape)
    grid = values.reshape(*transport.shape, 3)
    result = np.zeros((height, width, 3), np.float32)
    most = np.full((height, width), 1e-3, np.float32)
    for number in np.unique(bodies[bodies != NOTHING]):
        on = (bodies == number).astype(np.float32)
        share = cv2.remap(on, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        total = cv2.remap(grid * on[..., None], *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        # A pixel lies on the body that most of its neighbours in the grid lie on.
        more = share > most
        result[more], most[more] = total[more] / share[more, None], share[more]
    return result


@lru_cache(maxsize=1)
def _transport(scene_name: str) -> Transport:
    scene, geometry = scenes()[scene_name], rig().geometry()
    room = Room(scene, geometry)
    width, height = geometry.camera.size_px
    x, y = np.meshgrid(np.arange(0, width + _STEP_PX, _STEP_PX), np.arange(0, height + _STEP_PX, _STEP_PX))
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1).astype(np.float64)
    matrix = geometry.camera.matrix
    rays = np.column_stack([(pixels - matrix[:2, 2]) / matrix[[0, 1], [0, 1]], np.ones(len(pixels))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    first, places, normals = room.follow(np.zeros_like(rays), rays)
    by_paints: dict[int, F32] = {}
    rows = geometry.projector.size_px[1]
    there = np.flatnonzero(first.body != NOTHING)
    for start in range(0, len(there), _CHUNK):
        on = there[start : start + _CHUNK]
        for code, weights in _followed(room, places[on], normals[on], first.paint[on], rows).items():
            by_paints.setdefault(code, np.zeros((len(pixels), rows), np.float32))[on] = weights
    return Transport(pixels, x.shape, first.body, by_paints)


def _followed(room: Room, places, normals, paint, rows: int) -> dict[int, F32]:
    """Return what paths from N places bring of each row's light, (N, rows) for each kind of path."""
    bounces = room.scene.bounces
    point = np.repeat(np.arange(len(places)), _PATHS)
    path = np.tile(np.arange(_PATHS), len(places))
    digit = (bounces + 1) ** np.arange(len(paints_of(room.scene)), dtype=np.int64)
    codes = digit[paint[point]]
    origins, directions = places[point] + 1e-3 * normals[point], _around(normals[point], path, 0)
    found: dict[int, F32] = {}
    for bounce in range(1, bounces):
        samples, reached, facing = room.follow(origins, directions)
        hit = samples.body != NOTHING
        point, path = point[hit], path[hit]
        codes = codes[hit] + digit[samples.paint[hit]]
        row = np.clip(np.rint(samples.row[hit]), 0, rows - 1).astype(np.int64)
        for code in np.unique(codes):
            on = codes == code
            place = point[on] * rows + row[on]
            sums = np.bincount(place, samples.diffuse[hit][on], len(places) * rows) / _PATHS
            found[int(code)] = found.get(int(code), 0) + sums.reshape(-1, rows).astype(np.float32)
        origins = reached[hit] + 1e-3 * facing[hit]
        directions = _around(facing[hit], path, bounce)
    return found


def _around(normals, path, bounce: int):
    """Return directions as likely as their cosine to the normals, the same for paths of one number.

    They follow a sequence that fills the square evenly (M. Roberts 2018, the generalised golden ratio), turned by
    another angle for every bounce.
    """
    plastic = 1.324717957244746
    first = (0.5 + path / plastic + 0.381966 * bounce) % 1
    second = (0.5 + path / plastic**2 + 0.618034 * bounce * (1 + path // 7)) % 1
    radius, turn = np.sqrt(first), 2 * np.pi * second
    # A frame about the normal that changes smoothly with it.
    helper = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(helper, normals)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(normals, side)
    along = (radius * np.cos(turn))[:, None] * side + (radius * np.sin(turn))[:, None] * up
    return along + np.sqrt(np.maximum(1 - first, 1e-6))[:, None] * normals
