"""Turn an image of points into triangles, cut where the surface steps."""

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import F32Array3, I32Array1, I32Array2, U8Array2, f32, i32, ti
from tikernels.arrays import F32, Mask
from tikernels.launching import kernel


@ti.func
def joined(points: F32Array3, mask: U8Array2, y: i32, x: i32, y2: i32, x2: i32, max_step: f32) -> i32:
    """Whether an edge of the mesh may run between two pixels."""
    inside = mask[y, x] != 0 and mask[y2, x2] != 0
    return ti.cast(inside and ti.abs(points[y, x, 2] - points[y2, x2, 2]) <= max_step, ti.i32)


@ti.func
def square_triangles(points: F32Array3, mask: U8Array2, y: i32, x: i32, max_step: f32) -> i32:
    """Which triangles a square of four pixels holds: bit 0 upper left, 1 lower right, 2 upper right, 3 lower left.

    A whole square is split along its diagonal with the smaller step, into bits 0 and 1, or 2 and 3.
    """
    top = joined(points, mask, y, x, y, x + 1, max_step)
    bottom = joined(points, mask, y + 1, x, y + 1, x + 1, max_step)
    left = joined(points, mask, y, x, y + 1, x, max_step)
    right = joined(points, mask, y, x + 1, y + 1, x + 1, max_step)
    rising = joined(points, mask, y + 1, x, y, x + 1, max_step)  # the diagonal from lower left to upper right
    falling = joined(points, mask, y, x, y + 1, x + 1, max_step)
    upper_left, lower_right = top & left & rising, bottom & right & rising
    upper_right, lower_left = top & right & falling, bottom & left & falling
    along_rising = ti.abs(points[y + 1, x, 2] - points[y, x + 1, 2])
    along_falling = ti.abs(points[y, x, 2] - points[y + 1, x + 1, 2])
    use_rising = upper_left + lower_right > upper_right + lower_left or (
        upper_left + lower_right == upper_right + lower_left and along_rising <= along_falling
    )
    bits = upper_right * 4 + lower_left * 8
    if use_rising:
        bits = upper_left + lower_right * 2
    return bits


@kernel
def count_triangles_kernel(
    points: F32Array3,  # (H, W, 3)
    mask: U8Array2,  # (H, W)
    max_step: f32,
    out_triangles: I32Array1,  # (H,) triangles between a row and the next
    out_vertices: I32Array1,  # (H,) masked pixels
):
    height, width = mask.shape[0], mask.shape[1]
    for y in range(height):
        triangles, vertices = 0, 0
        for x in range(width):
            if mask[y, x] != 0:
                vertices += 1
            if y + 1 < height and x + 1 < width:
                bits = square_triangles(points, mask, y, x, max_step)
                triangles += (bits & 1) + ((bits >> 1) & 1) + ((bits >> 2) & 1) + ((bits >> 3) & 1)
        out_triangles[y] = triangles
        out_vertices[y] = vertices


@kernel
def number_vertices_kernel(
    mask: U8Array2,  # (H, W)
    first: I32Array1,  # (H,) number of a row's first vertex
    out_numbers: I32Array2,  # (H, W)
):
    height, width = mask.shape[0], mask.shape[1]
    for y in range(height):
        number = first[y]
        for x in range(width):
            out_numbers[y, x] = number
            if mask[y, x] != 0:
                number += 1


@kernel
def fill_triangles_kernel(
    points: F32Array3,  # (H, W, 3)
    mask: U8Array2,  # (H, W)
    max_step: f32,
    numbers: I32Array2,  # (H, W) vertex numbers
    first: I32Array1,  # (H,) place of a row's first triangle
    out_faces: I32Array2,  # (M, 3)
):
    height, width = mask.shape[0], mask.shape[1]
    for y in range(height - 1):
        place = first[y]
        for x in range(width - 1):
            bits = square_triangles(points, mask, y, x, max_step)
            if bits != 0:
                a, b = numbers[y, x], numbers[y, x + 1]
                c, d = numbers[y + 1, x], numbers[y + 1, x + 1]
                # Counterclockwise as the camera sees them, in the order of the bits.
                for k, corners in ti.static(enumerate(((a, c, b), (b, c, d), (a, d, b), (a, c, d)))):
                    if (bits >> k) & 1 == 1:
                        out_faces[place, 0], out_faces[place, 1], out_faces[place, 2] = corners
                        place += 1


def triangulate_mesh(points: F32, mask: Mask, max_step: float) -> npt.NDArray[np.int32]:
    """Join neighbouring pixels into triangles.

    Parameters
    ----------
    points : (H, W, 3) float32
        Positions; only the third coordinate decides where the mesh is cut.
    mask : (H, W) bool or uint8
        Pixels that become vertices.
    max_step : float
        Largest difference of the third coordinate along an edge, in its unit.

    Returns
    -------
    (M, 3) int32
        Vertex numbers of each triangle, counterclockwise as the camera sees it; vertices are the masked pixels, row by
        row: ``points[mask]``.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    points = checks.read_array("points", points, (None, None, 3), np.float32)
    shape = (int(points.shape[0]), int(points.shape[1]))
    mask = checks.read_mask("mask", mask, shape)
    triangles, vertices = np.empty(shape[0], np.int32), np.empty(shape[0], np.int32)
    count_triangles_kernel(points, mask, max_step, triangles, vertices)
    numbers = np.empty(shape, np.int32)
    number_vertices_kernel(mask, np.cumsum(vertices, dtype=np.int32) - vertices, numbers)
    total = int(triangles.sum())
    faces = np.empty((max(total, 1), 3), np.int32)
    fill_triangles_kernel(points, mask, max_step, numbers, np.cumsum(triangles, dtype=np.int32) - triangles, faces)
    return faces[:total]
