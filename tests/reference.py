"""The NumPy float64 twin of every kernel, written from the equations; plain where the kernels are fast."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import groupby
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import ProjectorGeometry
from tikernels.phase.balance_window import SIGMA_ACROSS, SIGMA_ALONG
from tikernels.raw.pixel_format import SITES, PixelFormat

Array = npt.NDArray[Any]

CYCLE = 2 * np.pi
#: Phases of R, G and B relative to the pattern's, rad.
CHANNEL_PHASES = np.array([-1, 0, 1]) * CYCLE / 3
#: Departure from the usual change (rad) beyond which a neighbour lies on another surface.
MAX_DEPARTURE = 0.8


def wrapped_difference(a: npt.ArrayLike, b: npt.ArrayLike) -> Array:
    """Return a - b modulo a cycle, rad in [-pi, pi]."""
    difference = np.subtract(a, b, dtype=np.float64)
    return difference - CYCLE * np.rint(difference / CYCLE)


def wrapped(phase: npt.ArrayLike) -> Array:
    """Return a phase as kernels take it: float32 rad in [-pi, pi]."""
    return wrapped_difference(phase, 0.0).astype(np.float32)


def ramp(height: int, width: int, period_px: float = 12.0, tilt: float = 0.0) -> Array:
    """Return the phase of a plane, rad: a cycle every `period_px` rows, `tilt` rad a column."""
    return CYCLE / period_px * np.arange(height)[:, None] + tilt * np.arange(width)


def fringes(
    phase: Array,
    modulation: npt.ArrayLike = 0.25,
    background: npt.ArrayLike = 0.4,
    crosstalk_matrix: npt.ArrayLike | None = None,
) -> Array:
    """Return the (H, W, 3) float32 light that a phase map shows; each term may differ by pixel or channel."""
    light = background + modulation * np.cos(phase[..., None] + CHANNEL_PHASES)
    if crosstalk_matrix is not None:
        light = light @ np.transpose(crosstalk_matrix)
    return light.astype(np.float32)


def commonest_offset(difference: Array, region: Array) -> Array:
    """Return, at every pixel, the commonest value of an integer map in the pixel's region; 0 outside (region 0)."""
    inside = region > 0
    pairs, counts = np.unique(np.stack([region[inside], difference[inside]]), axis=1, return_counts=True)
    pairs = pairs[:, np.argsort(counts, kind="stable")]  # of a region's entries the last one stays
    table = np.zeros(int(region.max()) + 1, difference.dtype)
    table[pairs[0]] = pairs[1]
    return np.where(inside, table[region], 0)


def wrong_orders(difference: Array, region: Array) -> Array:
    """Return where an order less the true one is not its region's commonest, (H, W) bool."""
    return (region > 0) & (difference != commonest_offset(difference, region))


def linearize(levels: Array, transfer: str, white_level: float) -> Array:
    """Undo the transfer of IEC 61966-2-1 (sRGB) or of Rec. ITU-R BT.709-6."""
    value = levels.astype(np.float64) / white_level
    if transfer == "srgb":
        return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    if transfer == "bt709":
        return np.where(value < 0.081, value / 4.5, ((value + 0.099) / 1.099) ** (1 / 0.45))
    return value


def correct_crosstalk(image: Array, crosstalk_matrix: npt.ArrayLike) -> Array:
    """Solve camera = matrix @ projector at every pixel."""
    pixels = image.reshape(-1, 3).astype(np.float64)
    return np.linalg.solve(np.asarray(crosstalk_matrix, np.float64), pixels.T).T.reshape(image.shape)


def compute_wrapped_phase(image: Array) -> tuple[Array, Array, Array]:
    """Return phase, modulation and background of R, G, B = a + b cos(phi + (-1, 0, 1) 2 pi/3) (equation 2.4)."""
    r, g, b = np.moveaxis(image.astype(np.float64), -1, 0)
    y, x = np.sqrt(3) * (r - b), 2 * g - r - b
    return np.arctan2(y, x), np.hypot(y, x) / 3, (r + g + b) / 3


def gaussian_sums(image: Array, sigma_rows: float, sigma_columns: float) -> Array:
    """Return Gaussian-weighted sums around every pixel of (H, W, C), cut at three deviations, nothing outside."""

    def band(length: int, sigma: float) -> Array:
        distance = np.subtract.outer(np.arange(length), np.arange(length))
        return np.where(np.abs(distance) <= 3 * sigma, np.exp(-0.5 * (distance / sigma) ** 2), 0.0)

    rows, columns = band(image.shape[0], sigma_rows), band(image.shape[1], sigma_columns)
    return np.einsum("ij,jkc->ikc", rows, np.einsum("kl,jlc->jkc", columns, image, optimize=True), optimize=True)


def balance_gains(
    image: Array, period_px: float, mask: Array | None = None, crosstalk_matrix: npt.ArrayLike | None = None
) -> Array:
    """Return the (H, W, 3) gains that balance the colours, from full-resolution windows."""
    matrix = np.eye(3) if crosstalk_matrix is None else np.asarray(crosstalk_matrix, np.float64)
    matrix = matrix / matrix.sum(axis=1, keepdims=True)
    light = image.astype(np.float64)
    lit = np.ones(light.shape[:2], bool) if mask is None else np.asarray(mask, bool)

    def gains(seen: Array, predicted: Array | float) -> Array:
        color = seen / predicted
        return color.mean(axis=-1, keepdims=True) / color

    def smooth(values: Array) -> Array:
        return gaussian_sums(values * lit[..., None], SIGMA_ACROSS * period_px, SIGMA_ALONG * period_px)

    first = gains(smooth(light), 1.0)
    phase, modulation, background = compute_wrapped_phase(correct_crosstalk(light * first, matrix))
    contrast = modulation[lit].sum() / background[lit].sum()
    neutral = background[..., None] * (1 + contrast * np.cos(phase[..., None] + CHANNEL_PHASES))
    return gains(smooth(light), smooth(neutral @ matrix.T))


def equalize_phase(wrapped_phase: Array, mask: Array, bins: int = 256, harmonics: int | None = None) -> Array:
    """Map the masked phases through their interpolated cumulative distribution, mean correction zero."""
    counted = wrapped_phase[mask].astype(np.float64)
    counts, edges = np.histogram(counted, bins, (-np.pi, np.pi))
    table = CYCLE * np.concatenate([[0.0], np.cumsum(counts)]) / len(counted) - np.pi - edges
    if harmonics is not None:
        angles = np.outer(np.arange(1, harmonics + 1), edges)
        weights = 2 / bins * np.exp(-1j * angles[:, :-1]) @ table[:-1]
        table = table[:-1].mean() + (weights[:, None] * np.exp(1j * angles)).real.sum(axis=0)
    middle_of_bin = (table[1:] + table[:-1]) / 2
    table = table - counts @ middle_of_bin / len(counted)
    correction = np.interp(wrapped_phase.astype(np.float64), edges, table)
    return np.where(mask, wrapped_difference(wrapped_phase + correction, 0.0), wrapped_phase)


def neighbour(phase: Array, rows: int, columns: int) -> Array:
    """Return each pixel's neighbour that is this far below and to the right; NaN beyond the border."""
    height, width = phase.shape
    result = np.full(phase.shape, np.nan)
    target = np.s_[max(-rows, 0) : min(height - rows, height), max(-columns, 0) : min(width - columns, width)]
    source = np.s_[max(rows, 0) : min(height + rows, height), max(columns, 0) : min(width + columns, width)]
    if abs(rows) < height and abs(columns) < width:
        result[target] = phase[source]
    return result


def usual_change(phase: Array, quality: Array) -> tuple[float, float, float]:
    """Return the usual change along a row and from row to row (rad a px, complex means), and the mean quality.

    A change counts by its quality squared. Every eighth pixel both ways is asked, never the last of a row or column.
    """
    height, width = phase.shape
    rows = np.minimum(np.arange(0, height, 8), max(height - 2, 0))
    columns = np.minimum(np.arange(0, width, 8), max(width - 2, 0))
    grid = np.ix_(rows, columns)

    def mean_change(other: Array) -> float:
        turns = quality[grid] ** 2 * np.exp(1j * (other - phase)[grid])
        return float(np.angle(np.nansum(turns) + 1e-6))

    counted = ~np.isnan(phase[grid])
    full = counted.any(axis=1)
    means = np.where(counted, quality[grid], 0.0).sum(axis=1)[full] / counted.sum(axis=1)[full]
    usable = means[means > 0]
    mean_quality = float(usable.mean()) if len(usable) else 0.0
    return mean_change(neighbour(phase, 0, 1)), mean_change(neighbour(phase, 1, 0)), max(mean_quality, 1e-12)


def smooth_phase(wrapped_phase: Array, mask: Array, smoothing_px: int) -> Array:
    """Fit a quadric to what each pixel's surface holds of a window; leave pixels at steps alone."""
    phase = np.where(mask, wrapped_phase, np.nan).astype(np.float64)
    along, across, _ = usual_change(phase, np.ones_like(phase))

    def saw_two_surfaces(rows: int, columns: int, rate: float) -> Array:
        departures = [
            np.abs(wrapped_difference(neighbour(phase, side * rows, side * columns) - phase, side * rate))
            for side in (-1, 1)
        ]
        return (np.fmax(*departures) > MAX_DEPARTURE) & (np.fmin(*departures) > 0.3)

    def pairs(values: Array, rows: int, columns: int, rate: float) -> Iterator[tuple[int, Array, Array]]:
        """Yield each distance, what the pair counts there, and the sum of its differences to the pixel."""
        for k in range(1, smoothing_px // 2 + 1):
            one, other = (
                wrapped_difference(neighbour(values, side * rows, side * columns) - values, side * rate)
                for side in (-k, k)
            )
            near = np.maximum(np.abs(one), np.abs(other)) < 1.0
            counts = np.where(near, np.clip(2.5 - 2 * np.abs(one + other) / 0.6, 0, 1), 0.0)
            yield k, counts, np.where(near, one + other, 0.0)

    def mean_and_quadric(found: list[tuple[int, Array, Array]]) -> tuple[Array, Array, Array]:
        """Return how many pixels count, and what their mean and their quadric add to the pixel's own value."""
        count, squares, fourths = (
            (power == 0) + np.zeros(phase.shape) + sum(2 * k**power * c for k, c, _ in found) for power in (0, 2, 4)
        )
        sums = [np.zeros(phase.shape) + sum(k**power * c * d for k, c, d in found) for power in (0, 2)]
        curved = fourths + 2.0
        return count, sums[0] / count, (curved * sums[0] - squares * sums[1]) / (count * curved - squares**2)

    keep = np.isnan(phase) | saw_two_surfaces(1, 0, across) | saw_two_surfaces(0, 1, along)
    averaged, mean, quadric = mean_and_quadric(list(pairs(phase, 0, 1, along)))
    rows, bend = np.where(keep, np.nan, phase + mean), quadric - mean
    columns = []
    for k, counts, difference in pairs(rows, 1, 0, across):
        # A row's variance is one over what its mean is of; a pair counts by its own.
        others = 1 / neighbour(averaged, -k, 0) + 1 / neighbour(averaged, k, 0)
        columns.append((k, counts * np.nan_to_num(2 / averaged / others), difference))
    count, _, added = mean_and_quadric(columns)
    bends = sum(np.nan_to_num(c * (neighbour(bend, -k, 0) + neighbour(bend, k, 0))) for k, c, _ in columns)
    return np.where(keep, wrapped_phase, wrapped_difference(rows + added + (bend + bends) / count, 0.0))


def unwrap_phase(wrapped_phase: Array, quality: Array, mask: Array) -> tuple[Array, Array]:
    """Return orders and regions, stripes along the rows, one run and one contact at a time.

    Returns
    -------
    order : (H, W) int
        Up to one constant a region.
    region : (H, W) int
        From 1; 0 where no order is given: outside the mask, in specks and beside hidden steps.
    """
    phase = np.where(mask, wrapped_phase, np.nan).astype(np.float64)
    height, width = phase.shape
    along, across, mean_quality = usual_change(phase, quality)
    patch_of, order = np.full(phase.shape, -1), np.zeros(phase.shape, int)
    contacts: list[tuple[int, int, int, int, int]] = []  # votes, name, patch, patch, shift of its orders
    patches = 0

    def cycles(a: tuple[int, int], b: tuple[int, int], rate: float) -> int | None:
        """Cycles to add at b to continue a; None across a step."""
        departure = phase[b] - phase[a] - rate
        whole = np.rint(departure / CYCLE)
        return None if not abs(departure - CYCLE * whole) <= MAX_DEPARTURE else -int(whole)

    def weight(pixel: tuple[int, int]) -> int:
        """One to sixteen votes, four for an ordinary pixel."""
        return min(max(int(4 * quality[pixel] / mean_quality), 1), 16)

    def runs(y: int, left: int, right: int) -> Iterator[tuple[int, int]]:
        start = left
        for x in range(left, right):
            if np.isnan(phase[y, x]):
                start = x + 1
            elif x + 1 == right or cycles((y, x), (y, x + 1), along) is None:
                yield start, x + 1
                start = x + 1

    def grow(y: int, start: int, stop: int, top: int) -> None:
        """Join a run to the patch above that most of its pixels vote for, or start a patch."""
        nonlocal patches
        for x in range(start + 1, stop):
            order[y, x] = order[y, x - 1] + (cycles((y, x - 1), (y, x), along) or 0)
        ballots = {}
        for x in range(start, stop) if y > top else ():
            step = cycles((y - 1, x), (y, x), across)
            if step is not None:
                ballots[x] = (patch_of[y - 1, x], order[y - 1, x] + step - order[y, x])
        (winner, votes), *_ = [*Counter(ballots.values()).most_common(1), ((-1, 0), 0)]
        patch, shift = winner
        if votes == 0 or 2 * votes < len(ballots) or (votes == 1 and stop - start > 2):
            patch, shift = patches, 0
            patches += 1
        for choice in dict.fromkeys(ballots.values()):
            if choice[0] != patch and votes < len(ballots):
                voters = [x for x in ballots if ballots[x] == choice]
                tally = sum(weight((y, x)) for x in voters)
                contacts.append((tally, 3 * (y * width + voters[0]), choice[0], patch, choice[1] - shift))
        patch_of[y, start:stop] = patch
        order[y, start:stop] += shift

    def touch(pairs: list[tuple[tuple[int, int], tuple[int, int]]], rate: float, side: int) -> None:
        """Note what pairs of pixels on either side of a border say, a contact for each piece of it that agrees."""

        def said(pair: tuple[tuple[int, int], tuple[int, int]]) -> tuple[int, int, int] | None:
            a, b = pair
            step = cycles(a, b, rate)
            return None if step is None else (patch_of[a], patch_of[b], order[a] - order[b] + step)

        for vote, piece in groupby(pairs, said):
            if vote is not None:
                agreeing = list(piece)
                y, x = agreeing[0][0]
                name = 3 * (y * width + x) + 1 + side
                contacts.append((len(agreeing) * weight((y, x)), name, *vote))

    cells = [(top, left) for top in range(0, height, 16) for left in range(0, width, 8)]
    for top, left in cells:
        for y in range(top, min(top + 16, height)):
            for start, stop in runs(y, left, min(left + 8, width)):
                grow(y, start, stop, top)
    for top, left in cells:
        bottom, right = min(top + 16, height) - 1, min(left + 8, width) - 1
        if right + 1 < width:
            touch([((y, right), (y, right + 1)) for y in range(top, bottom + 1)], along, 0)
        if bottom + 1 < height:
            touch([((bottom, x), (bottom + 1, x)) for x in range(left, right + 1)], across, 1)
    root, offset = maximum_spanning_forest(patches, contacts)
    order += np.where(patch_of >= 0, offset[patch_of], 0)
    region = np.where(patch_of >= 0, root[patch_of] + 1, 0)
    return _leave_out(phase, order, region, patch_of, along, across)


def maximum_spanning_forest(
    patches: int, contacts: Sequence[tuple[float, int, int, int, int]]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Join patches, best supported contacts first (J. B. Kruskal, 1956); return each patch's root and offset.

    Equal support goes by the contact's name, shuffled by a multiplication that no two names share.
    """
    parent, step = list(range(patches)), [0] * patches

    def find(i: int) -> tuple[int, int]:
        path = []
        while parent[i] != i:
            path.append(i)
            i = parent[i]
        total = 0
        for j in reversed(path):
            total += step[j]
            parent[j], step[j] = i, total
        return i, total

    def shuffled(name: int) -> int:
        return (name * -1640531527 + 2**31) % 2**32

    for _, _, a, b, shift in sorted(contacts, key=lambda contact: (-contact[0], shuffled(contact[1]))):
        (root_a, offset_a), (root_b, offset_b) = find(a), find(b)
        if root_a != root_b:
            parent[root_b], step[root_b] = root_a, offset_a + shift - offset_b
    found = np.array([find(i) for i in range(patches)], np.int64).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def _leave_out(
    phase: Array, order: Array, region: Array, patch_of: Array, along: float, across: float
) -> tuple[Array, Array]:
    """Leave out regions below 128 px, their neighbours, and pixels whole cycles away from a neighbour."""
    sizes = np.bincount(region.ravel())
    small = (region > 0) & (sizes[region] < 128)
    unwrapped = phase + CYCLE * order
    out = small.copy()
    for rows, columns in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        beside = {
            name: neighbour(values, rows, columns)
            for name, values in {"small": small, "region": region, "patch": patch_of, "unwrapped": unwrapped}.items()
        }
        departure = np.abs(beside["unwrapped"] - unwrapped - rows * across - columns * along)
        hidden_step = (beside["region"] == region) & (departure > 2 * MAX_DEPARTURE)
        out |= (beside["patch"] != patch_of) & ((beside["small"] == 1) | hidden_step)
    region = np.where(out, 0, region)
    return np.where(region > 0, order, 0), region


def correct_fringe_order(unwrapped_phase: Array, mask: Array, window_px: int) -> Array:
    """Return the cycles that the sequential in-place filter adds, pixel by pixel from the centre (equation 4.3).

    Phases count in whole 2^16ths of a cycle, so that every sum is exact.
    """
    unit = np.float32(2**16 / CYCLE)
    phase = np.where(mask, np.rint(np.where(mask, unwrapped_phase, 0) * unit), 0).astype(np.int64)
    height, width = phase.shape
    cycles = np.zeros(phase.shape, np.int64)
    reach = window_px // 2
    middle_y, middle_x = height // 2, width // 2
    for y in [*range(middle_y, -1, -1), *range(middle_y + 1, height)]:
        for x in [*range(middle_x, -1, -1), *range(middle_x + 1, width)]:
            if mask[y, x]:
                window = np.s_[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
                count = int(mask[window].sum())
                excess = int((phase[window] + 2**16 * cycles[window]).sum()) - count * int(phase[y, x])
                whole = (2 * abs(excess) + count * 2**16) // (2 * count * 2**16)  # halves away from zero
                cycles[y, x] = whole if excess >= 0 else -whole
    return cycles


def projector_px(points: Array, projector: ProjectorGeometry) -> Array:
    """Return the projector row (or column) that points in the camera's frame fall on, by OpenCV's lens."""
    matrix = np.array([[projector.focal_px, 0, 0], [0, projector.focal_px, 0], [0, 0, 1]])
    matrix[projector.axis, 2] = projector.center_px
    flat = np.nan_to_num(points.reshape(-1, 3).astype(np.float64), nan=1.0)
    rotation, _ = cv2.Rodrigues(np.asarray(projector.rotation, np.float64))
    pixels, _ = cv2.projectPoints(flat, rotation, projector.translation_mm, matrix, projector.distortion)
    place = pixels.reshape(-1, 2)[:, projector.axis].reshape(points.shape[:-1])
    return np.where(np.isnan(points[..., 0]), np.nan, place)


def triangulate(unwrapped_phase: Array, rays: Array, projector: ProjectorGeometry) -> Array:
    """Return points: the closed form for a projector without distortion, then Newton's rule along the ray."""
    row = unwrapped_phase.astype(np.float64) * projector.period_px / CYCLE
    directions = np.concatenate([rays.astype(np.float64), np.ones((*row.shape, 1))], axis=-1)
    # slope z' = y' with X' = depth R d + t: a plane through the projector's centre.
    slope = ((row - projector.center_px) / projector.focal_px)[..., None]
    normal = projector.rotation[projector.axis] - slope * projector.rotation[2]
    offset = projector.translation_mm[projector.axis] - slope[..., 0] * projector.translation_mm[2]
    depth = -offset / (normal * directions).sum(axis=-1)
    if np.any(projector.distortion):
        for _ in range(8):
            landed, beyond = (projector_px(d[..., None] * directions, projector) for d in (depth, depth + 1e-3))
            depth = depth + 1e-3 * (row - landed) / (beyond - landed)
    return np.where((depth > 0)[..., None], depth[..., None] * directions, np.nan)


def link_pixels(depth: Array, sigma: Array, width: Array, region: Array) -> Array:
    """Return links: 1 to the right, 2 down, 4 to the one below the right one, 8 from the right one to the one below."""
    height, breadth = region.shape
    links = np.zeros(region.shape, np.uint8)
    for y, x in np.ndindex(height, breadth):
        for bit, (j, i), (down, right) in (
            (1, (y, x), (0, 1)),
            (2, (y, x), (1, 0)),
            (4, (y, x), (1, 1)),
            (8, (y, x + 1), (1, -1)),
        ):
            n, m = j + down, i + right
            if i >= breadth or not (n < height and 0 <= m < breadth):
                continue
            if region[j, i] == 0 or region[n, m] != region[j, i]:
                continue
            apart = np.hypot(down, right) * min(width[j, i], width[n, m])
            rise, noise = float(depth[n, m] - depth[j, i]), sigma[j, i] ** 2 + sigma[n, m] ** 2
            here, doubt = _slope_beside(depth, sigma, width, region, (j, i), (down, right))
            there, other = _slope_beside(depth, sigma, width, region, (n, m), (-down, -right))
            expected = max(0.0, here * np.sign(rise), -there * np.sign(rise))
            near = abs(rise) <= apart + 3 * np.sqrt(noise)
            goes_on = abs(rise) <= apart + expected + 3 * np.sqrt(noise + max(doubt, other))
            if abs(rise) <= np.tan(np.radians(85)) * apart and (near or goes_on):
                links[y, x] |= bit
    return links


def _slope_beside(
    depth: Array,
    sigma: Array,
    width: Array,
    region: Array,
    place: tuple[int, int],
    way: tuple[int, int],
) -> tuple[float, float]:
    """Return slope and variance, along a way, of a plane through the pixels behind a place; 0, 0: none."""
    rows, columns = np.mgrid[-3:4, -3:4].reshape(2, -1)
    j, i = rows + place[0], columns + place[1]
    counts = (rows * way[0] + columns * way[1] <= 0) & (j >= 0) & (j < region.shape[0])
    counts &= (i >= 0) & (i < region.shape[1])
    rows, columns, j, i = rows[counts], columns[counts], j[counts], i[counts]
    own = region[j, i] == region[place]
    rows, columns, j, i = rows[own], columns[own], j[own], i[own]
    z = depth[j, i].astype(np.float64) - depth[place]
    bound = np.tan(np.radians(85)) * width[place] * np.hypot(rows, columns)
    rest = z
    slope, variance = 0.0, 0.0
    for _ in range(2):
        weight = np.clip(1 - (rest / np.maximum(bound, 1e-12)) ** 2, 0, None) ** 2 * (sigma[place] / sigma[j, i]) ** 2
        weight[(rows == 0) & (columns == 0)] = 1
        total = weight.sum()
        places = np.stack([rows, columns]).astype(float)
        middle = (places * weight).sum(axis=1) / total
        centred = places - middle[:, None]
        spread = (centred * weight) @ centred.T / total
        slope, variance = 0.0, 0.0
        if (weight > 0).sum() >= 4 and np.linalg.det(spread) > 0.15**2:
            offset = (z * weight).sum() / total
            fitted = np.linalg.solve(spread, (centred * weight) @ (z - offset) / total)
            slope = float(fitted @ way)
            variance = float(13 * sigma[place] ** 2 * (way @ np.linalg.inv(spread) @ way) / total)
            rest = z - offset - fitted @ centred
        bound = 3 * np.sqrt(sigma[j, i] ** 2 + width[place] ** 2)
    return slope, variance


def fit_quadric(
    depth: Array, sigma: Array, mask: Array, links: Array, place: tuple[int, int], stride: int
) -> tuple[float, float, float, float]:
    """Return value, slopes down and to the right a px, and variance of the quadric, or plane, around a pixel."""

    def run(start: tuple[int, int], way: tuple[int, int]) -> int:
        bit = 1 if way[0] == 0 else 2
        (y, x), steps = start, 0
        while steps < 12:
            n, m = y + way[0], x + way[1]
            if not (0 <= n < mask.shape[0] and 0 <= m < mask.shape[1]) or not links[min(y, n), min(x, m)] & bit:
                break
            y, x, steps = n, m, steps + 1
        return steps

    samples = []
    for v in range(-min(3, run(place, (-1, 0)) // stride), min(3, run(place, (1, 0)) // stride) + 1):
        row = place[0] + v * stride
        left, right = run((row, place[1]), (0, -1)), run((row, place[1]), (0, 1))
        samples += [(v, u) for u in range(-min(3, left // stride), min(3, right // stride) + 1)]
    v, u = np.array(samples, float).T
    at = tuple((np.array(samples) * stride + place).T)
    weight = (1 - u**2 / 16) * (1 - v**2 / 16) * (sigma[place] / sigma[at]) ** 2 * mask[at]
    columns = np.stack([np.ones(len(u)), v, u, v * v, u * v, u * u])
    alike = {1: 6.2, 2: 3.0, 4: 1.1}[stride] * sigma[place] ** 2
    normal = (columns * weight) @ columns.T + np.diag([0, 1e-5, 1e-5, 1e-3, 1e-3, 1e-3])
    right_side = (columns * weight) @ (depth[at].astype(np.float64) - depth[place])
    bent, flat = (np.linalg.solve(normal[:count, :count], right_side[:count]) for count in (6, 3))
    ways = ((-1, 0), (1, 0), (0, -1), (0, 1))
    cut_off = min(run(place, way) for way in ways) < 3 * stride
    # What the bend explains, as a part of what is left by chance.
    if cut_off and right_side @ bent - right_side[:3] @ flat < alike:
        bent, normal = flat, normal[:3, :3]
    variance = alike * np.linalg.inv(normal)[0, 0]
    return float(bent[0] + depth[place]), float(bent[1] / stride), float(bent[2] / stride), float(variance)


def choose_window(depth: Array, sigma: Array, mask: Array, links: Array, place: tuple[int, int]) -> int:
    """Return the widest window, 0 to 3, whose interval has a value in common with those before it."""

    def interval(stride: int) -> tuple[float, float]:
        value, _, _, variance = fit_quadric(depth, sigma, mask, links, place, stride)
        return value - 1.5 * np.sqrt(variance), value + 1.5 * np.sqrt(variance)

    own = float(depth[place] - 1.5 * sigma[place]), float(depth[place] + 1.5 * sigma[place])

    def agree(*intervals: tuple[float, float]) -> bool:
        return max(low for low, _ in intervals) <= min(high for _, high in intervals)

    if not agree(own, interval(2)):
        return 1 if agree(own, interval(1)) else 0
    return 3 if agree(own, interval(2), interval(4)) else 2


def triangulate_mesh(depth: Array, mask: Array, links: Array) -> set[frozenset[int]]:
    """Return the triangles as sets of vertices: each square of four pixels split along the better diagonal."""
    number = np.cumsum(mask.ravel()).reshape(mask.shape) - 1
    depth = depth.astype(np.float64)

    def linked(one: tuple[int, int], other: tuple[int, int]) -> bool:
        (y, x), (j, i) = sorted((one, other))
        bit = {(0, 1): 1, (1, 0): 2, (1, 1): 4, (1, -1): 8}[j - y, i - x]
        return bool(links[y, min(x, i)] & bit)

    triangles = set()
    for y, x in np.ndindex(mask.shape[0] - 1, mask.shape[1] - 1):
        a, b, c, d = (y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)
        splits = [((a, b, c), (b, c, d), (b, c)), ((a, b, d), (a, c, d), (a, d))]
        found = [
            [three for three in split[:2] if all(linked(three[k - 1], three[k]) for k in range(3))] for split in splits
        ]
        steps = [abs(depth[one] - depth[other]) for _, _, (one, other) in splits]
        best = 1 if (len(found[1]), -steps[1]) > (len(found[0]), -steps[0]) else 0
        triangles |= {frozenset(int(number[corner]) for corner in corners) for corners in found[best]}
    return triangles


def harmonics(error: Array, phase: Array, count: int = 3) -> Array:
    """Return the amplitudes of an error's harmonics against the phase: its mean, then 1 to `count`, rad."""
    columns = [np.ones(phase.shape)]
    for k in range(1, count + 1):
        columns += [np.cos(k * phase), np.sin(k * phase)]
    fit = np.linalg.lstsq(np.stack(columns, axis=-1), error, rcond=None)[0]
    return np.concatenate([fit[:1], np.hypot(fit[1::2], fit[2::2])])


def eroded(mask: Array, rim_px: int) -> Array:
    """Return the pixels further than this inside the mask's rim."""
    kernel = np.ones((2 * rim_px + 1, 2 * rim_px + 1), np.uint8)
    return cv2.erode(mask.astype(np.uint8), kernel, borderValue=0) != 0


def gain_at(gains: Array, spacing_px: int, y: float, x: float) -> Array:
    """Return the gains at a pixel, bilinear between nodes in the middle of cells."""
    place = [min(max((p + 0.5) / spacing_px - 0.5, 0.0), n - 1.0) for p, n in zip((y, x), gains.shape[:2], strict=True)]
    i, j = (int(p) for p in place)
    i1, j1 = min(i + 1, gains.shape[0] - 1), min(j + 1, gains.shape[1] - 1)
    v, u = place[0] - i, place[1] - j
    upper = (1 - u) * gains[i, j] + u * gains[i, j1]
    return (1 - v) * upper + v * ((1 - u) * gains[i1, j] + u * gains[i1, j1])


def smooth_cosine(turns: float) -> float:
    """Return about the cosine of a fraction of a turn: a smooth step from each crest to the trough."""
    half = abs(turns - np.round(turns)) * 2
    return 1 - 2 * (3 * half**2 - 2 * half**3)


def measure_contrast(
    image: Array,
    inverse: Array,
    gains: Array,
    gain_cell: int,
    phase: Array,
    modulation: Array,
    labels: Array,
    slots: int,
) -> dict[int, Array]:
    """Return by draft of a patch what is summed of its orders and blocks.

    That is weight, modulation, background, phase, and cosine and sine of three times the phase, which are smooth steps.
    Pixels beside one without a label are left out.
    """
    sums: dict[int, Array] = {}
    around = np.pad(labels, 1, mode="edge")
    beside = np.minimum.reduce([around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:]])
    cell_height, cell_width, block_width, order_bits, order_zero = 16, 8, 4, 6, 32
    for y, x in np.ndindex(labels.shape):
        if min(labels[y, x], beside[y, x]) < 0:
            continue
        top, left = y // cell_height * cell_height, x // cell_width * cell_width
        bottom, right = min(top + cell_height, labels.shape[0]), min(left + cell_width, labels.shape[1])
        first, last = (gain_at(gains.astype(np.float64), gain_cell, row, (left + right) // 2) for row in (top, bottom))
        gain = first + (y - top) / (bottom - top) * (last - first)
        background = (inverse.astype(np.float64) @ (image[y, x] * gain)).mean()
        weight = (1 - (float(phase[y, x]) / np.pi) ** 2) ** 2
        slot = (labels[y, x] & (2**order_bits - 1)) - order_zero + slots // 2
        own = sums.setdefault(int(labels[y, x] >> order_bits), np.zeros((slots, cell_width // block_width, 6)))
        turns = 3 * float(phase[y, x]) / (2 * np.pi)
        waves = [smooth_cosine(turns), smooth_cosine(turns - 0.25)]
        seen = np.array([1.0, modulation[y, x], background, phase[y, x], *waves])
        own[slot, (x - left) // block_width] += weight * seen
    return sums


def join_parts(
    ends: Array, span: int, min_margin: float, margin_a_step: float, orders: Array, evidence: Array
) -> Array:
    """Return a number of the part of each patch: contacts join in order, except parts that the evidence tells apart."""
    part = np.arange(len(evidence))
    for a, b in ends.T:
        a, b = part[a], part[b]
        if a == b:
            continue
        inside = [np.flatnonzero(part == p) for p in (a, b)]
        total = [evidence[i].astype(np.float64).sum(axis=0) for i in inside]
        best = [t[:-1].argmin() for t in total]
        spans = [orders[i, 1].max() - orders[i, 0].min() for i in inside]
        apart = min(spans) >= span
        for one, other in ((0, 1), (1, 0)):
            margin = total[one][best[other]] - total[one][best[one]]
            apart &= bool(margin >= max(min_margin, margin_a_step * total[one][-1]))
        if not apart:
            part[part == max(a, b)] = min(a, b)
    return part


def grow_parts(
    contacts: Array, against: Array, px: Array, pixels: Array, max_stepping: float, min_patch_px: int
) -> Array:
    """Return a number of the part of each patch: contacts join in order, except parts that step against each other."""
    part, pixels = np.arange(len(pixels)), pixels.copy()
    for a, b in contacts.T:
        a, b = part[a], part[b]
        first, second = part[against.T]
        stepping = px[((first == a) & (second == b)) | ((first == b) & (second == a))].sum()
        if a != b and (min(pixels[a], pixels[b]) < min_patch_px or stepping <= max_stepping):
            pixels[min(a, b)] += pixels[max(a, b)]
            part[part == max(a, b)] = min(a, b)
    return part


def correct_by_modulation(
    cycles: Array, table: Array, a_cycle: int, along: Array, within: Array, shares: Array
) -> Array:
    """Return what is to be added (rad): response, blur and balance where the modulation departs from the usual one.

    Of a code's ripples, (N, places, 3), by absolute phase in cycles and column in repeats of the code.
    """
    places = np.minimum((np.mod(along, 1) * table.shape[1]).astype(int), table.shape[1] - 1)
    row = np.clip(cycles * a_cycle, 0, len(table) - 1)
    below = np.minimum(row.astype(int), len(table) - 2)
    on = (row - below)[..., None]
    here = (1 - on) * table[below, places] + on * table[below + 1, places]
    edges = np.linspace(-0.5, 0.5, within.shape[1])
    linear, square = (np.interp(cycles, edges, row, period=1) for row in within.astype(np.float64))
    deviation = here[..., 0]
    of_contrast = deviation * linear + ((1 + deviation) ** 2 - 1) * square
    return shares[0] * of_contrast + shares[1] * here[..., 1] + shares[2] * here[..., 2]


def fit_phase(
    image: Array,
    phase: Array,
    template: Array,
    gain: Array,
    ambient: Array,
    noise: tuple[float, float],
    contrast_doubt: float,
    matrix: Array | None = None,
) -> tuple[Array, Array]:
    """Fit brightness, phase step and contrast of every pixel by least squares; return the phase and its precision.

    image (H, W, 3) levels, phase (H, W) where to start, template (3, 1 + 2 N), gain and ambient (H, W, 3) of the
    template's channels, which `matrix` mixes. A channel's variance is noise[0]^2 + noise[1] * light; the contrast's
    change is known to be 0 +- contrast_doubt.
    """
    harmonics = template.shape[1] // 2
    n = np.arange(1, harmonics + 1)
    turns = np.exp(1j * phase[..., None] * n)
    cycle = 1 + turns.real @ template[:, 1 : harmonics + 1].T + turns.imag @ template[:, harmonics + 1 :].T
    change = (n * turns.real) @ template[:, harmonics + 1 :].T - (n * turns.imag) @ template[:, 1 : harmonics + 1].T
    columns = np.stack([gain * cycle, gain * change, gain * (cycle - 1)], axis=-1)
    rest = ambient
    if matrix is not None:
        columns, rest = np.einsum("ij,hwjk->hwik", matrix, columns), ambient @ matrix.T
    sigma = np.sqrt(noise[0] ** 2 + noise[1] * np.maximum(image, 0))
    light, columns = (image - rest) / sigma, columns / sigma[..., None]
    brightness = np.einsum("hwi,hwi->hw", light, columns[..., 0]) / (columns[..., 0] ** 2).sum(-1)
    stepped, precision = np.empty(phase.shape), np.empty(phase.shape)
    for place in np.ndindex(phase.shape):
        s = brightness[place]
        design = np.vstack([columns[place] * [1, s, s], [0, 0, 1 / contrast_doubt]])  # with the contrast's prior
        weighted = np.linalg.lstsq(design, np.append(light[place], 0), rcond=None)[0]
        covariance = np.linalg.inv(design.T @ design)
        free = columns[place][:, 1] - columns[place][:, 0] * (
            columns[place][:, 0] @ columns[place][:, 1] / (columns[place][:, 0] @ columns[place][:, 0])
        )
        normal = np.cross(columns[place][:, 0], free)
        normal /= np.linalg.norm(normal)
        fade = columns[place][:, 2] @ normal * s
        fade_all = columns[place][:, 2] - columns[place][:, 0] * (
            columns[place][:, 0] @ columns[place][:, 2] / (columns[place][:, 0] @ columns[place][:, 0])
        )
        widened = 1 + (contrast_doubt * s) ** 2 * (fade_all @ fade_all)
        assert abs(fade) <= s * np.linalg.norm(fade_all) + 1e-9
        misfit = (light[place] @ normal) ** 2 / widened
        stepped[place] = phase[place] + weighted[1]
        precision[place] = 1 / covariance[1, 1] / max(1, misfit / 9)
    return stepped, precision


@cache
def chroma_weights(n_pixels: int, subsampling: int, site: float, missing: int) -> Array:
    """Return (pixels, samples) weights: the polynomial whose means at the nearest samples are those.

    `missing` pixels of the first sample are not there.
    """
    n_samples = -(-(n_pixels + missing) // subsampling)
    around = np.arange(subsampling) - (subsampling - 1) / 2
    weights = np.zeros((n_pixels, n_samples))
    for pixel in range(n_pixels):
        if subsampling == 1:
            weights[pixel, pixel] = 1
            continue
        own, place = divmod(pixel + missing, subsampling)
        place -= site * (subsampling - 1)
        near = range(-2, 3) if place == 0 else range(-3, 3) if place < 0 else range(-2, 4)
        degrees = np.arange(len(near))
        # Means of the monomials over the pixels about each sample.
        means = np.array([[np.mean((subsampling * k + around) ** d) for d in degrees] for k in near])
        for k, weight in zip(near, np.linalg.solve(means.T, float(place) ** degrees), strict=True):
            weights[pixel, np.clip(own + k, 0, n_samples - 1)] += weight
    return weights


def convert_chroma(planes: Sequence[Array], format: PixelFormat) -> Array:
    """Return encoded RGB, 0..1, of luma and chroma planes (Rec. ITU-R BT.601-7, BT.709-6 and BT.2020-2, section 3)."""
    luma, *chroma = (plane.astype(np.float64) / 2**format.shift for plane in planes)
    (x, y), (left, above), (across, down) = format.subsampling, format.origin, SITES[format.siting]
    rows = chroma_weights(luma.shape[0], y, down, above)
    columns = chroma_weights(luma.shape[1], x, across, left)
    blue, red = (rows @ plane @ columns.T for plane in chroma)
    step, peak = 2 ** (format.bits - 8), 2**format.bits - 1
    if format.full_range:
        luma, blue, red = luma / peak, (blue - 128 * step) / peak, (red - 128 * step) / peak
    else:
        luma, blue, red = ((luma / step - 16) / 219, (blue / step - 128) / 224, (red / step - 128) / 224)
    of_red, of_blue = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722), "bt2020": (0.2627, 0.0593)}[format.matrix]
    r, b = luma + 2 * (1 - of_red) * red, luma + 2 * (1 - of_blue) * blue
    g = (luma - of_red * r - of_blue * b) / (1 - of_red - of_blue)
    return np.clip(np.stack([r, g, b], axis=-1), 0, 1)


def subsample_chroma(image: Array, format: PixelFormat) -> list[Array]:
    """Return the planes of encoded RGB in 0..1, even in size: what a camera does whose chroma is the mean of a block.

    Where a sample's site is the first of two pixels, that pixel weighs six eighths and its neighbours one each, which
    takes as much of the modulation as the mean of two pixels between them.
    """
    of_red, of_blue = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722), "bt2020": (0.2627, 0.0593)}[format.matrix]
    r, g, b = np.moveaxis(image.astype(np.float64), -1, 0)
    luma = of_red * r + (1 - of_red - of_blue) * g + of_blue * b
    chroma = [(b - luma) / (2 * (1 - of_blue)), (r - luma) / (2 * (1 - of_red))]
    for axis, (step, site) in enumerate(zip(format.subsampling[::-1], SITES[format.siting][::-1], strict=True)):
        for i, plane in enumerate(chroma):
            lines = np.moveaxis(plane, axis, 0)
            if step == 2 and site == 0:
                before, after = np.roll(lines, 1, axis=0), np.roll(lines, -1, axis=0)
                before[0], after[-1] = lines[0], lines[-1]
                lines = ((before + 6 * lines + after) / 8)[::2]
            else:
                lines = sum(lines[part::step] for part in range(step)) / step
            chroma[i] = np.moveaxis(lines, 0, axis)
    step, peak = 2 ** (format.bits - 8), 2**format.bits - 1
    if format.full_range:
        scaled = [luma * peak, *(plane * peak + 128 * step for plane in chroma)]
    else:
        scaled = [(219 * luma + 16) * step, *((224 * plane + 128) * step for plane in chroma)]
    y, u, v = (np.clip(np.rint(plane), 0, peak).astype(np.uint16) << format.shift for plane in scaled)
    return [plane.astype(format.dtype) for plane in (y, u, v)]


def mosaic(image: Array, bayer: str) -> Array:
    """Return what a camera with a Bayer pattern sees of an RGB picture."""
    seen = np.empty_like(image[..., 0])
    for place, color in enumerate(bayer):
        seen[place // 2 :: 2, place % 2 :: 2] = image[place // 2 :: 2, place % 2 :: 2, "rgb".index(color)]
    return seen


def demosaic(levels: Array, format: PixelFormat, stripes: str) -> Array:
    """Return RGB, 0..1: a straight line along the stripes, Lagrange's polynomial through eight rows across them."""
    if stripes == "vertical":
        turned = replace(format, bayer="".join(format.bayer[i] for i in (0, 2, 1, 3)))
        return demosaic(levels.T, turned, "horizontal").transpose(1, 0, 2)
    values = np.pad(levels / format.white_level, 8, mode="reflect")
    # 8 is even: the pattern begins at the same place.
    own = np.full((3, *values.shape), np.nan)
    for place, color in enumerate(format.bayer):
        y, x = place // 2, place % 2
        own["rgb".index(color), y::2, x::2] = values[y::2, x::2]
    for plane in own:
        along = (np.roll(plane, 1, axis=1) + np.roll(plane, -1, axis=1)) / 2
        np.copyto(plane, along, where=np.isnan(plane))
        across = np.zeros_like(plane)
        for row in range(-7, 8, 2):
            others = [other for other in range(-7, 8, 2) if other != row]
            across += np.prod([other / (other - row) for other in others]) * np.roll(plane, -row, axis=0)
        np.copyto(plane, across, where=np.isnan(plane))
    return np.clip(np.moveaxis(own, 0, -1)[8:-8, 8:-8], 0, 1)


def _ripple_waves(phase: Array) -> Array:
    """Return cosine and sine of a phase, of twice and of three times that, (..., 6)."""
    waves = [function(n * phase.astype(np.float64)) for n in (1, 2, 3) for function in (np.cos, np.sin)]
    return np.stack(waves, axis=-1)


def ripple(terms: Array, phase: Array) -> Array:
    """Return the logarithm of a ripple at a phase."""
    return np.asarray(_ripple_waves(phase) @ terms)


def _second_differences(values: Array, step: int) -> Array:
    """Return what three rows, two steps apart in all, leave of a slope."""
    return 2 * values[step:-step] - values[: -2 * step] - values[2 * step :]


def _sampled(brightness: Array, mask: Array, step: int, most: float) -> tuple[Array, Array]:
    """Return the change of the brightness' logarithm, and the weights of those pixels that are asked."""
    height, width = brightness.shape
    change = _second_differences(np.log(np.maximum(brightness, 1e-30).astype(np.float64)), step)
    weights = np.zeros((height - 2 * step, width))
    inside = (mask[: -2 * step] != 0) & (mask[step:-step] != 0) & (mask[2 * step :] != 0)
    for y in range(height - 2 * step):
        for number in range(-(-width // 4)):
            weights[y, min(4 * number + y % 4, width - 1)] += 1.0
    return change, weights * inside * np.minimum(1, most / (np.abs(change) + 1e-9))


def measure_ripple(brightness: Array, phase: Array, mask: Array, period_px: float) -> Array:
    """Return cosines and sines of what repeats with every cycle of a brightness' logarithm, by least squares."""
    step = max(1, round(period_px / 4))
    change, weights = _sampled(brightness, mask, step, 0.05)
    waves = _second_differences(_ripple_waves(np.where(mask != 0, phase, 0)), step).reshape(-1, 6)
    weighed = waves * weights.reshape(-1, 1)
    return np.linalg.solve(weighed.T @ waves + 30 * np.eye(6), weighed.T @ change.ravel())


def contrast_slope(brightness: Array, contrast: Array, mask: Array, period_px: float) -> tuple[float, float]:
    """Return by how much a brightness' logarithm changes with the contrast's, and the mean of that."""
    step = max(1, round(period_px))
    change, weights = _sampled(brightness, mask, step, 0.05)
    by_contrast = _second_differences(contrast.astype(np.float64), step)
    asked = _sampled(np.ones_like(brightness), np.ones_like(mask), step, 0.05)[1] * (mask[: -2 * step] != 0)
    slope = (weights * change * by_contrast).sum() / ((weights * by_contrast**2).sum() + 30 * 0.05**2)
    return float(slope), float((asked * contrast[: -2 * step]).sum() / max(asked.sum(), 1))


def light_by_white(image: Array, phase: Array, mask: Array, white: Array, model: dict[str, Array]) -> Array:
    """Return what pixels without a clipped channel show under white.

    `model` has A, B (H, W, 3), the surface's T (3, 3) and `besides` (3,), the template's cycle and slope (H, W, 3), and
    the window of the contrast in px, down and across.
    """
    mixing = model["T"].astype(np.float64)
    color, rest = model["A"].astype(np.float64), model["B"] @ mixing.T + model["besides"]
    columns = np.stack([color * part @ mixing.T for part in (model["cycle"], model["slope"], model["cycle"] - 1)], -1)
    solved = np.linalg.solve(columns, (image - rest)[..., None])[..., 0]
    brightness, by_contrast = solved[..., 0] * (mask != 0), solved[..., 2] * (mask != 0)
    sigma_y, sigma_x = model["window"]
    smooth = {"ksize": (0, 0), "sigmaX": sigma_x, "sigmaY": sigma_y, "borderType": cv2.BORDER_CONSTANT}
    mean = cv2.GaussianBlur(brightness * by_contrast, **smooth) / cv2.GaussianBlur(brightness**2, **smooth)
    shown = brightness[..., None] * (color * (white + np.clip(mean, -0.3, 0.3)[..., None] * (white - 1)) @ mixing.T)
    return np.maximum(shown + rest, 0) * (mask != 0)[..., None]
