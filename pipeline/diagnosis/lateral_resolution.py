"""Measure lateral resolution on a corrugated plate, by the instrument transfer function of height.

The plate's height is a sum of sinusoids of known periods and amplitudes along one direction. Every part of the plate
has all periods, so its place need not be known. Its direction and scale are fitted by a search over angles and then by
Gauss-Newton steps; amplitudes and phases of all periods follow by linear least squares, together with a quadric for the
bend that a calibration leaves. The transfer is the measured amplitude over the plate's. The *lateral period limit*
D_LIM is the period at which the transfer falls to 50 % (ISO 25178-600); VDI/VDE 2634 Part 2 has no such figure.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.errors import CalibrationError
from pipeline.models import FloatArray
from pipeline.robust import fit_plane

#: The plate's periods, mm: preferred numbers, ten per decade (ISO 3).
PERIODS_MM = np.array([10, 8, 6.3, 5, 4, 3.15, 2.5, 2, 1.6, 1.25, 1])
_RAD_PER_MM, _COUNT = 2 * np.pi / PERIODS_MM, len(PERIODS_MM)
# Each period adds this slope. With these phases the slopes add up to 0.67, and the heights to 0.93 mm from valley to
# peak; a plate that a tool with a radius of 0.4 mm can mill.
_SLOPE = 0.1
_PHASES = 7.0 * np.arange(_COUNT)[::-1] ** 2
# A plate that is held by hand is turned by less than this. A step of the search moves the ends of a side of 120 mm by a
# fiftieth of the longest period; the first Gauss-Newton step leaves a tenth of that, the last one rounding.
_TURNED, _STEP, _STEPS = np.radians(15), np.radians(0.2), 4
# The search takes so many points: the longest periods then have ten times their noise.
_SEARCHED = 4000
# If less of the longest period is seen, or more, it is another plate, or the limit is beyond it.
_LIMIT, _MOST = 0.5, 1.5


@dataclass(frozen=True)
class LateralResolution:
    """The transfer of height along one direction."""

    limit_mm: float | None  # lateral period limit; None: shorter than the shortest period
    sigma_mm: float | None  # standard uncertainty of the limit, by the noise of the fit
    predicted_mm: float  # by smoothing, the camera's pixels and its lens
    periods_mm: tuple[float, ...]
    transfer: tuple[float, ...]  # by period
    transfer_sigma: tuple[float, ...]


def relief(x_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return height, mm, and slope of the corrugated plate at distances from its middle along the profile."""
    height, slope = np.zeros_like(x_mm), np.zeros_like(x_mm)
    for rate, phase in zip(_RAD_PER_MM, _PHASES, strict=True):
        height += _SLOPE / rate * np.sin(rate * x_mm + phase)
        slope += _SLOPE * np.cos(rate * x_mm + phase)
    return height, slope


def measure_transfer(
    points: FloatArray, tile: npt.NDArray[np.intp], profile: FloatArray, predicted_mm: float
) -> LateralResolution:
    """Return the transfer of height of a corrugated plate.

    Parameters
    ----------
    points : (N, 3)
        On the plate, mm.
    tile : (N,)
        The number of the tile of each point; the errors of a tile's points count as one.
    profile : (3,)
        Unit vector of the direction in which the height should change, to 15 degrees.
    predicted_mm : float
        The predicted lateral period limit.

    Raises
    ------
    CalibrationError
        The plate's corrugations are not seen.
    """
    middle, normal = fit_plane(points)
    across = np.cross(normal, profile)
    across /= np.linalg.norm(across)
    x, y, height = np.stack([np.cross(across, normal), across, normal]) @ (points - middle).T
    few = slice(None, None, -(-len(x) // _SEARCHED))
    angles = np.arange(-_TURNED, _TURNED, _STEP)
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    way = min(ways, key=lambda way: float(np.std(_fit(x[few], y[few], height[few], way)[2])))
    for _ in range(_STEPS):
        rows, found, residual = _fit(x, y, height, way)
        cosines, sines = np.split(found[: 2 * _COUNT], 2)
        slope = rows[:, : 2 * _COUNT] @ np.concatenate([_RAD_PER_MM * sines, -_RAD_PER_MM * cosines])
        way = way + np.linalg.lstsq(np.stack([slope * x, slope * y], axis=1), residual, rcond=None)[0]
    rows, found, residual = _fit(x, y, height, way)
    sums = np.stack([np.bincount(tile, column * residual) for column in rows.T])
    inverse = np.linalg.inv(rows.T @ rows)
    freedom = sums.shape[1] / (sums.shape[1] - len(found))
    variances = freedom * np.diag(inverse @ (sums @ sums.T) @ inverse)
    (cosines, sines), noise = found[: 2 * _COUNT].reshape(2, -1), variances[: 2 * _COUNT].reshape(2, -1)
    # The noise of both adds to the square of an amplitude.
    amplitudes = np.sqrt(np.maximum(cosines**2 + sines**2 - noise.sum(axis=0), 0))
    transfer, sigma = (values * _RAD_PER_MM / _SLOPE for values in (amplitudes, np.sqrt(noise.mean(axis=0))))
    if not _LIMIT < transfer[0] < _MOST:
        raise CalibrationError(
            f"{transfer[0]:.0%} of the height of corrugations {PERIODS_MM[0]:g} mm long is seen: show the plate of "
            "docs/certify.md, its ridges as asked for; if this is so, the lateral resolution is coarser than they are"
        )
    lists = (tuple(values.tolist()) for values in (PERIODS_MM, transfer, sigma))
    return LateralResolution(*_limit_mm(transfer, sigma), predicted_mm, *lists)


def _fit(
    x: FloatArray, y: FloatArray, height: FloatArray, way: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rows (N, M) of a linear model of heights, its coefficients (M,), and what it leaves (N,).

    First are the cosines of all periods along a way (2,), then their sines, then a quadric.
    """
    phases = np.outer(x * way[0] + y * way[1], _RAD_PER_MM)
    u, v = x / np.ptp(x), y / np.ptp(y)
    rows = np.column_stack([np.cos(phases), np.sin(phases), np.ones_like(u), u, v, u * u, u * v, v * v])
    found = np.linalg.solve(rows.T @ rows, rows.T @ height)
    return rows, found, height - rows @ found


def _limit_mm(transfer: FloatArray, sigma: FloatArray) -> tuple[float | None, float | None]:
    """Return the period at which the transfer falls to 50 %, and its standard uncertainty, mm; None: none does."""
    below = np.nonzero(transfer < _LIMIT)[0]
    if not below.size:
        return None, None
    pair = slice(below[0] - 1, below[0] + 1)
    (upper, lower), (longer, shorter) = transfer[pair], PERIODS_MM[pair]
    part = (upper - _LIMIT) / (upper - lower)
    limit = longer * (shorter / longer) ** part
    of_part = np.hypot((1 - part) * sigma[pair][0], part * sigma[pair][1]) / (upper - lower)
    return float(limit), float(limit * np.log(longer / shorter) * of_part)
