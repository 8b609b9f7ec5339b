"""Undo the colour crosstalk between projector and camera.

In linear light camera = M @ projector, one row of M a camera channel (section 2.2 of Je, Lee and Park, Color-phase
analysis for sinusoidal structured light in rapid range imaging, 2004).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tikernels import checks
from tikernels._taichi import F32Array2, F32Array3, mat3, ti, vec3
from tikernels.arrays import F32
from tikernels.errors import ShapeError
from tikernels.launching import constant, kernel
from tikernels.phase.phase_vector import channel_waves, color_at, matrix_of, phase_weights
from tikernels.phase.surfaces import Surfaces


@ti.func
def unmixed(light: vec3, inverse: mat3) -> vec3:
    """Return the light of the projector's channels, given the camera's."""
    return inverse @ light


@ti.func
def weighed_vector(channels: vec3, gain: vec3, weights: mat3) -> vec3:
    """Return b cos(phi), b sin(phi) and a of a neutral surface's channels, balanced by a gain; see `phase_weights`."""
    return weights @ (channels * gain)


@kernel
def correct_crosstalk_kernel(
    image: F32Array3,  # (H, W, 3) linear light at the camera
    inverse_matrix: F32Array2,  # (3, 3)
    out: F32Array3,  # (H, W, 3) linear light of the projector's channels
):
    for pixel in range(image.shape[0] * image.shape[1]):
        y, x = pixel // image.shape[1], pixel % image.shape[1]
        light = unmixed(color_at(image, y, x), matrix_of(inverse_matrix))
        for i in ti.static(range(3)):
            out[y, x, i] = light[i]


def invert_crosstalk(crosstalk_matrix: npt.ArrayLike, *, normalize_rows: bool = False) -> npt.NDArray[np.float64]:
    """Return the inverse of a crosstalk matrix.

    Parameters
    ----------
    crosstalk_matrix : (3, 3)
        camera = matrix @ projector.
    normalize_rows : bool
        Divide each row by its sum first: for images whose colours have been balanced already, where a neutral
        projector gives neutral camera values by definition.

    Raises
    ------
    ShapeError
        The matrix is not 3x3 or cannot be inverted.
    """
    matrix = np.array(crosstalk_matrix, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ShapeError(f"crosstalk_matrix must be 3x3 finite numbers, got shape {matrix.shape}")
    if normalize_rows:
        sums = matrix.sum(axis=1, keepdims=True)
        if np.any(sums <= 0):
            raise ShapeError("crosstalk_matrix has a row that does not sum to a positive number: check its order")
        matrix = matrix / sums
    if np.linalg.cond(matrix) > 100:
        raise ShapeError("crosstalk_matrix cannot be inverted: two of its rows are alike")
    return np.asarray(np.linalg.inv(matrix), np.float64)


@dataclass(frozen=True, eq=False)
class Crosstalk:
    """Mixing of the projector's primaries in the camera's channels, on a neutral surface and on coloured ones."""

    matrix: npt.NDArray[np.float32]
    """(3, 3): what a neutral surface sends back = matrix @ projector; each row sums to one."""
    inverse: npt.NDArray[np.float32]
    """(3, 3): undoes it."""
    weights: npt.NDArray[np.float32]
    """(3, 3): takes the balanced channels to b cos(phi), b sin(phi) and the background a; see `phase_weights`."""
    waves: npt.NDArray[np.float32]
    """(3, 3): the channels' weights of a, b cos(phi) and b sin(phi); see `channel_waves`."""
    inverse_waves: npt.NDArray[np.float32]
    """(3, 3): undoes it."""
    lag: npt.NDArray[np.float64] | None
    """(3,) rad, how far the fringe of R, G, B lags behind its place; None: nowhere."""
    surfaces: Surfaces
    """Effect of the surfaces' colours on that."""

    @classmethod
    def of(
        cls,
        matrix: npt.ArrayLike,
        *,
        lag: npt.NDArray[np.float64] | None = None,
        surfaces: Surfaces | None = None,
    ) -> "Crosstalk":
        """Prepare a crosstalk matrix for decoding.

        Parameters
        ----------
        matrix : (3, 3)
            camera = matrix @ projector. The colours are balanced before it is undone; then a neutral projector gives
            neutral camera values by definition, whatever the rows of the matrix sum up to.
        lag : (3,), optional
            rad; see `channel_delays`.
        surfaces : Surfaces, optional
            Effect of their colours beyond what the balance undoes; None: nothing.

        Raises
        ------
        ShapeError
            The matrix is not 3x3 or cannot be inverted.
        """
        inverse = invert_crosstalk(matrix, normalize_rows=True)
        weights, waves = phase_weights(inverse, lag), channel_waves(lag)
        surfaces = Surfaces.of(np.eye(3)) if surfaces is None else surfaces
        return cls(
            constant(np.linalg.inv(inverse).astype(np.float32)),
            constant(inverse.astype(np.float32)),
            constant(weights.astype(np.float32)),
            constant(waves.astype(np.float32)),
            constant(np.linalg.inv(waves).astype(np.float32)),
            lag,
            surfaces,
        )


def correct_crosstalk(image: F32, crosstalk_matrix: npt.ArrayLike, out: F32 | None = None) -> F32:
    """Undo the crosstalk: what the projector's channels would have given alone.

    Parameters
    ----------
    image : (H, W, 3) float32
        Linear light at the camera.
    crosstalk_matrix : (3, 3)
        camera = matrix @ projector.
    out : (H, W, 3) float32, optional
        Output array.

    Returns
    -------
    (H, W, 3) float32
        Linear light of the projector's R, G and B; noise may take it below zero.

    Raises
    ------
    ShapeError
        Shape or dtype is another one, the matrix cannot be inverted, or `out` cannot be written.

    Examples
    --------
    >>> import numpy as np, tikernels
    >>> _ = tikernels.init("cpu")
    >>> matrix = [[0.9, 0.1, 0.0], [0.1, 0.8, 0.1], [0.0, 0.1, 0.9]]
    >>> seen = np.array([[[0.1, 0.8, 0.1]]], np.float32)  # the projector shows pure green
    >>> bool(np.abs(correct_crosstalk(seen, matrix)[0, 0] - [0, 1, 0]).max() < 1e-6)
    True
    """
    image = checks.read_array("image", image, (None, None, 3), np.float32)
    inverse = invert_crosstalk(crosstalk_matrix)
    out = checks.out_array("out", out, tuple(image.shape), np.float32)
    correct_crosstalk_kernel(image, inverse.astype(np.float32), out)
    return out
