"""Labels of the surface that each pixel shows, and the effect of each surface's colour on the channels.

Under crosstalk M a neutral surface sends back M p of the projector's light p. A coloured one has a matrix K of its own:
its reflectance acts where filter and primary meet, before and after the crosstalk at once. With T = K M^-1,

    camera = T (what a neutral surface would send back),

so that everything behind T, balance, template and phase, is the same for all surfaces.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tikernels._taichi import F32Array2, F32Array3, Static, U8Array2, i32, mat3, ti, u1, vec3
from tikernels.arrays import U8
from tikernels.launching import constant

#: Of a pixel that shows no fringe.
NO_SURFACE = np.iinfo(np.uint8).max


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The surfaces of a frame, stripes along the rows."""

    labels: U8
    """(H, W) the number of each pixel's surface, or NO_SURFACE; (1, 1) where all have the same."""
    mixing: npt.NDArray[np.float32]
    """(N, 3, 3) T of each surface."""
    unmixing: npt.NDArray[np.float32]
    """(N, 3, 3) undoes it."""
    ambient: npt.NDArray[np.float32]
    """(N, 3) light that each sends back besides, levels."""

    @classmethod
    def of(cls, mixing: npt.ArrayLike, labels: U8 | None = None, ambient: npt.ArrayLike | None = None) -> "Surfaces":
        """Prepare surfaces for decoding; without labels all pixels show the first one."""
        matrices = np.asarray(mixing, np.float64).reshape(-1, 3, 3)
        everywhere = constant(np.zeros((1, 1), np.uint8)) if labels is None else labels
        besides = np.zeros((len(matrices), 3)) if ambient is None else np.asarray(ambient)
        inverse = np.linalg.inv(matrices)
        tables = (constant(table.astype(np.float32)) for table in (matrices, inverse, besides))
        return cls(everywhere, *tables)

    @property
    def mixed(self) -> bool:
        """True if there is anything to undo."""
        return len(self.mixing) > 1 or not np.array_equal(self.mixing[0], np.eye(3))


@ti.func
def surface_at(labels: U8Array2, y: i32, x: i32) -> i32:
    """Return the number of the surface that a pixel shows; the first one's where it shows none."""
    label = ti.cast(labels[ti.min(y, labels.shape[0] - 1), ti.min(x, labels.shape[1] - 1)], ti.i32)
    return ti.select(label == NO_SURFACE, 0, label)


@ti.func
def shows_surface(labels: U8Array2, y: i32, x: i32) -> u1:
    """Return whether a pixel shows a surface with a fringe."""
    label = labels[ti.min(y, labels.shape[0] - 1), ti.min(x, labels.shape[1] - 1)]
    return ti.cast(label, ti.i32) != NO_SURFACE


@ti.func
def surface_matrix(table: F32Array3, surface: i32) -> mat3:
    """Load a surface's matrix."""
    return mat3([[table[surface, i, j] for j in range(3)] for i in range(3)])


@ti.func
def surface_ambient(table: F32Array2, surface: i32) -> vec3:
    """Load a surface's ambient light."""
    return vec3(table[surface, 0], table[surface, 1], table[surface, 2])


@ti.func
def neutral_light(
    light: vec3, unmixing: F32Array3, ambient: F32Array2, labels: U8Array2, y: i32, x: i32, mixed: Static
) -> vec3:
    """Return what a neutral surface would have sent back in a pixel's stead, given its light; see `Surfaces.mixed`."""
    neutral = light
    if ti.static(mixed):
        surface = surface_at(labels, y, x)
        neutral = surface_matrix(unmixing, surface) @ (light - surface_ambient(ambient, surface))
    return neutral


@ti.func
def matrix_lanes(table: F32Array3, surface: i32, lanes: Static):
    """Load a surface's matrix into lanes, row by row: each product with a number makes lanes of it anew."""
    return [lanes(table[surface, n // 3, n % 3]) for n in ti.static(range(9))]


@ti.func
def through(matrix: Static, light: Static, mixed: Static):
    """Return three channels' lanes by a surface's `matrix_lanes`; where nothing is mixed, as they are."""
    return (
        [
            matrix[3 * c] * light[0] + matrix[3 * c + 1] * light[1] + matrix[3 * c + 2] * light[2]
            for c in ti.static(range(3))
        ]
        if ti.static(mixed)
        else light
    )
