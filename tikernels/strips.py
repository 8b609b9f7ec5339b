"""Strips: the pieces of a row that one thread works on.

A thread per pixel would be right for a GPU, and a thread per row for a CPU; a strip of some pixels serves both. A CPU
does eight or sixteen pixels at once, but only where the compiler knows that no two arrays overlap, and it knows that of
a thread's own small arrays alone. So a kernel that computes much for every pixel copies its strip into vectors of
constant length, computes on all of them whether the image goes on that far or not, and copies back what lies inside:

    for t in range(height * strip_count(width, STRIP)):
        y, first, count = strip_at(t, width, STRIP)
        for k in range(count): copy pixel (y, first + k) into the vectors
        for k in range(STRIP): compute
        for k in range(count): copy the results out

On Vulkan Taichi 1.7 compiles only one loop of a kernel with such vectors, so a second one is a kernel of its own. Mesa
22.3's llvmpipe leaves a loop around those three early in a thread whose work group is not full, so each strip is a
thread's own.

Where a kernel does little but load and store, whole vectors are faster (`lanes.py`). Kernels that add up a strip need
no copies. Those that compute little need none either, and still gain by the strip:
row and column of every single pixel would cost a division, by which they take half as long again on a CPU.
"""

from tikernels._taichi import Static, i32, ti, vec3
from tikernels.lanes import LANES

#: Pixels of a strip where nothing needs another length.
STRIP = 32
#: The CPU gives a thread 512 iterations of a parallel loop or more: of 600 strips one of two threads did nearly all. So
#: loops over a few hundred strips have as many iterations for each, of which the first one works.
SPREAD = 16
#: Three channels of samples, or blocks of them, that a thread works on together.
lanes_of_colors = ti.types.matrix(3, LANES, ti.f32)


@ti.func
def color_of(colors: Static, k: i32) -> vec3:
    """Return the three channels of one lane."""
    return vec3(colors[0, k], colors[1, k], colors[2, k])


@ti.func
def set_color(colors: Static, k: i32, color: vec3):
    """Change the three channels of one lane."""
    colors[0, k], colors[1, k], colors[2, k] = color.x, color.y, color.z


@ti.func
def strip_count(length: i32, size: i32) -> i32:
    """Return how many strips of this size a row of this length has."""
    return (length + size - 1) // size


@ti.func
def strip_at(number: i32, length: i32, size: i32):
    """Return the row of a strip, its first place there, and how many places of the row it holds."""
    strips = strip_count(length, size)
    row = number // strips
    first = (number - row * strips) * size
    return row, first, ti.min(size, length - first)
