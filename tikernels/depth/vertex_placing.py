"""Put vertices on their pixels' rays, or next to them, with normals by the slopes of the depth.

A point is z r(x, y), with r = (r_x, r_y, 1) its pixel's ray. From column to column and from row to row it moves by

    t_x = z_x r + z r_x,    t_y = z_y r + z r_y,

and t_y x t_x points back at the camera. The rays are read off the points themselves: a cubic of the pixel's place, as
OpenCV's first radial coefficient and its tangential ones make them.
"""

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array2, F32Array3, I32Array1, U8Array2, f32, ti, vec3, vec4
from tikernels.arrays import F32, Mask
from tikernels.launching import kernel
from tikernels.strips import SPREAD

Floats = npt.NDArray[np.float32]

# Rays that a cubic is fitted to: its twenty coefficients are then known better than float32 keeps them.
_SAMPLES = 4000
_DEGREE = 3
_cubics = ti.types.matrix(4, _DEGREE + 1, ti.f32)


@kernel
def place_vertices_kernel(
    depth: F32Array2,  # (H, W) mm
    slope: F32Array3,  # (H, W, 2) mm per px, down and to the right
    shift: F32Array3,  # (H, W, 2) px, likewise
    points: F32Array3,  # (H, W, 3) mm
    measured: U8Array2,  # (H, W) where there are points
    kept: U8Array2,  # (H, W) pixels that become vertices
    cubic: F32Array3,  # (4, 4, 2) of the rays' x and y, by powers of row and column
    size: f32,  # px, that rows and columns are divided by
    first: I32Array1,  # (H,) number of a row's first vertex
    out_vertices: F32Array2,  # (N, 3) mm
    out_normals: F32Array2,  # (N, 3)
):
    height, width = depth.shape[0], depth.shape[1]
    for t in range(height * SPREAD):
        if t % SPREAD == 0:
            y, number = t // SPREAD, first[t // SPREAD]
            v = y / size
            # The cubics of this row, by powers of the column: x, y, and how both change from row to row.
            powers, changes, cubics = vec4(1.0, v, v * v, v * v * v), vec4(0.0, 1.0, 2.0 * v, 3.0 * v * v), _cubics(0.0)
            for n, column, row in ti.ndrange(4, _DEGREE + 1, _DEGREE + 1):
                cubics[n, column] += cubic[row, column, n % 2] * ti.select(n < 2, powers[row], changes[row])
            for x in range(width):
                if kept[y, x] != 0:
                    dy, dx = shift[y, x, 0], shift[y, x, 1]
                    u, z = (x + dx) / size, depth[y, x] + dy * slope[y, x, 0] + dx * slope[y, x, 1]
                    values, slopes = vec4(0.0), vec4(0.0)
                    for n in range(4):
                        values[n] = cubics[n, 0] + u * (cubics[n, 1] + u * (cubics[n, 2] + u * cubics[n, 3]))
                        slopes[n] = cubics[n, 1] + u * (2.0 * cubics[n, 2] + 3.0 * u * cubics[n, 3])
                    beside = dy / size
                    ray = vec3(values[0] + beside * values[2], values[1] + beside * values[3], 1.0)
                    if measured[y, x] != 0 and dy == 0.0 and dx == 0.0:
                        away = 1.0 / points[y, x, 2]
                        ray = vec3(points[y, x, 0] * away, points[y, x, 1] * away, 1.0)
                    per_pixel = z / size
                    along = slope[y, x, 1] * ray + per_pixel * vec3(slopes[0], slopes[1], 0.0)
                    down = slope[y, x, 0] * ray + per_pixel * vec3(values[2], values[3], 0.0)
                    normal = down.cross(along).normalized()
                    for k in ti.static(range(3)):
                        out_vertices[number, k] = z * ray[k]
                        out_normals[number, k] = normal[k]
                    number += 1


def place_vertices(depth: F32, slope: F32, shift: F32, points: Floats, mask: Mask, kept: Mask) -> tuple[Floats, Floats]:
    """Put vertices on their pixels' rays.

    Parameters
    ----------
    depth : (H, W) float32
        mm.
    slope : (H, W, 2) float32
        Its change a px down and to the right, mm.
    shift : (H, W, 2) float32
        By how much vertices lie below and to the right of their pixels, px.
    points : (H, W, 3) float32
        mm, camera frame.
    mask : (H, W) bool or uint8
        True where there are points; elsewhere rays are those of the cubic.
    kept : (H, W) bool or uint8
        Pixels that become vertices.

    Returns
    -------
    vertices : (N, 3) float32
        mm, row by row, on the surface by its depth and slope.
    normals : (N, 3) float32
        Unit vectors, towards the camera.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    depth = checks.read_array("depth", depth, (None, None), np.float32)
    shape = (int(depth.shape[0]), int(depth.shape[1]))
    slope = checks.read_array("slope", slope, (*shape, 2), np.float32)
    shift = checks.read_array("shift", shift, (*shape, 2), np.float32)
    points = checks.read_array("points", points, (*shape, 3), np.float32)
    mask, kept = checks.read_mask("mask", mask, shape), checks.read_mask("kept", kept, shape)
    counts = np.count_nonzero(runtime.to_host(kept), axis=1)
    vertices, normals = (np.empty((int(counts.sum()), 3), np.float32) for _ in range(2))
    if len(vertices):
        first = (np.cumsum(counts) - counts).astype(np.int32)
        rays = (ray_cubic(runtime.to_host(points), runtime.to_host(mask) != 0), float(max(shape)))
        place_vertices_kernel(depth, slope, shift, points, mask, kept, *rays, first, vertices, normals)
    return vertices, normals


def ray_cubic(points: Floats, mask: npt.NDArray[np.bool_]) -> Floats:
    """Read the rays of an image's pixels off its points.

    Parameters
    ----------
    points : (H, W, 3) float32
        mm, camera frame.
    mask : (H, W) bool
        True where there are points; in one pixel at least.

    Returns
    -------
    (4, 4, 2) float32
        x and y at unit depth by powers of row and column, both over the longer side; 0 beyond the third together.
    """
    places = np.flatnonzero(mask)
    y, x = np.divmod(places[:: max(1, len(places) // _SAMPLES)], mask.shape[1])
    sampled = points[y, x].astype(np.float64)
    down, right = np.nonzero(np.add.outer(range(_DEGREE + 1), range(_DEGREE + 1)) <= _DEGREE)
    size = max(mask.shape)
    terms = (y[:, None] / size) ** down * (x[:, None] / size) ** right
    cubic = np.zeros((_DEGREE + 1, _DEGREE + 1, 2), np.float32)
    cubic[down, right] = np.linalg.lstsq(terms, sampled[:, :2] / sampled[:, 2:])[0]
    return cubic
