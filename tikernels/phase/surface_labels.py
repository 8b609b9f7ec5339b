"""Which surface each pixel shows: the one whose matrix leaves the least over.

A pixel's three channels have two unknowns, brightness and phase; the misfit that is left under each surface's matrix
(`phase_fit.residual_of`) tells the surfaces apart, sharper than any mean colour, which the fringe goes through. At some
phases two surfaces look alike: misfits are averaged over a few pixels, which keeps edges sharp, and over a good part of
a cycle.
"""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array1, F32Array2, F32Array3, U8Array2, f32, i32, ti, vec3
from tikernels.arrays import F32, LevelsImage
from tikernels.launching import kernel
from tikernels.phase.channel_template import blurred, cycle_and_slope, load_harmonics
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import equalized
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_fit import residual_of
from tikernels.phase.phase_vector import arctangent, color_at, matrix_of
from tikernels.phase.surfaces import NO_SURFACE, shows_surface, surface_ambient, surface_matrix
from tikernels.raw.linearization import LEVEL_TYPES
from tikernels.strips import strip_count

_Misfits = npt.NDArray[np.float32]
_Labels = npt.NDArray[np.uint8]
_Mask = npt.NDArray[np.bool_]

# A model is no better than this fraction of a pixel's light, and of the ambient light.
_MODEL_ERROR, _AMBIENT_ERROR = 0.009, 0.04
# A pixel that fits no surface counts no more than this against one, and less where a whole neighbourhood is judged.
_MOST, _MOST_AROUND = 16.0, 4.0
# Pixels that a thread looks at together, as the vector units of a CPU do.
_PIXELS_AT_ONCE = 16
_lanes = ti.types.vector(_PIXELS_AT_ONCE, ti.f32)
# A code's contrast is told by what is around, a Gaussian in cycles; residuals count in full up to this many standard
# deviations.
_CODE_CYCLES, _TRUSTED = 0.25, 3.0
# The residual of a pixel that is clipped, or shows no surface.
_SAYS_NOTHING = 1e3
# Gaussians that misfits are averaged over: px along the stripes and across them; cycles, and how much that one counts.
_NEAR_PX = (2.0, 1.6)
_AROUND_CYCLES, _AROUND = 0.4, 0.5
# A whole neighbourhood, in cycles; and how far wide averages are computed on a coarser grid, px.
_NEIGHBOURHOOD_CYCLES = 0.85
_GRID_PX = 4
# A surface of fewer pixels is none, and neither is one whose pixels another explains as well, but for this much; or if
# its own model does not fit them, for the second.
LEAST_PX = 400
_BETTER, _MUCH_BETTER = 0.3, 1.0
# No surface explains a place with a larger misfit, or a neighbourhood with one larger than this, also in units of what
# is usual in the frame.
_UNEXPLAINED, _UNEXPLAINED_AROUND, _UNUSUAL = 3.0, 1.4, 1.6
# What is left of unexplained places after an opening by this counts, px; of neighbourhoods, in cycles.
_OPENING_PX, _OPENING_CYCLES = 7, 1.5


class Fringe(NamedTuple):
    """How the fringe of each place differs from the template."""

    contrast_doubt: npt.NDArray[np.float32]
    """(Hg, Wg) standard deviation of a pixel's contrast, as a fraction, around every node of a grid."""
    code_doubt: float
    """Standard deviation of a cycle's contrast by the pattern's code, as a fraction; 0: there is no code."""
    contrast: npt.NDArray[np.float32]
    """(Hg, Wg) likewise: by what blur multiplies the first harmonic."""
    spacing_px: int
    """px between the grid's nodes."""


class Relabelled(NamedTuple):
    """Which surface each pixel shows, once misfits have been compared."""

    labels: _Labels
    """(H, W) new numbers; NO_SURFACE stays."""
    kept: list[int]
    """Which of the surfaces before have those numbers."""
    unexplained: _Mask
    """(H, W) pixels that fit none."""


@kernel
def surface_misfits_kernel(
    image: AnyArray3,  # (H, W, 3) levels
    labels: U8Array2,  # (H, W) see `Surfaces`
    mixing: F32Array3,  # (N, 3, 3)
    unmixing: F32Array3,  # (N, 3, 3)
    ambient: F32Array2,  # (N, 3) levels
    phase_weights: F32Array2,  # (3, 3)
    correction: F32Array1,  # (bins + 1,) rad
    template: F32Array2,  # (3, terms)
    clipped: f32,  # levels
    read_noise: f32,  # levels
    noise_gain: f32,  # levels
    contrast_doubt: F32Array2,  # (Hg, Wg) as a fraction
    contrast: F32Array2,  # (Hg, Wg) beside the template's, around every node; see `Fringe`
    spacing_px: i32,  # between nodes
    step: i32,  # px between the pixels that are looked at
    out: F32Array3,  # (N, ceil(H / step), ceil(W / step)) standard deviations; _SAYS_NOTHING
    by_contrast: F32Array3,  # likewise: how that changes with the contrast, per 1
):
    height, width = out.shape[1], out.shape[2]
    strips = strip_count(width, _PIXELS_AT_ONCE)
    for t in range(out.shape[0] * height * strips):
        surface, y, first = t // (height * strips), t // strips % height, t % strips * _PIXELS_AT_ONCE
        weights, harmonics = matrix_of(phase_weights), load_harmonics(template)
        matrix, inverse = surface_matrix(mixing, surface), surface_matrix(unmixing, surface)
        rest = surface_ambient(ambient, surface)
        count = ti.min(_PIXELS_AT_ONCE, width - first)
        red, green, blue, shown = _lanes(0.0), _lanes(0.0), _lanes(0.0), _lanes(0.0)
        phase, result, changes = _lanes(0.0), _lanes(0.0), _lanes(0.0)
        for k in range(count):
            seen = color_at(image, y * step, (first + k) * step)
            red[k], green[k], blue[k] = seen.x, seen.y, seen.z
            says = shows_surface(labels, y * step, (first + k) * step) & (seen.max() < clipped)
            shown[k] = ti.select(says, 1.0, 0.0)
        for k in range(_PIXELS_AT_ONCE):
            vector = weights @ (inverse @ (vec3(red[k], green[k], blue[k]) - rest))
            phase[k] = arctangent(vector.y, vector.x)
        for k in range(_PIXELS_AT_ONCE):
            phase[k] = equalized(phase[k], correction)
        for k in range(_PIXELS_AT_ONCE):
            seen = vec3(red[k], green[k], blue[k])
            wrong, doubt = _MODEL_ERROR * seen.sum() / 3.0, _AMBIENT_ERROR * rest
            noise = read_noise * read_noise + noise_gain * ti.max(seen, 0.0) + wrong * wrong + doubt * doubt
            weight = 1.0 / ti.sqrt(noise)
            i = ti.min(y * step // spacing_px, contrast.shape[0] - 1)
            j = ti.min((first + k) * step // spacing_px, contrast.shape[1] - 1)
            cycle, slope = cycle_and_slope(blurred(harmonics, contrast[i, j]), phase[k])
            model, change = weight * (matrix @ cycle), weight * (matrix @ slope)
            swing = weight * (matrix @ (cycle - 1.0))
            left, slope_of = residual_of(weight * (seen - rest), model, change, swing, contrast_doubt[i, j])
            result[k] = ti.select(shown[k] > 0.5, left, _SAYS_NOTHING)
            changes[k] = slope_of
        for k in range(count):
            out[surface, y, first + k] = result[k]
            by_contrast[surface, y, first + k] = changes[k]


def surface_misfits(
    image: LevelsImage,
    crosstalk: Crosstalk,
    levels: FrameLevels,
    correction: F32,
    template: F32,
    fringe: Fringe,
    period_px: float,
    step: int = 1,
) -> _Misfits:
    """Return what each surface's matrix leaves over of every pixel.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels, stripes along the rows.
    crosstalk : Crosstalk
        With the surfaces; of their labels only NO_SURFACE matters.
    levels : FrameLevels
        The frame's noise; clipped pixels say nothing.
    correction : (bins + 1,) float32
        rad to add to the arctangent; see `equalization.correction_table`.
    template : (3, terms) float32
        One cycle of a neutral surface's channels.
    fringe : Fringe
        How pixels' fringes differ from the template.
    period_px : float
        Camera px a cycle.
    step : int
        px between the pixels that are looked at, both ways.

    Returns
    -------
    (N, ceil(H / step), ceil(W / step)) float32
        Squares of standard deviations, at most 16; -1 where a pixel says nothing.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    image = checks.read_array("image", image, (None, None, 3), *LEVEL_TYPES)
    correction = checks.read_array("correction", correction, (None,), np.float32)
    surfaces = crosstalk.surfaces
    size = (-(-int(image.shape[0]) // step), -(-int(image.shape[1]) // step))
    out, by_contrast = (np.empty((len(surfaces.mixing), *size), np.float32) for _ in range(2))
    surface_misfits_kernel(
        image,
        surfaces.labels,
        surfaces.mixing,
        surfaces.unmixing,
        surfaces.ambient,
        crosstalk.weights,
        correction,
        template,
        levels.clipped,
        levels.read_noise,
        levels.noise_gain,
        fringe.contrast_doubt,
        fringe.contrast,
        fringe.spacing_px,
        step,
        out,
        by_contrast,
    )
    runtime.synchronize()
    said = out[0] != _SAYS_NOTHING
    if fringe.code_doubt > 0:
        _take_off_code(out, by_contrast, said, fringe.code_doubt, period_px, step)
    return np.where(said, np.minimum(out**2, _MOST), np.float32(-1))


def _take_off_code(
    residuals: _Misfits, by_contrast: _Misfits, said: _Mask, doubt: float, period_px: float, step: int
) -> None:
    """Subtract from the residuals, (N, H, W) standard deviations, what a cycle's own contrast explains.

    By a code each cycle has one contrast. A matrix with more crosstalk looks like a cycle with less contrast: if every
    pixel's contrast were doubted by itself, many pixels of a cycle would be evidence of another surface.
    """
    sigma = _CODE_CYCLES * period_px
    pixels = 4 * np.pi * (sigma / step) ** 2  # that the average is made of
    prior = 1 / (doubt**2 * pixels)
    for left, change in zip(residuals, by_contrast, strict=True):
        counted = np.where(said, change / np.maximum(1, np.abs(left) / _TRUSTED), np.float32(0))
        slope, square = (_wide(counted * values, sigma, step) for values in (left, change))
        left -= np.where(said, _enlarged(slope / (square + prior), said.shape) * change, np.float32(0))


def relabel(
    misfits: _Misfits,
    before: _Labels,
    fits: _Mask,
    founding: _Mask,
    period_px: float,
    step: int = 1,
    *,
    afresh: bool = False,
) -> Relabelled:
    """Give every pixel to the surface that fits it best, and drop surfaces that none needs.

    Parameters
    ----------
    misfits : (N, H, W) float32
        See `surface_misfits`.
    before : (H, W) uint8
        The surfaces that pixels are taken to show so far.
    fits : (N,) bool
        Which surfaces fit their pixels; others are kept only where the rest is much worse.
    founding : (N,) bool
        Which ones the frame began with: none that came later takes the place of one.
    period_px : float
        Camera px a cycle.
    step : int
        px between the pixels, both ways.
    afresh : bool
        Whether only NO_SURFACE is known of what pixels showed before.
    """
    said = misfits[0] >= 0
    averages = _averaged(misfits, said, period_px, step)
    if afresh:
        before = np.where(before == NO_SURFACE, NO_SURFACE, averages.argmin(axis=0)).astype(np.uint8)
    kept = list(range(len(misfits)))
    sizes = np.bincount(before[said], minlength=len(misfits))
    for k in sorted(kept, key=lambda k: (bool(founding[k]), int(sizes[k]))):
        own = said & (before == k)
        others = [j for j in kept if j != k]
        rivals = [j for j in others if founding[j] or not founding[k]]
        if others and not own.any():
            kept = others
        elif rivals:
            least = min(averages[j][own].mean() for j in rivals) - averages[k][own].mean()
            if least < (_BETTER if fits[k] else _MUCH_BETTER):
                kept = others
    while True:
        nearest = averages[kept].argmin(axis=0)
        sizes = np.bincount(nearest[said], minlength=len(kept))
        if len(kept) == 1 or sizes.min() * step**2 >= LEAST_PX:
            break
        kept.pop(int(sizes.argmin()))
    labels = np.where(before == NO_SURFACE, NO_SURFACE, nearest).astype(np.uint8)
    least = np.take_along_axis(averages[kept], nearest[None], 0)[0]
    own = np.take_along_axis(misfits[kept], nearest[None], 0)[0]
    unexplained = _opened(said & (least > _UNEXPLAINED), _OPENING_PX, step)
    unexplained |= _opened(_unusual_neighbourhoods(own, said, period_px, step), _OPENING_CYCLES * period_px, step)
    return Relabelled(labels, kept, unexplained)


def _averaged(misfits: _Misfits, said: _Mask, period_px: float, step: int) -> _Misfits:
    """Average every surface's misfits over a few pixels, and over a part of a cycle."""
    weight = said.astype(np.float32)
    near_share = np.maximum(_near(weight, step), 1e-6)
    wide_share = np.maximum(_wide(weight, _AROUND_CYCLES * period_px, step), 1e-6)
    result = np.empty_like(misfits)
    for surface, misfit in enumerate(misfits):
        counted = np.where(said, misfit, np.float32(0))
        around = _enlarged(_wide(counted, _AROUND_CYCLES * period_px, step) / wide_share, said.shape)
        result[surface] = (_near(counted, step) / near_share + _AROUND * around) / (1 + _AROUND)
    return result


def _unusual_neighbourhoods(misfit: _Misfits, said: _Mask, period_px: float, step: int) -> _Mask:
    """Return where the misfit of pixels to their own surfaces is larger than elsewhere, cycle by cycle."""
    sigma = _NEIGHBOURHOOD_CYCLES * period_px
    share = _wide(said.astype(np.float32), sigma, step)
    mean = _wide(np.where(said, np.minimum(misfit, _MOST_AROUND), np.float32(0)), sigma, step) / np.maximum(share, 0.1)
    usual = float(np.median(mean[share > 0.5])) if (share > 0.5).any() else 1.0
    return np.asarray(said & (_enlarged(mean, said.shape) > max(_UNEXPLAINED_AROUND, _UNUSUAL * usual)))


def _near(values: _Misfits, step: int) -> _Misfits:
    along, across = _NEAR_PX
    return np.asarray(cv2.GaussianBlur(values, (0, 0), along / step, sigmaY=across / step), np.float32)


def _wide(values: _Misfits, sigma_px: float, step: int) -> _Misfits:
    """Blur on a coarser grid, and leave the values there."""
    every = max(1, _GRID_PX // step)
    size = (-(-values.shape[1] // every), -(-values.shape[0] // every))
    coarse = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(coarse, (0, 0), sigma_px / (step * every)), np.float32)


def _enlarged(values: npt.NDArray[np.floating], shape: tuple[int, ...]) -> _Misfits:
    return np.asarray(cv2.resize(values, shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def _opened(mask: _Mask, side_px: float, step: int) -> _Mask:
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _square(side_px, step))
    return np.asarray(opened > 0)


def _square(side_px: float, step: int) -> _Labels:
    """Return what a morphological operation looks at: a square of an odd number of pixels."""
    side = 2 * int(side_px / step / 2) + 1
    return np.ones((side, side), np.uint8)
