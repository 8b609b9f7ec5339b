"""Which surface each place shows: the one whose matrix leaves the least over.

A pixel's three channels have two unknowns, brightness and phase; the misfit that is left under each surface's matrix
tells the surfaces apart, sharper than any mean colour, which the fringe goes through. With x, y and a the pixel's
b cos(phi), b sin(phi) and background as if its surface were neutral, it is

    left = |(x, y)| - a rho,

rho the contrast that the projector's light has at the bare phase of (x, y). At some phases two surfaces look alike:
misfits are averaged over a few pixels, which keeps edges sharp, and over a good part of a cycle.

Light is looked at as means over a few pixels along the stripes, at the places of a lattice of some rows a cycle; pixels
themselves are asked only where several surfaces meet.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array1, F32Array2, F32Array3, I32Array2, U8Array2, f32, i32, ti, u1, vec3
from tikernels.arrays import F32, I32, U8, LevelsImage
from tikernels.launching import kernel
from tikernels.phase.color_balance import Gains, gain_at
from tikernels.phase.crosstalk import Crosstalk, weighed_vector
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_vector import arctangent, color_at, matrix_of, modulation_of, phase_weights
from tikernels.phase.surface_matrix import waves
from tikernels.phase.surfaces import NO_SURFACE, surface_ambient, surface_matrix
from tikernels.raw.linearization import LEVEL_TYPES
from tikernels.strips import strip_count

_Misfits = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]
_Labels = npt.NDArray[np.uint8]
_Mask = npt.NDArray[np.bool_]

# A model is no better than this fraction of a pixel's light, and of the ambient light.
_MODEL_ERROR, _AMBIENT_ERROR = 0.009, 0.04
# Standard deviation of the logarithm of the contrast lost to blur, as a fraction of it, since lenses differ; and of a
# place's contrast: ambient light is not quite even over a surface.
_LOST_DOUBT, _UNEVEN = 0.6, 0.01
# A code's contrast, which goes in straight lines from cycle to cycle, is off its mean around where the lines meet.
_CORNERS = 0.02
# A place that fits no surface counts no more than this against one, and less where a whole neighbourhood is judged.
_MOST, _MOST_AROUND = 16.0, 4.0
# Pixels on either side in a mean, along the stripes: the noise of single ones biases the fitted matrices.
REACH_PX = 2
# Places that a thread looks at together, as the vector units of a CPU do; and rows of a cell of so many columns.
_AT_ONCE, _CELL_ROWS = 16, 8
_lanes = ti.types.vector(_AT_ONCE, ti.f32)
# So many pixels beside these count for them.
_BESIDE = 4
_wide_lanes = ti.types.vector(_AT_ONCE + 2 * _BESIDE, ti.f32)
# Places of the cycle in the table of the light's contrast.
_BINS = 256
# A code's contrast is told by what is around, a Gaussian in cycles; residuals count in full up to this many standard
# deviations.
_CODE_CYCLES, _TRUSTED = 0.3, 3.0
# The light of a place that says nothing, and what is left of it.
_SAYS_NOTHING = -1e9
# Gaussians that misfits are averaged over: px across the stripes, and along them where pixels are asked; cycles, and
# how much that one counts.
_NEAR_PX, _ALONG_PX = 1.6, 2.0
_AROUND_CYCLES, _AROUND = 0.4, 0.5
_ALONE = np.ones(1)
# A whole neighbourhood, in cycles.
_NEIGHBOURHOOD_CYCLES = 0.85
# So far from an edge between two places pixels are asked, px.
_EDGE_PX = 8
# A surface of fewer pixels is none, and neither is one whose pixels another explains as well, but for this much; or if
# its own model does not fit them, for the second.
LEAST_PX = 400
_BETTER, _MUCH_BETTER = 0.3, 1.0
# So is one of which no more than this share is inside: a mixture of two along their edge.
_LINE = 0.03
# No surface explains a place with a larger misfit, or a neighbourhood with one larger than this, also in units of what
# is usual in the frame.
_UNEXPLAINED, _UNEXPLAINED_AROUND, _UNUSUAL = 3.0, 1.4, 1.6
# What is left of unexplained places after an opening by this counts, px; of neighbourhoods, in cycles.
_OPENING_PX, _OPENING_CYCLES = 7, 1.0


class Lattice(NamedTuple):
    """Places of a frame, rows and columns apart, and the light around each."""

    light: npt.NDArray[np.float32]
    """(h, w, 3) levels, mean over a few pixels along the stripes; see `says`."""
    contrast: npt.NDArray[np.float32]
    """(h, w) by which blur and the mean multiply the fringe's first harmonic, beside the usual."""
    rows: int
    columns: int
    """px between the places."""
    period_px: float
    """Camera px a cycle."""

    @property
    def says(self) -> _Mask:
        """(h, w) which places show a fringe, and are not clipped."""
        return np.asarray(self.light[..., 0] > _SAYS_NOTHING)

    @property
    def pixels(self) -> int:
        """How many pixels a place stands for."""
        return self.rows * self.columns

    def blurred(self, values: npt.NDArray[Any], sigma_px: float) -> npt.NDArray[np.float32]:
        """Return values of the places, smoothed by a Gaussian."""
        sigma = (max(0.2, sigma_px / self.columns), max(0.2, sigma_px / self.rows))
        return np.asarray(cv2.GaussianBlur(values.astype(np.float32, copy=False), (0, 0), sigma[0], sigmaY=sigma[1]))

    def square(self, side_px: float) -> npt.NDArray[np.uint8]:
        """Return what a morphological operation looks at: a square of an odd number of places."""
        return np.ones([2 * round(side_px / step / 2) + 1 for step in (self.rows, self.columns)], np.uint8)


class NeutralLight(NamedTuple):
    """What each surface's light is as that of a neutral one."""

    unmixing: npt.NDArray[np.float32]
    """(N, 3, 3) takes it to b cos(phi), b sin(phi) and a."""
    ambient: npt.NDArray[np.float32]
    """(N, 3) light that each sends back besides, levels."""
    contrast: npt.NDArray[np.float32]
    """(2, bins + 1) b over a at the bare phase from -pi to pi, and its derivative."""

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
        sent = waves(light, np.linspace(-np.pi, np.pi, _BINS, endpoint=False))[0]
        vectors = phase_weights(np.eye(3), lag)
        cosine, sine, mean = vectors @ sent
        phases = np.linspace(-np.pi, np.pi, _BINS + 1)
        rho = np.interp(phases, np.arctan2(sine, cosine), np.hypot(cosine, sine) / mean, period=2 * np.pi)
        slope = (np.roll(rho[:-1], -1) - np.roll(rho[:-1], 1)) * (_BINS / (4 * np.pi))
        table = np.stack([rho, np.append(slope, slope[0])])
        tables = (vectors @ np.linalg.inv(matrices), ambient, table)
        return cls(*(np.ascontiguousarray(part, np.float32) for part in tables))


class Relabelled(NamedTuple):
    """Which surface each place shows, once misfits have been compared."""

    labels: _Labels
    """(h, w) new numbers; NO_SURFACE stays."""
    kept: list[int]
    """Which of the surfaces before have those numbers."""
    unexplained: _Mask
    """(h, w) places that fit none."""
    around: _Misfits
    """(n, h, w) the misfits of what was kept, averaged over a good part of a cycle."""


@kernel
def average_light_kernel(
    image: AnyArray3,  # (H, W, 3) levels
    gains: F32Array3,  # (Hg, Wg, 3) that balance a neutral surface
    spacing_px: i32,  # between these nodes
    phase_weights: F32Array2,  # (3, 3)
    blur: F32Array2,  # (Hn, Wn) what blur leaves of the contrast around every node
    node_px: i32,  # between those
    unlit: U8Array2,  # (H, W) 1: shows no fringe
    clipped: f32,  # levels
    rows: i32,  # px between places
    columns: i32,
    reach: i32,  # px of a mean on either side
    cells: I32Array2,  # (h / 8 up, w / 16 up) 0: nobody asks
    out: F32Array3,  # (h, w, 3) levels; _SAYS_NOTHING
    out_contrast: F32Array2,  # (h, w) see `Lattice`
):
    height, width = out.shape[0], out.shape[1]
    strips = strip_count(width, _AT_ONCE)
    for t in range(height * strips):
        i, first = t // strips, t % strips * _AT_ONCE
        if cells[i // _CELL_ROWS, t % strips] != 0:
            weights, y = matrix_of(phase_weights), i * rows
            for j in range(first, ti.min(first + _AT_ONCE, width)):
                middle = ti.min(j * columns + columns // 2, image.shape[1] - 1)
                gain = gain_at(gains, spacing_px, y, middle)
                total, last, most, cosine, sine = vec3(0.0), vec3(0.0), 0.0, 0.0, 0.0
                for k in range(-reach, reach + 1):
                    x = ti.min(ti.max(middle + k, 0), image.shape[1] - 1)
                    seen = color_at(image, y, x)
                    vector = weighed_vector(seen, gain, weights)
                    cosine += vector.x * last.x + vector.y * last.y
                    sine += vector.y * last.x - vector.x * last.y
                    total, last, most = total + seen, vector, ti.max(most, seen.max())
                # A phase that is linear over n pixels has the variance slope^2 (n^2 - 1) / 12.
                slope = ti.select(cosine > 0.0, sine / ti.max(cosine, 1e-9), 1.0)
                lost = 1.0 + reach * (reach + 1) / 6.0 * ti.min(slope * slope, 1.0)
                a, b = ti.min(y // node_px, blur.shape[0] - 1), ti.min(middle // node_px, blur.shape[1] - 1)
                out_contrast[i, j] = blur[a, b] / lost
                says = (most < clipped) & (ti.cast(unlit[ti.min(y, image.shape[0] - 1), middle], i32) == 0)
                for c in ti.static(range(3)):
                    out[i, j, c] = ti.select(says, total[c] / (2 * reach + 1), _SAYS_NOTHING)


def average_light(
    image: LevelsImage,
    gains: Gains,
    crosstalk: Crosstalk,
    blur: npt.NDArray[np.float32],
    node_px: int,
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
        What they were measured with.
    blur : (Hn, Wn) float32
        What the camera's blur leaves of the contrast around every node, beside the usual.
    node_px : int
        px between these nodes.
    unlit : (H, W) bool
        Which pixels show no fringe: they say nothing.
    levels : FrameLevels
        Neither do clipped ones.
    rows, columns : int
        px between places.
    reach_px : int
        Pixels of a mean on either side.
    cells : int32, optional
        Which cells of 8 x 16 places are asked, others are undefined; None: all.
    """
    image = checks.read_array("image", image, (gains.height, gains.width, 3), *LEVEL_TYPES)
    size = (-(-gains.height // rows), -(-gains.width // columns))
    cells = np.ones(cells_of(size), np.int32) if cells is None else cells
    out, contrast = runtime.empty((*size, 3), np.float32), runtime.empty(size, np.float32)
    nodes = (gains.gains, gains.spacing_px, crosstalk.weights, blur, node_px)
    average_light_kernel(
        image, *nodes, unlit.view(np.uint8), levels.clipped, rows, columns, reach_px, cells, out, contrast
    )
    return out, contrast


def cells_of(size: tuple[int, int]) -> tuple[int, int]:
    """Return how many cells so many places have."""
    return -(-size[0] // _CELL_ROWS), -(-size[1] // _AT_ONCE)


@kernel
def surface_misfits_kernel(
    light: F32Array3,  # (h, w, 3) levels; see `average_light_kernel`
    contrast: F32Array2,  # (h, w) of the fringe, beside the light's
    cells: I32Array2,  # (h / 8 up, w / 16 up) a bit for each surface that is asked
    unmixing: F32Array3,  # (N, 3, 3) see `NeutralLight`
    ambient: F32Array2,  # (N, 3) levels
    rho: F32Array2,  # (2, bins + 1)
    read_variance: f32,  # levels^2 of a mean
    noise_gain: f32,  # levels, of a mean
    even: f32,  # standard deviation of a place's contrast, as a fraction, where blur is the usual
    out: F32Array3,  # (N, h, w) standard deviations; _SAYS_NOTHING; undefined where a surface is not asked
    by_contrast: F32Array3,  # likewise: how that changes with the contrast, per 1
):
    height, width = out.shape[1], out.shape[2]
    strips = strip_count(width, _AT_ONCE)
    for t in range(height * strips):
        y, strip = t // strips, t % strips
        bits, first = cells[y // _CELL_ROWS, strip], strip * _AT_ONCE
        if bits != 0:
            count = ti.min(_AT_ONCE, width - first)
            red, green, blue, sharp = _lanes(0.0), _lanes(0.0), _lanes(0.0), _lanes(1.0)
            bare, ring, turn, result, changes = _lanes(0.0), _lanes(0.0), _lanes(0.0), _lanes(0.0), _lanes(0.0)
            for k in range(count):
                red[k], green[k], blue[k] = light[y, first + k, 0], light[y, first + k, 1], light[y, first + k, 2]
                sharp[k] = contrast[y, first + k]
            for surface in range(out.shape[0]):
                if (bits >> surface) & 1 == 1:
                    inverse, rest = surface_matrix(unmixing, surface), surface_ambient(ambient, surface)
                    for k in range(_AT_ONCE):
                        vector = inverse @ (vec3(red[k], green[k], blue[k]) - rest)
                        bare[k] = (arctangent(vector.y, vector.x) + np.pi) * ti.static(_BINS / (2 * np.pi))
                    for k in range(_AT_ONCE):
                        place = ti.min(ti.cast(bare[k], ti.i32), _BINS - 1)
                        ring[k] = sharp[k] * (rho[0, place] + (bare[k] - place) * (rho[0, place + 1] - rho[0, place]))
                        turn[k] = sharp[k] * rho[1, place]
                    for k in range(_AT_ONCE):
                        seen = vec3(red[k], green[k], blue[k])
                        vector = inverse @ (seen - rest)
                        swing, size = vector.z * ring[k], ti.max(modulation_of(vector), 1e-9)
                        cosine, sine, turned = vector.x / size, vector.y / size, vector.z * turn[k] / size
                        across = vec3(cosine + sine * turned, sine - cosine * turned, -ring[k]) @ inverse
                        wrong, doubt, lost = _MODEL_ERROR * seen.sum() / 3.0, _AMBIENT_ERROR * rest, sharp[k] - 1.0
                        noise = read_variance + noise_gain * ti.max(seen, 0.0) + wrong * wrong + doubt * doubt
                        uneven = even * even + _LOST_DOUBT * _LOST_DOUBT * lost * lost
                        variance = (across * across).dot(noise) + uneven * swing * swing
                        by_sigma = 1.0 / ti.sqrt(ti.max(variance, 1e-12))
                        result[k] = ti.select(red[k] > _SAYS_NOTHING, (size - swing) * by_sigma, _SAYS_NOTHING)
                        changes[k] = swing * by_sigma
                    for k in range(count):
                        out[surface, y, first + k] = result[k]
                        by_contrast[surface, y, first + k] = changes[k]


def surface_misfits(lattice: Lattice, neutral: NeutralLight, levels: FrameLevels, code_doubt: float) -> _Misfits:
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
        Squares of standard deviations, at most 16; -1 where a place says nothing.
    """
    size, count = lattice.contrast.shape, len(neutral.unmixing)
    out, by_contrast = (np.empty((count, *size), np.float32) for _ in range(2))
    cells = np.full(cells_of(size), (1 << count) - 1, np.int32)
    even = _CORNERS if code_doubt > 0 else _UNEVEN
    _misfits(lattice.light, lattice.contrast, cells, neutral, levels, 2 * REACH_PX + 1, even, out, by_contrast)
    said = lattice.says
    if code_doubt > 0:
        _take_off_code(lattice, out, by_contrast, said, code_doubt)
    return np.where(said, np.minimum(out**2, _MOST), np.float32(-1))


def _misfits(
    light: F32,
    contrast: F32,
    cells: I32,
    neutral: NeutralLight,
    levels: FrameLevels,
    pixels: int,
    even: float,
    *out: F32,
) -> None:
    """Do what `surface_misfits_kernel` does with means over some pixels."""
    noise = (levels.read_noise**2 / pixels, levels.noise_gain / pixels)
    surface_misfits_kernel(light, contrast, cells, *neutral, *noise, even, *out)
    runtime.synchronize()


def _take_off_code(lattice: Lattice, residuals: _Misfits, by_contrast: _Misfits, said: _Mask, doubt: float) -> None:
    """Subtract from the residuals, (N, h, w) standard deviations, what a cycle's own contrast explains.

    By a code each cycle has one contrast. A matrix with more crosstalk looks like a cycle with less contrast: if every
    place's contrast were doubted by itself, many places of a cycle would be evidence of another surface.
    """
    sigma = _CODE_CYCLES * lattice.period_px
    places = 4 * np.pi * sigma**2 / lattice.pixels  # that the average is made of
    prior = 1 / (doubt**2 * max(places, 1.0))
    for left, change in zip(residuals, by_contrast, strict=True):
        counted = np.where(said, change / np.maximum(1, np.abs(left) / _TRUSTED), np.float32(0))
        slope, square = (lattice.blurred(counted * values, sigma) for values in (left, change))
        left -= np.where(said, slope / (square + prior) * change, np.float32(0))


def relabel(
    lattice: Lattice, misfits: _Misfits, before: _Labels, fits: _Mask, founding: _Mask, *, afresh: bool = False
) -> Relabelled:
    """Give every place to the surface that fits it best, and drop surfaces that none needs.

    Parameters
    ----------
    lattice : Lattice
        The places.
    misfits : (N, h, w) float32
        See `surface_misfits`.
    before : (h, w) uint8
        The surfaces that places are taken to show so far.
    fits : (N,) bool
        Which surfaces fit their places; others are kept only where the rest is much worse.
    founding : (N,) bool
        Which ones the frame began with: none that came later takes the place of one.
    afresh : bool
        Whether only NO_SURFACE is known of what places showed before.
    """
    shown = before != NO_SURFACE
    said = (misfits[0] >= 0) & shown
    averages, around = _averaged(lattice, misfits, said)
    if afresh:
        before = np.where(shown, averages.argmin(axis=0), NO_SURFACE).astype(np.uint8)
    kept = list(range(len(misfits)))
    own = (np.where(said, before, NO_SURFACE).ravel() == np.arange(len(misfits))[:, None]).astype(np.float32)
    sizes = own.sum(axis=1)
    means = (own @ averages.reshape(len(misfits), -1).T) / np.maximum(sizes, 1)[:, None]
    for k in sorted(kept, key=lambda k: (bool(founding[k]), sizes[k])):
        others = [j for j in kept if j != k]
        rivals = [j for j in others if founding[j] or not founding[k]]
        if others and sizes[k] == 0:
            kept = others
        elif rivals and means[k, rivals].min() - means[k, k] < (_BETTER if fits[k] else _MUCH_BETTER):
            kept = others
    while True:
        nearest = averages[kept].argmin(axis=0)
        sizes = np.bincount(nearest[said], minlength=len(kept))
        worth = np.minimum(
            sizes * (lattice.pixels / LEAST_PX), _insides(said, nearest, len(kept)) / (_LINE * sizes + 1e-9)
        )
        if len(kept) == 1 or worth.min() >= 1:
            break
        kept.pop(int(worth.argmin()))
    labels = np.where(shown, nearest, NO_SURFACE).astype(np.uint8)
    least = np.take_along_axis(averages[kept], nearest[None], 0)[0]
    own_misfit = np.take_along_axis(misfits[kept], nearest[None], 0)[0]
    unexplained = _opened(said & (least > _UNEXPLAINED), lattice.square(_OPENING_PX))
    wide = lattice.square(_OPENING_CYCLES * lattice.period_px)
    unexplained |= _opened(_unusual_neighbourhoods(lattice, own_misfit, said), wide)
    return Relabelled(labels, kept, unexplained, around[kept])


def _insides(said: _Mask, labels: npt.NDArray[np.intp], count: int) -> npt.NDArray[np.intp]:
    """Return how many places show each surface as all eight around them do."""
    alike, near = np.where(said, labels + 1, 0).astype(np.uint8), np.ones((3, 3), np.uint8)
    alike[cv2.dilate(alike, near) != cv2.erode(alike, near)] = 0
    return np.bincount(alike.ravel(), minlength=count + 1)[1 : count + 1]


def _averaged(lattice: Lattice, misfits: _Misfits, said: _Mask) -> tuple[_Misfits, _Misfits]:
    """Average every surface's misfits over a few pixels and a part of a cycle, and over the latter alone."""
    sigma, weight = _AROUND_CYCLES * lattice.period_px, said.astype(np.float32)
    near = cv2.getGaussianKernel(2 * int(3 * _NEAR_PX / lattice.rows) + 1, _NEAR_PX / lattice.rows)
    near_share = np.maximum(cv2.sepFilter2D(weight, -1, _ALONE, near), 1e-6)
    wide_share = np.maximum(lattice.blurred(weight, sigma), 1e-6)
    averages, wide = np.empty_like(misfits), np.empty_like(misfits)
    for surface, misfit in enumerate(misfits):
        counted = np.where(said, misfit, np.float32(0))
        wide[surface] = lattice.blurred(counted, sigma) / wide_share
        averages[surface] = cv2.sepFilter2D(counted, -1, _ALONE, near) / near_share + _AROUND * wide[surface]
    averages /= 1 + _AROUND
    return averages, wide


def _unusual_neighbourhoods(lattice: Lattice, misfit: _Misfits, said: _Mask) -> _Mask:
    """Return where the misfit of places to their own surfaces is larger than elsewhere, cycle by cycle."""
    sigma = _NEIGHBOURHOOD_CYCLES * lattice.period_px
    share = lattice.blurred(said, sigma)
    mean = lattice.blurred(np.where(said, np.minimum(misfit, _MOST_AROUND), 0), sigma) / np.maximum(share, 0.1)
    usual = float(np.median(mean[share > 0.5])) if (share > 0.5).any() else 1.0
    return np.asarray(said & (mean > max(_UNEXPLAINED_AROUND, _UNUSUAL * usual)))


def _opened(mask: _Mask, square: npt.NDArray[np.uint8]) -> _Mask:
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, square) > 0)


def cells_of_pixels(lattice: Lattice, labels: _Labels, size: tuple[int, int]) -> I32:
    """Return a bit for each surface that the pixels of a cell may show, where that are several; else 0.

    Parameters
    ----------
    lattice : Lattice
        The places.
    labels : (h, w) uint8
        What these show.
    size : (int, int)
        The image's height and width, px.
    """
    bits = np.where(labels == NO_SURFACE, 0, 1 << labels.astype(np.int32)).astype(np.int32)
    for axis, reach in ((0, -(-_EDGE_PX // lattice.rows)), (1, -(-_EDGE_PX // lattice.columns))):
        bits = np.moveaxis(bits, axis, 0)
        near = bits.copy()
        for step in range(1, reach + 1):
            near[step:] |= bits[:-step]
            near[:-step] |= bits[step:]
        bits = np.moveaxis(near, 0, axis)
    rows, columns = (
        np.minimum(np.arange(cells) * side // step, places - 1)
        for cells, side, step, places in zip(
            cells_of(size), (_CELL_ROWS, _AT_ONCE), (lattice.rows, lattice.columns), labels.shape, strict=True
        )
    )
    cells = np.bitwise_or.reduceat(np.bitwise_or.reduceat(bits, rows, axis=0), columns, axis=1)
    return np.ascontiguousarray(np.where(cells & (cells - 1), cells, 0))


@ti.func
def place_at(values: F32Array3, surface: i32, v: f32, u: f32) -> f32:
    """Interpolate a surface's values between places, bilinearly."""
    v = ti.min(ti.max(v, 0.0), ti.cast(values.shape[1] - 1, ti.f32))
    u = ti.min(ti.max(u, 0.0), ti.cast(values.shape[2] - 1, ti.f32))
    i, j = ti.cast(v, ti.i32), ti.cast(u, ti.i32)
    i1, j1 = ti.min(i + 1, values.shape[1] - 1), ti.min(j + 1, values.shape[2] - 1)
    upper = values[surface, i, j] + (u - j) * (values[surface, i, j1] - values[surface, i, j])
    lower = values[surface, i1, j] + (u - j) * (values[surface, i1, j1] - values[surface, i1, j])
    return upper + (v - i) * (lower - upper)


@ti.func
def asks(cells: I32Array2, y: i32, strip: i32, surface: i32) -> u1:
    """Whether a surface is asked for sixteen places of a row."""
    return (cells[y // _CELL_ROWS, strip] >> surface) & 1 == 1


@ti.func
def row_misfits(misfits: F32Array3, cells: I32Array2, surface: i32, y: i32, strip: i32):
    """Load a surface's misfits of sixteen pixels and of those beside them; _SAYS_NOTHING where it is not asked."""
    first, last = strip * _AT_ONCE, misfits.shape[2] - 1
    before, after = ti.max(strip - 1, 0), ti.min(strip + 1, cells.shape[1] - 1)
    left = _wide_lanes(_SAYS_NOTHING)
    if asks(cells, y, before, surface):
        for k in range(ti.min(_BESIDE, first)):
            left[_BESIDE - 1 - k] = misfits[surface, y, first - 1 - k]
    if asks(cells, y, strip, surface):
        for k in range(ti.min(_AT_ONCE, last + 1 - first)):
            left[_BESIDE + k] = misfits[surface, y, first + k]
    if asks(cells, y, after, surface):
        for k in range(ti.min(_BESIDE, last + 1 - first - _AT_ONCE)):
            left[_BESIDE + _AT_ONCE + k] = misfits[surface, y, first + _AT_ONCE + k]
    return left


@ti.func
def near_misfits(
    misfits: F32Array3, cells: I32Array2, near: F32Array1, along: F32Array1, surface: i32, y: i32, strip: i32
):
    """Return the squares of a surface's misfits around sixteen pixels, averaged across the stripes, then along them."""
    sums, counts, total, weight = _wide_lanes(0.0), _wide_lanes(0.0), _lanes(0.0), _lanes(1e-6)
    for v in range(ti.max(y - near.shape[0] + 1, 0), ti.min(y + near.shape[0], misfits.shape[1])):
        left = row_misfits(misfits, cells, surface, v, strip)
        for k in range(_AT_ONCE + 2 * _BESIDE):
            share = ti.select(left[k] > _SAYS_NOTHING, near[ti.abs(v - y)], 0.0)
            sums[k] += share * ti.min(left[k] * left[k], _MOST)
            counts[k] += share
    for u in ti.static(range(2 * _BESIDE + 1)):
        for k in range(_AT_ONCE):
            total[k] += along[ti.abs(u - _BESIDE)] * sums[k + u]
            weight[k] += along[ti.abs(u - _BESIDE)] * counts[k + u]
    return total / weight


@kernel
def choose_surfaces_kernel(
    misfits: F32Array3,  # (N, H, W) standard deviations of pixels; see `surface_misfits_kernel`
    around: F32Array3,  # (N, h, w) their squares' averages around places of the lattice
    cells: I32Array2,  # (H / 8 up, W / 16 up) a bit for each surface that is asked
    near: F32Array1,  # weights of pixels so far across the stripes
    along: F32Array1,  # and along them: _BESIDE + 1
    rows: i32,  # px between places
    columns: i32,
    labels: U8Array2,  # (H, W) changed where surfaces are asked, unless NO_SURFACE
):
    height, width = labels.shape[0], labels.shape[1]
    strips = strip_count(width, _AT_ONCE)
    for t in range(height * strips):
        y, strip, first = t // strips, t % strips, t % strips * _AT_ONCE
        if cells[y // _CELL_ROWS, strip] != 0:
            best, which = _lanes(1e9), _lanes(0.0)
            for surface in range(misfits.shape[0]):
                if asks(cells, y, strip, surface):
                    value = near_misfits(misfits, cells, near, along, surface, y, strip)
                    for k in range(_AT_ONCE):
                        value[k] += _AROUND * place_at(around, surface, y / rows, (first + k + 0.5) / columns - 0.5)
                        which[k] = ti.select(value[k] < best[k], ti.cast(surface, ti.f32), which[k])
                        best[k] = ti.min(value[k], best[k])
            for k in range(ti.min(_AT_ONCE, width - first)):
                if ti.cast(labels[y, first + k], ti.i32) != NO_SURFACE:
                    labels[y, first + k] = ti.cast(which[k], ti.u8)


def choose_surfaces(
    light: F32,
    contrast: F32,
    cells: I32,
    neutral: NeutralLight,
    levels: FrameLevels,
    code_doubt: float,
    lattice: Lattice,
    around: _Misfits,
    out: U8,
) -> None:
    """Give every pixel of some cells to the surface that fits it best.

    Parameters
    ----------
    light, contrast : (H, W, 3), (H, W) float32
        Of single pixels; see `average_light`.
    cells : int32
        A bit for each surface that pixels of a cell of 8 x 16 may show; 0: its labels stay.
    neutral, levels, code_doubt, lattice
        See `surface_misfits`.
    around : (N, h, w) float32
        See `Relabelled`.
    out : (H, W) uint8
        The labels; NO_SURFACE stays.
    """
    size = (len(neutral.unmixing), *(int(n) for n in contrast.shape))
    misfits, by_contrast = (runtime.empty(size, np.float32) for _ in range(2))
    # A pixel does not tell what its cycle's contrast is.
    even = float(np.hypot(code_doubt, _UNEVEN))
    _misfits(light, contrast, cells, neutral, levels, 1, even, misfits, by_contrast)
    near, along = (
        np.exp(-0.5 * (np.arange(reach + 1) / sigma) ** 2).astype(np.float32)
        for reach, sigma in ((3, _NEAR_PX), (_BESIDE, _ALONG_PX))
    )
    choose_surfaces_kernel(misfits, around, cells, near, along, lattice.rows, lattice.columns, out)
