"""Residual light at a place under each surface's matrix.

A pixel's three channels have two unknowns, brightness and phase; the residual under each surface's matrix distinguishes
the surfaces, more sharply than any mean colour, which the fringe goes through. With x, y and a the pixel's b cos(phi),
b sin(phi) and background as if its surface were neutral, it is

    left = |(x, y)| - a rho,

rho the contrast that the projector's light has at the bare phase of (x, y). Light is looked at as means over a few
pixels along the stripes, at the places of a lattice of some rows a cycle; pixels alone where several surfaces meet.
"""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array2, F32Array3, I32Array2, Static, U8Array2, f32, i32, ti, vec3
from tikernels.arrays import F32, I32, LevelsImage
from tikernels.launching import kernel
from tikernels.phase.color_balance import Gains, gain_at
from tikernels.phase.crosstalk import Crosstalk, weighed_vector
from tikernels.phase.frame_statistics import MEDIAN_SIZE, FrameLevels
from tikernels.phase.phase_vector import SIGMAS, TINY, absolute_lanes, channel_mean, color_at, matrix_of, phase_weights
from tikernels.phase.surface_matrix import waves
from tikernels.phase.surfaces import matrix_lanes, through
from tikernels.raw.linearization import LEVEL_TYPES
from tikernels.strips import strip_count

_Residuals = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

#: Pixels on either side in a mean, along the stripes: the noise of single ones biases the fitted matrices.
REACH_PX = 2
#: Places that a thread looks at together, as the vector units of a CPU do; and rows of a cell of so many columns.
AT_ONCE, CELL_ROWS = 16, 8
place_lanes = ti.types.vector(AT_ONCE, ti.f32)
#: The light of a place without evidence, and what is left of it.
SAYS_NOTHING = -1e9
#: A place that fits no surface counts no more than this against one.
MOST_MISFIT = 16.0
#: Standard deviation of a place's contrast, as a fraction: ambient light is not quite even over a surface.
UNEVEN = 0.01
# Of the logarithm of the contrast lost to blur, as a fraction of it, since lenses differ.
_LOST_DOUBT = 0.6
#: A model is no better than this fraction of a pixel's light, and of the ambient light.
MODEL_ERROR, _AMBIENT_ERROR = 0.01, 0.04
# Phases that the light's contrast is computed at. And places of its table, around the square |x| + |y| = 1: to find a
# point's place takes a division, but no arctangent; from one to the next the contrast changes by up to 0.004.
_PHASES, _PLACES = 256, 1024
# A code's contrast is the mean around a place, by a Gaussian of this standard deviation, cycles.
_CODE_CYCLES = 0.3
# Errors that neighbours share, as JPEG's, are measured by means along the stripes over this many cycles.
_SHARED_CYCLES = 2.0


class Lattice(NamedTuple):
    """Places of a frame, rows and columns apart, and the light around each."""

    light: npt.NDArray[np.float32]
    """(h, w, 3) levels, mean over a few pixels along the stripes; see `says`."""
    contrast: npt.NDArray[np.float32]
    """(h, w) by which blur and the mean multiply the fringe's first harmonic, relative to the usual."""
    rows: int
    columns: int
    """px between the places."""
    period_px: float
    """Camera px per cycle."""

    @property
    def says(self) -> _Mask:
        """(h, w) which places show a fringe, and are not clipped."""
        return np.asarray(self.light[..., 0] > SAYS_NOTHING)

    @property
    def pixels(self) -> int:
        """Number of pixels that a place represents."""
        return self.rows * self.columns

    def blurred(self, values: npt.NDArray[np.bool_ | np.float32], sigma_px: float) -> npt.NDArray[np.float32]:
        """Return values of the places, smoothed by a Gaussian."""
        sigma = (sigma_px / self.columns, sigma_px / self.rows)
        return np.asarray(cv2.GaussianBlur(values.astype(np.float32, copy=False), (0, 0), sigma[0], sigmaY=sigma[1]))

    def square(self, side_px: float) -> npt.NDArray[np.uint8]:
        """Return what a morphological operation looks at: a square of an odd number of places."""
        return np.ones([2 * round(side_px / step / 2) + 1 for step in (self.rows, self.columns)], np.uint8)


class NeutralLight(NamedTuple):
    """Each surface's light, converted to that of a neutral one."""

    unmixing: npt.NDArray[np.float32]
    """(N, 3, 3) takes it to b cos(phi), b sin(phi) and a."""
    ambient: npt.NDArray[np.float32]
    """(N, 3) light that each sends back besides, levels."""
    contrast: npt.NDArray[np.float32]
    """(2, places) b over a at the bare phase, and its derivative; see `place_around`."""

    def only(self, surfaces: list[int]) -> "NeutralLight":
        """Return that of some of the surfaces."""
        return self._replace(unmixing=self.unmixing[surfaces], ambient=self.ambient[surfaces])

    @classmethod
    def of(
        cls, matrices: _Array, ambient: _Array, light: npt.NDArray[np.complex128], lag: _Array | None = None
    ) -> "NeutralLight":
        """Return that of surfaces.

        Parameters
        ----------
        matrices : (N, 3, 3)
            K of each, up to a factor; see `surface_matrix.py`.
        ambient : (N, 3)
            levels.
        light : (3, harmonics) complex128
            Of the projector's light over its mean, from the first on.
        lag : (3,), optional
            See `channel_delays`.
        """
        sent = waves(light, np.linspace(-np.pi, np.pi, _PHASES, endpoint=False))[0]
        vectors = phase_weights(np.eye(3), lag)
        cosine, sine, mean = vectors @ sent
        phases = np.linspace(-np.pi, np.pi, _PHASES + 1)
        rho = np.interp(phases, np.arctan2(sine, cosine), np.hypot(cosine, sine) / mean, period=2 * np.pi)
        slope = (np.roll(rho[:-1], -1) - np.roll(rho[:-1], 1)) / (2 * (phases[1] - phases[0]))
        around = np.linspace(-2, 2, 2 * _PLACES + 1)[1::2]
        x = 1 - np.abs(around)
        bare = np.copysign(np.arctan2(1 - np.abs(x), x), around)
        table = np.stack([np.interp(bare, phases, values) for values in (rho, np.append(slope, slope[0]))])
        tables = (vectors @ np.linalg.inv(matrices), ambient, table)
        return cls(*(np.ascontiguousarray(part, np.float32) for part in tables))


@kernel
def average_light_kernel(
    image: AnyArray3,  # (H, W, 3) levels
    gains: F32Array3,  # (Hg, Wg, 3) that balance a neutral surface, at nodes
    blur: F32Array2,  # (Hg, Wg) what blur leaves of the contrast around every node
    spacing_px: i32,  # between the nodes
    phase_weights: F32Array2,  # (3, 3)
    unlit: U8Array2,  # (H, W) 1: shows no fringe
    clipped: f32,  # levels
    rows: i32,  # px between places
    columns: i32,
    reach: i32,  # px of a mean on either side
    cells: I32Array2,  # (h / 8 up, w / 16 up) 0: not needed
    out: F32Array3,  # (h, w, 3) levels; SAYS_NOTHING
    out_contrast: F32Array2,  # (h, w) see `Lattice`
):
    height, width = out.shape[0], out.shape[1]
    strips = strip_count(width, AT_ONCE)
    for t in range(height * strips):
        i, first = t // strips, t % strips * AT_ONCE
        if cells[i // CELL_ROWS, t % strips] != 0:
            weights, y = matrix_of(phase_weights), i * rows
            for j in range(first, ti.min(first + AT_ONCE, width)):
                middle = ti.min(j * columns + columns // 2, image.shape[1] - 1)
                total = color_at(image, y, middle)
                most, lost = total.max(), 1.0
                if reach > 0:
                    gain = gain_at(gains, spacing_px, y, middle)
                    total, last, cosine, sine = vec3(0.0), vec3(0.0), 0.0, 0.0
                    for k in range(-reach, reach + 1):
                        x = ti.min(ti.max(middle + k, 0), image.shape[1] - 1)
                        seen = color_at(image, y, x)
                        vector = weighed_vector(seen, gain, weights)
                        cosine += vector.x * last.x + vector.y * last.y
                        sine += vector.y * last.x - vector.x * last.y
                        total, last, most = total + seen, vector, ti.max(most, seen.max())
                    # A phase that is linear over n pixels has the variance slope^2 (n^2 - 1) / 12.
                    slope = ti.select(cosine > 0.0, sine / ti.max(cosine, TINY), 1.0)
                    lost += reach * (reach + 1) / 6.0 * ti.min(slope * slope, 1.0)
                a, b = ti.min(y // spacing_px, blur.shape[0] - 1), ti.min(middle // spacing_px, blur.shape[1] - 1)
                out_contrast[i, j] = blur[a, b] / lost
                says = (most < clipped) & (ti.cast(unlit[ti.min(y, image.shape[0] - 1), middle], i32) == 0)
                for c in ti.static(range(3)):
                    out[i, j, c] = ti.select(says, total[c] / (2 * reach + 1), SAYS_NOTHING)


def average_light(
    image: LevelsImage,
    gains: Gains,
    crosstalk: Crosstalk,
    blur: npt.NDArray[np.float32],
    unlit: _Mask,
    levels: FrameLevels,
    rows: int,
    columns: int,
    reach_px: int,
    cells: I32 | None = None,
) -> tuple[F32, F32]:
    """Return mean light around places of a frame, and how much contrast that has left; see `Lattice`.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels, stripes along the rows.
    gains : Gains
        That balance it.
    crosstalk : Crosstalk
        Crosstalk of the measurement.
    blur : (Hg, Wg) float32
        Contrast that the camera's blur leaves around every node of the gains, relative to the usual.
    unlit : (H, W) bool
        Pixels without a fringe: they have no evidence.
    levels : FrameLevels
        Neither do clipped ones.
    rows, columns : int
        px between places.
    reach_px : int
        Pixels of a mean on either side.
    cells : int32, optional
        Cells of 8 x 16 places that are compared, others are undefined; None: all.
    """
    image = checks.read_array("image", image, (gains.height, gains.width, 3), *LEVEL_TYPES)
    size = (-(-gains.height // rows), -(-gains.width // columns))
    cells = np.ones(cells_of(size), np.int32) if cells is None else cells
    out, contrast = runtime.empty((*size, 3), np.float32), runtime.empty(size, np.float32)
    nodes = (gains.gains, blur, gains.spacing_px, crosstalk.weights)
    average_light_kernel(
        image, *nodes, unlit.view(np.uint8), levels.clipped, rows, columns, reach_px, cells, out, contrast
    )
    return out, contrast


def cells_of(size: tuple[int, int]) -> tuple[int, int]:
    """Return how many cells so many places have."""
    return -(-size[0] // CELL_ROWS), -(-size[1] // AT_ONCE)


@ti.func
def place_around(x: Static, y: Static):
    """Return lanes of points' places in `NeutralLight.contrast`, from 0 to 1024, by their angles."""
    turn = 1.0 - x / ti.max(absolute_lanes(x) + absolute_lanes(y), TINY)
    return (2.0 + ti.select(y < 0.0, 0.0 - turn, turn)) * ti.static(_PLACES / 4)


@kernel(whole_vectors=True)
def surface_residuals_kernel(
    light: F32Array3,  # (h, w, 3) levels; see `average_light_kernel`
    contrast: F32Array2,  # (h, w) of the fringe, relative to the light's
    cells: I32Array2,  # (h / 8 up, w / 16 up) a bit for each surface that is compared
    unmixing: F32Array3,  # (N, 3, 3) see `NeutralLight`
    ambient: F32Array2,  # (N, 3) levels
    rho: F32Array2,  # (2, places)
    read_variance: f32,  # levels^2 of a mean
    noise_gain: f32,  # levels, of a mean
    even: f32,  # standard deviation of a place's contrast, as a fraction, where blur is the usual
    scatter: f32,  # by how much all of that is more
    out: F32Array3,  # (N, h, w) standard deviations; SAYS_NOTHING; undefined where a surface is not compared
    by_contrast: F32Array3,  # likewise: how that changes with the contrast, per 1; else (1, 1, 1)
):
    height, width = out.shape[1], out.shape[2]
    strips = strip_count(width, AT_ONCE)
    for t in range(height * strips):
        y, strip = t // strips, t % strips
        bits, first = cells[y // CELL_ROWS, strip], strip * AT_ONCE
        if bits != 0:
            count = ti.min(AT_ONCE, width - first)
            numbers = by_contrast.shape[0] * by_contrast.shape[1] * by_contrast.shape[2]
            asked = ti.select(numbers == out.shape[0] * height * width, count, 0)
            seen, sharp = [place_lanes(0.0) for _ in ti.static(range(3))], place_lanes(1.0)
            ring, turn = place_lanes(0.0), place_lanes(0.0)
            for k in range(count):
                for c in ti.static(range(3)):
                    seen[c][k] = light[y, first + k, c]
                sharp[k] = contrast[y, first + k]
            wrong, lost = MODEL_ERROR * channel_mean(seen), sharp - 1.0
            uneven = even * even + _LOST_DOUBT * _LOST_DOUBT * lost * lost
            for surface in range(out.shape[0]):
                if (bits >> surface) & 1 == 1:
                    bare = [seen[c] - ambient[surface, c] for c in ti.static(range(3))]
                    inverse = matrix_lanes(unmixing, surface, place_lanes)
                    vector = through(inverse, bare, True)
                    place = place_around(vector[0], vector[1])
                    for k in range(AT_ONCE):
                        at = ti.min(ti.max(ti.cast(place[k], ti.i32), 0), _PLACES - 1)  # of a NaN: any
                        ring[k], turn[k] = rho[0, at], rho[1, at]
                    swing = vector[2] * sharp * ring
                    size = ti.max(ti.sqrt(vector[0] * vector[0] + vector[1] * vector[1]), TINY)
                    unit = 1.0 / size
                    cosine, sine, turned = vector[0] * unit, vector[1] * unit, vector[2] * sharp * turn * unit
                    direction = [cosine + sine * turned, sine - cosine * turned, 0.0 - sharp * ring]
                    variance = uneven * swing * swing
                    for c in ti.static(range(3)):
                        across = direction[0] * inverse[c] + direction[1] * inverse[c + 3]
                        across += direction[2] * inverse[c + 6]
                        doubt = _AMBIENT_ERROR * ambient[surface, c]
                        noise = read_variance + noise_gain * ti.max(seen[c], 0.0) + wrong * wrong + doubt * doubt
                        variance += across * across * noise
                    by_sigma = 1.0 / (scatter * ti.sqrt(ti.max(variance, TINY)))
                    result = ti.select(seen[0] > SAYS_NOTHING, (size - swing) * by_sigma, SAYS_NOTHING)
                    changes = swing * by_sigma
                    for k in range(count):
                        out[surface, y, first + k] = result[k]
                    for k in range(asked):
                        by_contrast[surface, y, first + k] = changes[k]


def surface_residuals(lattice: Lattice, neutral: NeutralLight, levels: FrameLevels, code_doubt: float) -> _Residuals:
    """Return what each surface's matrix leaves over at every place.

    Parameters
    ----------
    lattice : Lattice
        The places' light.
    neutral : NeutralLight
        The surfaces.
    levels : FrameLevels
        The frame's noise.
    code_doubt : float
        Standard deviation of a cycle's contrast by the pattern's code, as a fraction; 0: there is no code.

    Returns
    -------
    (N, h, w) float32
        Standard deviations of independent noise; 0 where a place has no evidence.
    """
    size, count = lattice.contrast.shape, len(neutral.unmixing)
    out = np.empty((count, *size), np.float32)
    by_contrast = np.empty_like(out) if code_doubt > 0 else None
    cells = np.full(cells_of(size), (1 << count) - 1, np.int32)
    # A code's contrast goes in straight lines from cycle to cycle: around where they meet it is off its mean.
    even = 2 * UNEVEN if code_doubt > 0 else UNEVEN
    pixels = 2 * REACH_PX + 1
    fill_residuals(lattice.light, lattice.contrast, cells, neutral, levels, pixels, even, 1.0, out, by_contrast)
    said = lattice.says
    if by_contrast is not None:
        _take_off_code(lattice, out, by_contrast, said, code_doubt)
    return np.where(said, out, np.float32(0))


def measure_scatter(lattice: Lattice, residuals: _Residuals, inside: _Mask) -> float:
    """Return by how much more means of residuals along the stripes scatter than those of independent noise, at least 1.

    1, too, where most means see an edge.

    Parameters
    ----------
    lattice : Lattice
        The places.
    residuals : (N, h, w) float32
        See `surface_residuals`; the least of a place counts.
    inside : (h, w) bool
        Places that show one surface.
    """
    count = max(1, round(_SHARED_CYCLES * lattice.period_px / lattice.columns))
    least = np.take_along_axis(residuals, np.abs(residuals).argmin(axis=0)[None], 0)[0]
    whole = cv2.erode((inside & lattice.says).astype(np.uint8), np.ones((1, count), np.uint8)) > 0
    # A matrix that is wrong leaves the same over a cycle later.
    cycle = round(lattice.period_px / lattice.rows)
    means = cv2.blur(least[cycle:] - least[:-cycle], (count, 1))[whole[cycle:] & whole[:-cycle]] / np.sqrt(2)
    if 2 * len(means) <= np.count_nonzero(lattice.says):
        return 1.0
    return max(1.0, float(np.median(np.abs(means)) * np.sqrt(count)) / MEDIAN_SIZE)


def fill_residuals(
    light: F32,
    contrast: F32,
    cells: I32,
    neutral: NeutralLight,
    levels: FrameLevels,
    pixels: int,
    even: float,
    scatter: float,
    out: F32,
    by_contrast: F32 | None = None,
) -> None:
    """Do what `surface_residuals_kernel` does with means over some pixels."""
    noise = (levels.read_noise**2 / pixels, levels.noise_gain / pixels)
    changes = runtime.empty((1, 1, 1), np.float32) if by_contrast is None else by_contrast
    surface_residuals_kernel(light, contrast, cells, *neutral, *noise, even, scatter, out, changes)
    runtime.synchronize()


def _take_off_code(lattice: Lattice, residuals: _Residuals, by_contrast: _Residuals, said: _Mask, doubt: float) -> None:
    """Subtract from the residuals, (N, h, w) standard deviations, what a cycle's own contrast explains.

    By a code each cycle has one contrast. A matrix with more crosstalk looks like a cycle with less contrast: if every
    place's contrast were doubted by itself, many places of a cycle would be evidence of another surface.
    """
    sigma = _CODE_CYCLES * lattice.period_px
    places = 4 * np.pi * sigma**2 / lattice.pixels  # that the average is made of
    prior = 1 / (doubt**2 * max(places, 1.0))
    for left, change in zip(residuals, by_contrast, strict=True):
        counted = np.where(said, change / np.maximum(1, np.abs(left) / SIGMAS), np.float32(0))
        slope, square = (lattice.blurred(counted * values, sigma) for values in (left, change))
        left -= np.where(said, slope / (square + prior) * change, np.float32(0))
