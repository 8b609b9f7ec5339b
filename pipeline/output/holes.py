"""Small holes in a surface, filled where what is around them agrees on one smooth piece.

A weighted quadric is fitted to the pixels up to four px around a hole, all of one region,

    depth = c . f(u, v),    f = (1, u, v, u^2, u v, v^2),    covariance of c = 13 chi^2 (F' W F)^-1,

with W = 1 / sigma^2 and chi^2 the mean of what it leaves over, in variances (13: neighbours' errors are alike,
docs/method.md, 7). The hole is filled where chi < 2 and no value is less sure than twice the median pixel around it. So
what is filled is as good as measured if the surface does nothing inside that it does not do around; nobody has seen it.
"""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.output.range_surface import RangeSurface

Floats = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.bool_]

# A dark spot or a highlight; of what is larger than a square cycle the pattern has shown nothing.
_MOST_PX = 144
# Around a hole: more than the smoothing of the phase reaches.
_AROUND_PX = 4
# Pixels that a quadric is fitted to at least, four for each of its coefficients.
_LEAST_COUNT = 24
# Standard deviations that a quadric may leave over, and by how much less sure than its rim a value may be.
_MOST_CHI = 2.0
_MOST_DOUBT = 2.0
# Thirteen neighbours count as one.
_ALIKE = 13.0


class FilledHoles(NamedTuple):
    """A range image without its small holes."""

    surface: RangeSurface
    """As it was, and what the holes were filled with."""
    filled: npt.NDArray[np.intp]
    """(K,): places of the filled pixels in the flat image, in rising order."""
    beside: npt.NDArray[np.intp]
    """(K,): likewise, the measured pixel next to each, or as near as any."""


def fill_holes(surface: RangeSurface, most_px: int = _MOST_PX) -> FilledHoles:
    """Fill the small holes of a range image.

    Parameters
    ----------
    surface : RangeSurface
        It stays as it is.
    most_px : int
        Pixels that a hole has at most.
    """
    known = surface.region  # what is filled does not tell what the next hole holds
    depth, sigma, width = surface.depth.copy(), surface.sigma.copy(), surface.width.copy()
    region = known.copy()
    filled, beside = [np.empty(0, np.intp)], [np.empty(0, np.intp)]
    places = np.arange(known.size).reshape(known.shape)
    labels, boxes = _small_holes(known == 0, most_px)
    for number, left, top, wide, high in boxes:
        rows = slice(max(top - _AROUND_PX, 0), top + high + _AROUND_PX)
        columns = slice(max(left - _AROUND_PX, 0), left + wide + _AROUND_PX)
        hole = labels[rows, columns] == number
        here = known[rows, columns]
        rim = _grown(hole, 1) & ~hole
        own = int(here[rim][0])
        if own == 0 or (here[rim] != own).any():
            continue
        around = _grown(hole, _AROUND_PX) & (here == own)
        found = _continued(depth[rows, columns], sigma[rows, columns], around, hole)
        if found is not None:
            depth[rows, columns][hole], sigma[rows, columns][hole] = found
            width[rows, columns][hole] = width[rows, columns][rim].mean()
            region[rows, columns][hole] = own
            filled.append(places[rows, columns][hole])
            beside.append(places[rows, columns][rim][_nearest(hole, rim)])
    joined = np.concatenate(filled)
    order = np.argsort(joined)
    whole = RangeSurface(depth, sigma, width, region)
    return FilledHoles(whole, joined[order], np.concatenate(beside)[order])


def _small_holes(missing: Pixels, most_px: int) -> tuple[npt.NDArray[np.int32], list[list[int]]]:
    """Return labels of the missing pixels' groups, and label and box of each small one that is not at the border."""
    height, width = missing.shape
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(missing.view(np.uint8), connectivity=4)
    left, top, wide, high, area = statistics.T
    inside = (left > 0) & (top > 0) & (left + wide < width) & (top + high < height)
    small = np.flatnonzero(inside & (area <= most_px))
    small = small[small > 0]
    return labels, np.column_stack([small, statistics[small, :4]]).tolist()


def _grown(pixels: Pixels, reach_px: int) -> Pixels:
    size = 2 * reach_px + 1
    return np.asarray(cv2.dilate(pixels.view(np.uint8), np.ones((size, size), np.uint8)) != 0)


def _continued(depth: Floats, sigma: Floats, around: Pixels, hole: Pixels) -> tuple[Floats, Floats] | None:
    """Return depth and standard deviation in a hole by the quadric around it; None where that does not fit."""
    if around.sum() < _LEAST_COUNT:
        return None
    weight = 1 / sigma[around].astype(np.float64)
    middle = float(depth[around].mean())
    columns = _quadric(around) * weight[:, None]
    coefficients, _, rank, _ = np.linalg.lstsq(columns, (depth[around] - middle) * weight)
    if rank < columns.shape[1]:
        return None
    rest = (depth[around] - middle) * weight - columns @ coefficients
    chi = float(np.sqrt(np.mean(rest**2)))
    inside = _quadric(hole)
    spread = np.sqrt(_ALIKE * np.einsum("ni,ij,nj->n", inside, np.linalg.inv(columns.T @ columns), inside))
    doubt = spread * max(chi, 1.0)
    if chi > _MOST_CHI or doubt.max() > _MOST_DOUBT * np.median(sigma[around]):
        return None
    return (middle + inside @ coefficients).astype(np.float32), doubt.astype(np.float32)


def _nearest(pixels: Pixels, others: Pixels) -> npt.NDArray[np.intp]:
    """Return which one of the other pixels is nearest to each of these."""
    apart = np.argwhere(pixels)[:, None] - np.argwhere(others)
    return np.asarray(np.argmin((apart**2).sum(axis=-1), axis=1))


def _quadric(pixels: Pixels) -> npt.NDArray[np.float64]:
    """(N, 6): the functions f at some pixels, about the middle of the image."""
    y, x = np.nonzero(pixels)
    v, u = y - (pixels.shape[0] - 1) / 2, x - (pixels.shape[1] - 1) / 2
    return np.stack([np.ones(len(y)), u, v, u * u, u * v, v * v], axis=1)
