"""A range image for meshing: depth, standard deviation and regions, without specks and small holes, its rims smooth.

Specks and teeth. A pixel belongs to a surface where it is a corner of a whole square: four pixels, linked along all
sides and along a diagonal. What is attached by less is a tooth, as the last pixel at a rim that lies a step away from
its neighbour. Squares that share a corner are one surface, and surfaces of few squares are specks.

Holes. A weighted quadric is fitted to the pixels up to four px around a hole, all of one region,

    depth = c . f(u, v),    f = (1, u, v, u^2, u v, v^2),    covariance of c = 13 chi^2 (F' W F)^-1,

with W = 1 / sigma^2 and chi^2 the mean squared residual, in variances (13: neighbours' errors are alike,
docs/method.md, 7). The hole is filled where chi < 2 and no value is less sure than twice the median pixel around it. So
what is filled is as good as measured if the surface does nothing inside that it does not do around; it was not seen.

Rims. Where a surface turns away, the next pixel is millimetres deeper, and a rim that runs from pixel to pixel is
jagged when it is seen from the side. So the last vertices move along their surface, by less than half a pixel, to where
a blurred image of its pixels has the value of a straight rim.
"""

from dataclasses import dataclass
from math import erf, exp, pi, sqrt
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.robust import robust_sigma
from tikernels.depth.step_cutting import DOWN, FALLING, RIGHT, RISING

Floats = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.bool_]
Bits = npt.NDArray[np.uint8]

#: By how many widths of a pixel a surface's depth may change from one to the next: what is turned away by more, 81
#: degrees, cannot be distinguished from a step. On simulated busts no triangle then joins what lies 5 mm apart.
MAX_SLOPE = float(np.tan(np.radians(81.0)))
# Without a calibration a pixel's width in rad is not known. A neighbour that differs by this much lies on another
# surface: unwrapping joins none that differs by more than 0.8 rad from what is usual.
_MAX_STEP_RAD = 1.0
# Where nothing is known of noise, it is estimated from second differences over pixels so far apart that smoothing has
# not made them alike, px.
_APART_PX = 4
# Rows from which a pixel's width is estimated: a median of more changes nothing.
_ASKED_ROWS = 40

# Squares of four pixels: as many as a decoder's region has pixels at least; the order of smaller ones is seldom known.
_LEAST_SQUARES = 128

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

# Standard deviation of the blur: over some five pixels the stairs of a slanting rim are even, px.
_BLUR_PX = 1.5
# What the blurred image is in the last pixels before a straight rim, half a pixel from it, and by how much it changes
# there from one to the next.
_STRAIGHT = 0.5 * (1 + erf(0.5 / (_BLUR_PX * sqrt(2))))
_STEEPNESS = exp(-0.5 * (0.5 / _BLUR_PX) ** 2) / (_BLUR_PX * sqrt(2 * pi))
# Where it changes by less than a fourth as much there is no line, as at the end of something thin.
_LEAST_STEEPNESS = 0.25 * _STEEPNESS
# A vertex stays nearest to its own pixel.
_MOST_SHIFT_PX = 0.49


@dataclass(frozen=True, eq=False)
class RangeSurface:
    """A range image; outside its regions the numbers have no meaning."""

    depth: Floats
    """(H, W) float32: mm or rad."""
    sigma: Floats
    """(H, W) float32: its standard deviation, in the same unit."""
    width: Floats
    """(H, W) float32: of a pixel, in the same unit."""
    region: npt.NDArray[np.int32]
    """(H, W) int32: connected surfaces from 1; 0: none."""

    @classmethod
    def of(
        cls,
        values: Floats,
        mask: Pixels,
        points: Floats | None,
        sigma: Floats | None,
        region: npt.NDArray[np.int32] | None,
    ) -> "RangeSurface":
        """Prepare a range image.

        Parameters
        ----------
        values : (H, W) float32
            Relative phase, rad; not used where there are points.
        mask : (H, W) bool
            Pixels that have a range.
        points : (H, W, 3) float32 or None
            mm, camera frame.
        sigma : (N,) float32 or None
            Standard deviation of each masked pixel, row by row; None: the range image's own scatter.
        region : (H, W) int32 or None
            Connected surfaces; None: all may be one.
        """
        depth = np.where(mask, values if points is None else points[..., 2], np.float32(0))
        doubt = np.ones(mask.shape, np.float32)
        doubt[mask] = _scatter(depth, mask) if sigma is None else np.nan_to_num(sigma, nan=np.inf)
        known = mask & np.isfinite(doubt) & (doubt > 0)
        doubt[~known] = 1
        if points is None:
            width = np.full(mask.shape, _MAX_STEP_RAD / MAX_SLOPE, np.float32)
        else:
            width = depth * np.float32(_ray_step(points, mask))
        whole = mask.astype(np.int32) if region is None else region
        return cls(depth, doubt, width, np.where(known, whole, np.int32(0)))

    def without(self, pixels: Pixels) -> "RangeSurface":
        """Return the surface with some pixels in no region."""
        return RangeSurface(self.depth, self.sigma, self.width, np.where(pixels, np.int32(0), self.region))


def _scatter(depth: Floats, mask: Pixels) -> float:
    """Return the depth's standard deviation by its second differences along the rows."""
    width = max(depth.shape[1] - 2 * _APART_PX, 0)
    first, middle, last = (slice(_APART_PX * k, _APART_PX * k + width) for k in range(3))
    both = mask[:, first] & mask[:, middle] & mask[:, last]
    bends = (depth[:, first] - 2 * depth[:, middle] + depth[:, last])[both].astype(np.float64)
    known = robust_sigma(bends) / np.sqrt(6) if len(bends) else 0.0
    return max(known, float(np.finfo(np.float32).eps) * float(np.abs(depth).max(initial=1)))


def _ray_step(points: Floats, mask: Pixels) -> float:
    """Return how far the rays of neighbouring pixels are apart at unit depth."""
    every = max(1, len(mask) // _ASKED_ROWS)
    points, mask = points[::every], mask[::every]
    both = mask[:, 1:] & mask[:, :-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = points[..., :2] / points[..., 2:]
    steps = np.linalg.norm(np.diff(rays, axis=1)[both], axis=-1)
    return float(np.median(steps)) if len(steps) else 1.0


def find_surfaces(links: Bits, least_squares: int = _LEAST_SQUARES) -> tuple[Pixels, Pixels]:
    """Separate the pixels of surfaces from teeth and specks.

    Parameters
    ----------
    links : (H, W) uint8
        See `tikernels.depth.step_cutting.link_pixels`.
    least_squares : int
        Whole squares that a surface has at least.

    Returns
    -------
    surfaces, specks : (H, W) bool
        Pixels of surfaces, and of specks; what is neither is a tooth, or linked with nothing.
    """
    squares = _whole_squares(links)
    if squares.size == 0:
        return _corners(squares), _corners(squares)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(squares.view(np.uint8), connectivity=8)
    large = statistics[:, cv2.CC_STAT_AREA] >= least_squares
    large[0] = False  # what is no square
    surfaces = _corners(large[labels])
    return surfaces, _corners(squares) & ~surfaces


def links_within(links: Bits, pixels: Pixels) -> Bits:
    """Return the links without those that lead to other pixels than these."""
    kept = np.zeros_like(links)
    for bit, start, end in _edges(pixels):
        kept[: start.shape[0], : start.shape[1]] |= np.where(start & end, np.uint8(bit), np.uint8(0))
    return links & kept


def _edges(pixels: Pixels) -> tuple[tuple[int, Pixels, Pixels], ...]:
    """Return the pixels at both ends of each kind of link, at the place where the link is kept."""
    return (
        (RIGHT, pixels[:, :-1], pixels[:, 1:]),
        (DOWN, pixels[:-1], pixels[1:]),
        (FALLING, pixels[:-1, :-1], pixels[1:, 1:]),
        (RISING, pixels[:-1, 1:], pixels[1:, :-1]),
    )


def _whole_squares(links: Bits) -> Pixels:
    """(H - 1, W - 1) bool: squares whose four pixels are linked along all sides and a diagonal."""
    here, right, below = links[:-1, :-1], links[:-1, 1:], links[1:, :-1]
    sides = (here & RIGHT != 0) & (here & DOWN != 0) & (right & DOWN != 0) & (below & RIGHT != 0)
    return np.ascontiguousarray(sides & (here & (FALLING | RISING) != 0))


def _corners(squares: Pixels) -> Pixels:
    """Return the pixels that are a corner of a square."""
    pixels = np.zeros((squares.shape[0] + 1, squares.shape[1] + 1), np.bool_)
    for part in (pixels[:-1, :-1], pixels[:-1, 1:], pixels[1:, :-1], pixels[1:, 1:]):
        part |= squares
    return pixels


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
    known = surface.region  # what is filled is no evidence for the next hole
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


def rim_shifts(kept: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    """Return by how much the vertices of rims move to be in line.

    Parameters
    ----------
    kept : (H, W) bool
        Pixels that are vertices.

    Returns
    -------
    (H, W, 2) float32
        Down and to the right, px; 0 inside surfaces. The image's own border is no rim.
    """
    pixels = kept.view(np.uint8)
    # Beyond the image surfaces continue as at its border.
    border = cv2.copyMakeBorder(pixels, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    rim = kept & (cv2.erode(border, np.ones((3, 3), np.uint8))[1:-1, 1:-1] == 0)
    blurred = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), _BLUR_PX, borderType=cv2.BORDER_REPLICATE)
    down, right = (
        cv2.Sobel(blurred, -1, *axes, scale=1 / 8, borderType=cv2.BORDER_REPLICATE)[rim] for axes in ((0, 1), (1, 0))
    )
    square = down**2 + right**2
    clear = square > _LEAST_STEEPNESS**2
    step = np.where(clear, (_STRAIGHT - blurred[rim]) / np.where(clear, square, 1), 0)
    moved = np.stack([step * down, step * right], axis=-1)
    moved *= np.minimum(1, _MOST_SHIFT_PX / np.maximum(np.abs(moved).max(axis=-1, keepdims=True), 1e-6))
    shifts = np.zeros((*kept.shape, 2), np.float32)
    shifts[rim] = moved
    return shifts
