"""Turn an image of linked pixels into triangles."""

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import F32Array2, I32Array1, I32Array2, U8Array2, i32, ti
from tikernels.arrays import F32, U8, Mask
from tikernels.depth.step_cutting import DOWN, FALLING, RIGHT, RISING
from tikernels.launching import kernel
from tikernels.strips import SPREAD


@ti.func
def link(links: U8Array2, y: i32, x: i32, bit: i32) -> i32:
    """Return whether a pixel has a link, as 0 or 1."""
    return ti.cast((links[y, x] & bit) != 0, i32)


@ti.func
def square_triangles(depth: F32Array2, links: U8Array2, y: i32, x: i32) -> i32:
    """Return the triangles of a square of four pixels: bit 0 upper left, 1 lower right, 2 upper right, 3 lower left.

    A whole square is split along its diagonal with the smaller step, into bits 0 and 1, or 2 and 3.
    """
    top, bottom = link(links, y, x, RIGHT), link(links, y + 1, x, RIGHT)
    left, right = link(links, y, x, DOWN), link(links, y, x + 1, DOWN)
    rising = link(links, y, x, RISING)  # the diagonal from lower left to upper right
    falling = link(links, y, x, FALLING)
    upper_left, lower_right = top & left & rising, bottom & right & rising
    upper_right, lower_left = top & right & falling, bottom & left & falling
    along_rising = ti.abs(depth[y + 1, x] - depth[y, x + 1])
    along_falling = ti.abs(depth[y, x] - depth[y + 1, x + 1])
    use_rising = upper_left + lower_right > upper_right + lower_left or (
        upper_left + lower_right == upper_right + lower_left and along_rising <= along_falling
    )
    bits = upper_right * 4 + lower_left * 8
    if use_rising:
        bits = upper_left + lower_right * 2
    return bits


@kernel
def count_triangles_kernel(
    depth: F32Array2,  # (H, W)
    mask: U8Array2,  # (H, W)
    links: U8Array2,  # (H, W) bits
    out_triangles: I32Array1,  # (H,) triangles between a row and the next
    out_vertices: I32Array1,  # (H,) masked pixels
):
    height, width = mask.shape[0], mask.shape[1]
    for t in range(height * SPREAD):
        if t % SPREAD == 0:
            y, triangles, vertices = t // SPREAD, 0, 0
            for x in range(width):
                if mask[y, x] != 0:
                    vertices += 1
                if y + 1 < height and x + 1 < width:
                    bits = square_triangles(depth, links, y, x)
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
    for t in range(height * SPREAD):
        if t % SPREAD == 0:
            y = t // SPREAD
            number = first[y]
            for x in range(width):
                out_numbers[y, x] = number
                if mask[y, x] != 0:
                    number += 1


@ti.func
def write_triangles(bits: i32, numbers: I32Array2, y: i32, x: i32, place: i32, out_faces: I32Array2) -> i32:
    """Write a square's triangles from a place on, and return the place after them."""
    a, b = numbers[y, x], numbers[y, x + 1]
    c, d = numbers[y + 1, x], numbers[y + 1, x + 1]
    after = place
    # Counterclockwise as the camera sees them, in the order of the bits.
    for k, corners in ti.static(enumerate(((a, c, b), (b, c, d), (a, d, b), (a, c, d)))):
        if (bits >> k) & 1 == 1:
            out_faces[after, 0], out_faces[after, 1], out_faces[after, 2] = corners
            after += 1
    return after


@kernel
def fill_triangles_kernel(
    depth: F32Array2,  # (H, W)
    links: U8Array2,  # (H, W) bits
    numbers: I32Array2,  # (H, W) vertex numbers
    first: I32Array1,  # (H,) place of a row's first triangle
    out_faces: I32Array2,  # (M, 3)
):
    height, width = links.shape[0], links.shape[1]
    for t in range((height - 1) * SPREAD):
        if t % SPREAD == 0:
            y = t // SPREAD
            place = first[y]
            for x in range(width - 1):
                place = write_triangles(square_triangles(depth, links, y, x), numbers, y, x, place, out_faces)


def triangulate_mesh(depth: F32, mask: Mask, links: U8) -> npt.NDArray[np.int32]:
    """Join linked pixels into triangles.

    Parameters
    ----------
    depth : (H, W) float32
        Determines only the diagonal that splits a square of four pixels: the one with the smaller step.
    mask : (H, W) bool or uint8
        Pixels that become vertices.
    links : (H, W) uint8
        Pixels that an edge may join; see `link_pixels`. None leads out of the mask.

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
    depth = checks.read_array("depth", depth, (None, None), np.float32)
    shape = (int(depth.shape[0]), int(depth.shape[1]))
    mask = checks.read_mask("mask", mask, shape)
    links = checks.read_array("links", links, shape, np.uint8)
    triangles, vertices = np.empty(shape[0], np.int32), np.empty(shape[0], np.int32)
    count_triangles_kernel(depth, mask, links, triangles, vertices)
    numbers = np.empty(shape, np.int32)
    number_vertices_kernel(mask, np.cumsum(vertices, dtype=np.int32) - vertices, numbers)
    total = int(triangles.sum())
    faces = np.empty((max(total, 1), 3), np.int32)
    fill_triangles_kernel(depth, links, numbers, np.cumsum(triangles, dtype=np.int32) - triangles, faces)
    return faces[:total]
