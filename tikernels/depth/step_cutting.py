"""Distinguish slopes from steps between neighbouring pixels, by their standard deviations and the slopes around.

Two neighbours, one pixel or one diagonal (l = 1 or sqrt 2) apart, are on one surface where the depth changes between
them by no more than the surface continues to change next to them, a pixel's own width w and three standard deviations:

    |z_q - z_p| <= max(0, g_p, g_q) l + w l + 3 sqrt(sigma_p^2 + sigma_q^2 + l^2 var(g)),

g_p and g_q the slopes of planes in that direction, each fitted to the pixels on one side of the edge: to those within
three pixels, weighed by 1 / sigma^2, twice, the second time by Tukey's weights of what the first plane leaves. And
nothing is seen more obliquely than 85 degrees, |z_q - z_p| <= 11 w l.

Of a surface that has been fitted to what is so linked, and knows its depth better, `cut_steep_links` takes the links
that may be steeper than a slope m:

    |z_q - z_p| + 2.5 sqrt(sigma_p^2 + sigma_q^2) > m w,

for the errors of neighbours' fits are alike, and differ by less than those of single pixels. Along a diagonal as well,
so that no triangle is steeper than along its sides.

References
----------
A. E. Beaton, J. W. Tukey, Technometrics 16, 147 (1974), doi:10.1080/00401706.1974.10489171.
"""

import numpy as np

from tikernels import checks
from tikernels._taichi import F32Array2, I32Array2, U8Array2, f32, i32, ti, u1
from tikernels.arrays import F32, I32, U8
from tikernels.launching import kernel
from tikernels.strips import STRIP, strip_at, strip_count

#: Bits of a pixel's links: to its right neighbour, to the one below, to the one below the right one; and from its right
#: neighbour to the one below.
RIGHT, DOWN, FALLING, RISING = 1, 2, 4, 8
# Each bit, and the pixels at its link's ends: rows and columns from the pixel that keeps it.
_EDGES = ((RIGHT, 0, 0, 0, 1), (DOWN, 0, 0, 1, 0), (FALLING, 0, 0, 1, 1), (RISING, 0, 1, 1, 0))
_whole_lanes = ti.types.vector(STRIP, ti.i32)
_two_rows, _two_whole_rows = (ti.types.vector(2 * (STRIP + 1), kind) for kind in (ti.f32, ti.i32))
# An edge that is not clear has its bit here times this.
_UNSURE = 16
# In noise that is normal three standard deviations leave one edge in 370 apart that belongs together.
_SURE = 3.0
# Of fits, whose errors are alike from pixel to pixel: of simulated scenes 99.3 % are off by less.
_SURE_OF_FITS = 2.5
# What is turned away by more than 85 degrees is a step, in widths of a pixel.
_STEEPEST = float(np.tan(np.radians(85.0)))
# Pixels that a plane is fitted to on either side: as many as the phase's smoothing takes, so that two planes on both
# sides of a step have little in common.
_REACH = 3
# Fewer pixels determine no slope.
_LEAST_COUNT = 4
# Neighbours' errors are alike after smoothing: thirteen pixels count as one measurement of a mean (docs/method.md, 7).
_ALIKE = 13.0
# The root of the determinant of the pixels' scatter about their middle, px^2, that distinguishes a plane from a line:
# two columns of three pixels have 0.4.
_LEAST_SPREAD = 0.15


@ti.func
def squared(value: f32) -> f32:
    """Return a number times itself."""
    return value * value


@ti.func
def slope_beside(
    depth: F32Array2,
    sigma: F32Array2,
    width: F32Array2,
    region: I32Array2,
    y: i32,
    x: i32,
    down: i32,
    right: i32,
):
    """Return the slope of a pixel's side of an edge, depth a px in the direction away from it, and its variance.

    The edge lies in the direction (down, right) from the pixel. The variance is negative where there is no slope.
    """
    height, breadth = depth.shape[0], depth.shape[1]
    middle, row_slope, column_slope, variance = depth[y, x], 0.0, 0.0, -1.0
    for turn in range(2):
        n, count, sy, sx, sz = 0.0, 0, 0.0, 0.0, 0.0
        syy, syx, sxx, syz, sxz = 0.0, 0.0, 0.0, 0.0, 0.0
        for dy in range(-_REACH, _REACH + 1):
            for dx in range(-_REACH, _REACH + 1):
                j, i = y + dy, x + dx
                if dy * down + dx * right <= 0 and 0 <= j < height and 0 <= i < breadth:
                    if region[j, i] == region[y, x]:
                        away = ti.sqrt(ti.cast(dy * dy + dx * dx, ti.f32))
                        rest = depth[j, i] - middle - row_slope * dy - column_slope * dx
                        # At first whatever may be connected with the pixel counts, then what its plane explains.
                        bound = _STEEPEST * width[y, x] * away
                        noise = _SURE * ti.sqrt(squared(sigma[j, i]) + squared(width[y, x]))
                        bound = ti.select(turn == 1, noise, bound)
                        inside = ti.max(0.0, 1.0 - squared(rest / ti.max(bound, 1e-12)))
                        weight = squared(inside) * squared(sigma[y, x] / ti.max(sigma[j, i], 1e-12))
                        weight = ti.select(away == 0.0, 1.0, weight)
                        count += ti.cast(weight > 0.0, i32)
                        z = depth[j, i] - depth[y, x]
                        n += weight
                        sy += weight * dy
                        sx += weight * dx
                        sz += weight * z
                        syy += weight * dy * dy
                        syx += weight * dy * dx
                        sxx += weight * dx * dx
                        syz += weight * dy * z
                        sxz += weight * dx * z
        my, mx, mz = sy / n, sx / n, sz / n
        cyy, cyx, cxx = syy / n - my * my, syx / n - my * mx, sxx / n - mx * mx
        cyz, cxz = syz / n - my * mz, sxz / n - mx * mz
        determinant = cyy * cxx - cyx * cyx
        variance = -1.0
        if count >= _LEAST_COUNT and determinant > _LEAST_SPREAD * _LEAST_SPREAD:
            row_slope = (cxx * cyz - cyx * cxz) / determinant
            column_slope = (cyy * cxz - cyx * cyz) / determinant
            middle = depth[y, x] + mz - row_slope * my - column_slope * mx
            along = squared(ti.cast(down, ti.f32)) * cxx - 2.0 * down * right * cyx + right * right * cyy
            variance = _ALIKE * squared(sigma[y, x]) * along / (determinant * n)
    return row_slope * down + column_slope * right, variance


@ti.func
def goes_on(
    depth: F32Array2,
    sigma: F32Array2,
    width: F32Array2,
    region: I32Array2,
    y: i32,
    x: i32,
    down: i32,
    right: i32,
) -> u1:
    """Return whether the surface next to an edge, from a pixel in a direction, is as steep as the edge itself."""
    j, i = y + down, x + right
    apart = ti.sqrt(ti.cast(down * down + right * right, ti.f32)) * ti.min(width[y, x], width[j, i])
    rise = depth[j, i] - depth[y, x]
    way = ti.select(rise > 0.0, 1.0, -1.0)
    noise, doubt, expected, found = squared(sigma[y, x]) + squared(sigma[j, i]), 0.0, 0.0, False
    # The other side is used where the one is not enough.
    for side in range(2):
        if not found:
            sign = 1 - 2 * side
            slope, variance = slope_beside(
                depth, sigma, width, region, y + side * down, x + side * right, sign * down, sign * right
            )
            if variance >= 0.0:
                expected = ti.max(expected, way * sign * slope)
                doubt = ti.max(doubt, variance)
            found = ti.abs(rise) <= expected + apart + _SURE * ti.sqrt(noise + doubt)
    return found


@kernel
def link_pixels_kernel(
    depth: F32Array2,  # (H, W) mm or rad
    sigma: F32Array2,  # (H, W) the same
    width: F32Array2,  # (H, W) the same, what a pixel is wide
    region: I32Array2,  # (H, W) 0: none
    out: U8Array2,  # (H, W) bits
):
    """Link what is near, 32 pixels at once, and check at each other edge whether the surface continues."""
    height, breadth = depth.shape[0], depth.shape[1]
    for t in range(height * strip_count(breadth, STRIP)):
        y, first, count = strip_at(t, breadth, STRIP)
        # Two rows of pixels; of none is their region.
        depths, sigmas, widths = _two_rows(0.0), _two_rows(0.0), _two_rows(0.0)
        regions, near, unsure = _two_whole_rows(0), _whole_lanes(0), _whole_lanes(0)
        for row in range(2):
            if y + row < height:
                for k in range(ti.min(STRIP + 1, breadth - first)):
                    place = row * (STRIP + 1) + k
                    depths[place] = depth[y + row, first + k]
                    sigmas[place] = sigma[y + row, first + k]
                    widths[place] = width[y + row, first + k]
                    regions[place] = region[y + row, first + k]
        for k in range(STRIP):
            for bit, top, left, bottom, right in ti.static(_EDGES):
                a, b = k + top * (STRIP + 1) + left, k + bottom * (STRIP + 1) + right
                apart = ti.min(widths[a], widths[b]) * ti.static(np.hypot(bottom - top, right - left))
                rise = ti.abs(depths[b] - depths[a])
                noise = squared(sigmas[a]) + squared(sigmas[b])
                beyond = ti.max(rise - apart, 0.0)
                may = (regions[a] != 0) & (regions[a] == regions[b]) & (rise <= _STEEPEST * apart)
                close = squared(beyond) <= _SURE * _SURE * noise
                near[k] += ti.select(may & close, bit, 0)
                unsure[k] += ti.select(may & ~close, bit, 0)
        for k in range(count):
            out[y, first + k] = ti.cast(near[k] + _UNSURE * unsure[k], ti.u8)


@ti.func
def settled(depth: F32Array2, sigma: F32Array2, width: F32Array2, region: I32Array2, y: i32, x: i32, bits: i32) -> i32:
    """Return a pixel's links, with those of the edges that were not clear where the surface goes on."""
    links = bits & (_UNSURE - 1)
    for n in range(4):
        if bits & (_UNSURE << n) != 0:
            # As in _EDGES.
            left = ti.select(n == 3, 1, 0)
            down, right = ti.select(n == 0, 0, 1), ti.select(n == 1, 0, ti.select(n == 3, -1, 1))
            if goes_on(depth, sigma, width, region, y, x + left, down, right):
                links |= 1 << n
    return links


@kernel
def link_slopes_kernel(
    depth: F32Array2,  # (H, W) mm or rad
    sigma: F32Array2,  # (H, W) the same
    width: F32Array2,  # (H, W) the same, what a pixel is wide
    region: I32Array2,  # (H, W) 0: none
    out: U8Array2,  # (H, W) bits
):
    """Ask of every edge that is not clear whether the surface goes on."""
    height, breadth = depth.shape[0], depth.shape[1]
    for t in range(height * strip_count(breadth, STRIP)):
        y, first, count = strip_at(t, breadth, STRIP)
        for x in range(first, first + count):
            if out[y, x] >= _UNSURE:
                bits = settled(depth, sigma, width, region, y, x, ti.cast(out[y, x], i32))
                out[y, x] = ti.cast(bits, ti.u8)


def link_pixels(depth: F32, sigma: F32, width: F32, region: I32, out: U8 | None = None) -> U8:
    """Find which neighbouring pixels are on one surface.

    Parameters
    ----------
    depth : (H, W) float32
        In mm or rad; of no account outside the regions.
    sigma : (H, W) float32
        Its standard deviation, in the same unit.
    width : (H, W) float32
        Width of a pixel there, in the same unit.
    region : (H, W) int32
        Surfaces from 1, 0: none. Pixels of two regions are never linked.
    out : (H, W) uint8, optional
        Output array.

    Returns
    -------
    (H, W) uint8
        Bits: `RIGHT` and `DOWN` to the next pixels, `FALLING` to the one below the right one, `RISING` between the
        right one and the one below.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    depth = checks.read_array("depth", depth, (None, None), np.float32)
    shape = (int(depth.shape[0]), int(depth.shape[1]))
    sigma = checks.read_array("sigma", sigma, shape, np.float32)
    width = checks.read_array("width", width, shape, np.float32)
    region = checks.read_array("region", region, shape, np.int32)
    out = checks.out_array("out", out, shape, np.uint8)
    link_pixels_kernel(depth, sigma, width, region, out)
    link_slopes_kernel(depth, sigma, width, region, out)
    return out


@ti.func
def surely_less_steep(
    depth: F32Array2, sigma: F32Array2, width: F32Array2, max_slope: f32, y: i32, x: i32, j: i32, i: i32
) -> u1:
    """Return whether depth surely changes by at most `max_slope` widths between two pixels, given their sigmas."""
    noise = _SURE_OF_FITS * ti.sqrt(squared(sigma[y, x]) + squared(sigma[j, i]))
    return ti.abs(depth[j, i] - depth[y, x]) + noise <= max_slope * ti.min(width[y, x], width[j, i])


@kernel
def cut_steep_links_kernel(
    links: U8Array2,  # (H, W) bits
    depth: F32Array2,  # (H, W) mm or rad
    sigma: F32Array2,  # (H, W) the same
    width: F32Array2,  # (H, W) the same, what a pixel is wide
    max_slope: f32,
    out: U8Array2,  # (H, W) bits
):
    height, breadth = depth.shape[0], depth.shape[1]
    for t in range(height * strip_count(breadth, STRIP)):
        y, first, count = strip_at(t, breadth, STRIP)
        for x in range(first, first + count):
            held, bits = ti.cast(links[y, x], i32), 0
            for bit, top, left, bottom, right in ti.static(_EDGES):
                # No link leads out of the image.
                if held & bit != 0:
                    ends = y + top, x + left, y + bottom, x + right
                    if surely_less_steep(depth, sigma, width, max_slope, *ends):
                        bits += bit
            out[y, x] = ti.cast(bits, ti.u8)


def cut_steep_links(links: U8, depth: F32, sigma: F32, width: F32, max_slope: float, out: U8 | None = None) -> U8:
    """Take the links that may be steeper than a slope.

    Parameters
    ----------
    links : (H, W) uint8
        See `link_pixels`.
    depth : (H, W) float32
        In mm or rad; of no account where nothing is linked.
    sigma : (H, W) float32
        Its standard deviation, in the same unit.
    width : (H, W) float32
        Width of a pixel there, in the same unit.
    max_slope : float
        By how many widths of a pixel the depth may change from one to the next.
    out : (H, W) uint8, optional
        Output array; may be the links.

    Returns
    -------
    (H, W) uint8
        The remaining links.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    links = checks.read_array("links", links, (None, None), np.uint8)
    shape = (int(links.shape[0]), int(links.shape[1]))
    depth = checks.read_array("depth", depth, shape, np.float32)
    sigma = checks.read_array("sigma", sigma, shape, np.float32)
    width = checks.read_array("width", width, shape, np.float32)
    out = checks.out_array("out", out, shape, np.uint8)
    cut_steep_links_kernel(links, depth, sigma, width, max_slope, out)
    return out
