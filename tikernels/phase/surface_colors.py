"""Colours that many places of a frame have in common: where each surface's own model begins."""

import cv2
import numpy as np
import numpy.typing as npt

from tikernels.phase.phase_vector import TINY

_Array = npt.NDArray[np.float64]

# Colours are counted on a grid of this step, in natural logarithms, and smoothed over as much.
_STEP = 0.025
# The least distance of two colours, in steps.
_APART = 5
#: Colours of a frame, at most.
MOST_COLORS = 24

# Names of colours, by whether red, green and blue have half of the brightest's light or more.
_WORDS = ((("", "blue"), ("green", "cyan")), (("red", "magenta"), ("yellow", "a pale colour")))


def color_ratios(light: npt.ArrayLike) -> _Array:
    """Return the logarithms of channels, (..., 3), less their mean: a colour without its brightness."""
    logs = np.log(np.maximum(np.asarray(light, np.float64), TINY))
    return np.asarray(logs - (_sum_of_channels(logs) / 3)[..., None])


def color_word(ratios: _Array) -> str:
    """Return a word for a colour, given by its ratios (3,) to white: which channels have most of the brightest's light.

    Examples
    --------
    >>> color_word(color_ratios([0.6, 0.5, 0.1]))
    'yellow'
    """
    red, green, blue = map(int, ratios > ratios.max() + np.log(0.5))
    return _WORDS[red][green][blue]


def common_colors(ratios: _Array, weights: _Array, least: float) -> _Array:
    """Return the colours that are more frequent than all like them.

    Parameters
    ----------
    ratios : (N, 3)
        See `color_ratios`.
    weights : (N,)
        Weight of each.
    least : float
        Colours of less weight are given to their neighbours.

    Returns
    -------
    (n, 3) float64
        1 to 24 ratios, the commonest first.
    """
    red, blue = (np.rint(ratios[:, c] / _STEP).astype(np.int32) for c in (0, 2))
    first = np.array([red.min(), blue.min()]) - _APART
    rows, columns = np.array([red.max(), blue.max()]) + _APART + 1 - first
    cell = (red - first[0]) * columns + (blue - first[1])
    counts = np.bincount(cell, weights, rows * columns).reshape(rows, columns).astype(np.float32)
    # Roots, so that a small surface stands out next to a large one.
    smooth = cv2.GaussianBlur(np.sqrt(counts), (0, 0), 1.0)
    peaks = np.argwhere((smooth == cv2.dilate(smooth, np.ones((_APART, _APART)))) & (smooth > 0))
    peaks = peaks[np.argsort(-smooth[tuple(peaks.T)], kind="stable")][: 3 * MOST_COLORS]
    centers, cells = _color_of(peaks + first), np.argwhere(counts > 0)
    in_cells, of_cells = counts[tuple(cells.T)], _color_of(cells + first)
    while True:
        sizes = np.bincount(nearest_colors(of_cells, centers), weights=in_cells, minlength=len(centers))
        if len(centers) == 1 or (sizes.min() >= least and len(centers) <= MOST_COLORS):
            break
        centers = np.delete(centers, sizes.argmin(), axis=0)
    nearest, shares = nearest_colors(ratios, centers), weights + TINY
    means = np.array(
        [shares[nearest == k] @ ratios[nearest == k] / shares[nearest == k].sum() for k in range(len(centers))]
    )
    return np.asarray(means[np.argsort(-sizes, kind="stable")])


def _color_of(cells: npt.NDArray[np.integer]) -> _Array:
    """Return the ratios in the middle of cells, (N, 3)."""
    red, blue = (cells * _STEP).T
    return np.stack([red, -red - blue, blue], axis=1)


def nearest_colors(ratios: _Array, centers: _Array) -> npt.NDArray[np.intp]:
    """Return the number of the colour that each of (..., 3) ratios is nearest to."""
    if len(centers) == 1:
        return np.zeros(ratios.shape[:-1], np.intp)
    return np.asarray(_sum_of_channels((ratios[..., None, :] - centers) ** 2).argmin(axis=-1))


def _sum_of_channels(values: _Array) -> _Array:
    """Return the sum over the last axis, of length three: NumPy's own takes several times as long."""
    return np.asarray(values[..., 0] + values[..., 1] + values[..., 2])
