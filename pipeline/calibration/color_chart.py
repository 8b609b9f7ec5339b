"""At which wavelengths the camera's channels see the projector's primaries, from a colour chart with known spectra.

Filter i and primary j meet around a wavelength of their own, lambda_ij: there the crosstalk's entry is weighed by a
surface's reflectance (`tikernels/phase/surface_matrix.py`). Four pictures of a chart, under black and under each
primary alone, determine all nine: with the ambient light of black taken off, channel i sees of patch n under primary j

    c_ij e_j(n) rho_n(lambda_ij),

e_j the projector's light over the chart, whose logarithm is taken to be a plane.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration.captures import PictureSequence, full_scale
from pipeline.calibration.model import Calibration
from pipeline.calibration.radiometry import PRIMARIES
from pipeline.errors import CalibrationError
from pipeline.limits import read_text
from pipeline.models import FloatArray, ImageArray

#: Patches of the chart, along and down.
COLUMNS, ROWS = 6, 4
_BLACK = "0-black"
# The middle of a patch that is measured, as a part of its pitch.
_MIDDLE = 0.4
# Light, of full scale, that counts half: noise and stray light are about as much. From this part of it on pixels may be
# saturated.
_HALF, _SATURATED = 0.005, 0.99
# A primary whose brightest patch is darker than this, of full scale, shows nothing.
_MIN_SIGNAL = 0.04
# Wavelengths that are tried, nm.
_TRIED = np.arange(400.0, 701.0)
# How far from the primary's own wavelength a channel may see it: a standard deviation, nm.
_APART = 40.0
_ROUNDS = 10
# A chart whose patches are off by more than this fraction, RMS, is another; a patch that is darker by more under all
# primaries is in shadow.
_MAX_MISFIT, _SHADOW = 0.12, 0.25
# A primary's own wavelength that is less sure than this is not determined by the chart, nm.
_UNSURE = 15.0
# What is known of a reflectance, at least.
_LEAST_RHO = 0.01


@dataclass(frozen=True)
class ChartLight:
    """Wavelengths measured from a colour chart."""

    wavelengths_nm: FloatArray  # (3, 3) where channel i sees primary j
    sigma_nm: FloatArray  # (3, 3) standard deviations
    misfit: float  # how far patches are from their spectra, RMS, as a fraction

    def add_to(self, calibration: Calibration) -> Calibration:
        """Return the calibration with these wavelengths."""
        return calibration.replace(wavelengths_nm=self.wavelengths_nm)


def chart_sequence(size_px: tuple[int, int]) -> PictureSequence:
    """Return the full fields to project: black and the three primaries."""
    names = (_BLACK, *(f"{number}-{name}" for number, name in enumerate(PRIMARIES, 1)))
    return PictureSequence(kind="chart", size_px=size_px, names=names)


def chart_codes(name: str) -> FloatArray:
    """Return the (3,) projector codes, 0..1, of a full field of the sequence."""
    return np.array([name.endswith(primary) for primary in PRIMARIES], np.float64)


def read_spectra(path: Path) -> FloatArray:
    """Read the patches' spectra: a row a wavelength, in nm, and then a column a patch, in reading order, 0..1.

    Returns
    -------
    (N, 25) float64

    Raises
    ------
    CalibrationError
        The file cannot be read, or is no such table.
    """
    try:
        lines = map(str.strip, read_text(path).splitlines())
        # Headings and remarks do not begin with a number.
        rows = [_cells(line) for line in lines if line[:1].isdigit()]
        table = np.array([[float(cell) for cell in row] for row in rows])
    except (OSError, ValueError) as error:
        raise CalibrationError(f"{path} is no table of spectra: {error}") from None
    count = COLUMNS * ROWS
    if table.ndim != 2 or table.shape[1] != 1 + count or len(table) < 2:
        raise CalibrationError(f"{path} is no table of spectra: give a row a wavelength, nm and then {count} patches")
    if not (np.diff(table[:, 0]) > 0).all() or table[0, 0] > _TRIED[20] or table[-1, 0] < _TRIED[-40]:
        raise CalibrationError(f"{path}: wavelengths must rise from 420 nm or less to 660 nm or more")
    if not np.isfinite(table).all() or table[:, 1:].min() < 0 or table[:, 1:].max() > 2:
        raise CalibrationError(f"{path}: reflectances must lie between 0 and 1: divide those in per cent by 100")
    return table


def _cells(line: str) -> list[str]:
    """Return a row's numbers with decimal points; commas are decimal where something else separates the numbers.

    >>> _cells("380;0,12;0,1") == _cells("380 0,12 0,1") == _cells("380, 0.12, 0.1") == _cells("380,0.12,0.1")
    True
    """
    cells = re.split(r"\s*;\s*|,?\s+", line)
    cells = line.split(",") if len(cells) == 1 else cells
    return [cell.replace(",", ".") for cell in cells if cell]


def measure_wavelengths(
    captures: Mapping[str, ImageArray], corners_px: FloatArray, spectra: FloatArray, white_level: float | None = None
) -> ChartLight:
    """Measure at which wavelengths the camera's channels see the projector's primaries.

    Parameters
    ----------
    captures : mapping from name to (H, W, 3) uint8, uint16 or float32
        The captures of `chart_sequence`, in linear light.
    corners_px : (4, 2)
        x, y of the middles of the first and last patch of the first row, then of the last and first of the last row.
    spectra : (N, 25)
        See `read_spectra`.
    white_level : float, optional
        Full scale; None: the type's.

    Raises
    ------
    CalibrationError
        Captures are saturated, too dark, or do not show this chart; or a patch is in shadow.
    """
    names = chart_sequence((1, 1)).names
    brightest = max((captures[name] for name in names), key=lambda image: float(image.max()))
    full = full_scale(brightest, white_level)
    fields = np.stack([_patches(captures[name], corners_px, name, full) for name in names])
    light = fields[1:] - fields[0]  # (primary, patch, channel)
    for primary, name in zip(light, names[1:], strict=True):
        if primary.max() < _MIN_SIGNAL:
            raise CalibrationError(f"{name} is hardly brighter than {_BLACK}: expose longer")
    rho = np.stack([np.interp(_TRIED, spectra[:, 0], column) for column in spectra[:, 1:].T])
    logs = np.log(np.maximum(rho, _LEAST_RHO))
    results = [_of_primary(light[j], logs, j) for j in range(3)]
    rests, weights = (np.stack([result[k] for result in results]) for k in (2, 3))
    misfit = float(np.sqrt((weights * rests**2).sum() / weights.sum()))
    together = np.median(rests.transpose(1, 0, 2).reshape(len(logs), 9), axis=1)
    darkest = int(together.argmin())
    if together[darkest] < -_SHADOW and np.median(np.abs(together)) < 0.5 * _MAX_MISFIT:
        row, column = divmod(darkest, COLUMNS)
        raise CalibrationError(
            f"patch {darkest + 1} (row {row + 1}, column {column + 1}) is {1 - np.exp(together[darkest]):.0%} darker "
            "than its spectrum says, whatever the primary: light the whole chart, without shadow or gloss"
        )
    if misfit > _MAX_MISFIT:
        raise CalibrationError(
            f"the patches are off their spectra by {misfit:.0%}: name the corners in the order first row's first and "
            "last patch, last row's last and first, and give the spectra of this very chart"
        )
    wavelengths, sigmas = (np.stack([result[k] for result in results], axis=1) for k in (0, 1))
    for name, own, sigma in zip(PRIMARIES, np.diag(wavelengths), np.diag(sigmas), strict=True):
        if sigma > _UNSURE or not (np.diff(np.diag(wavelengths)) < 0).all():
            raise CalibrationError(
                f"the chart determines no wavelength for {name} ({own:.0f} ± {sigma:.0f} nm): take one of saturated "
                "colours"
            )
    return ChartLight(wavelengths, sigmas, misfit)


def _patches(image: ImageArray, corners_px: FloatArray, name: str, full: float) -> FloatArray:
    """Return the mean light of the middles of the patches, (24, 3), of full scale."""
    height, width = image.shape[:2]
    outer = np.array([[0, 0], [COLUMNS - 1, 0], [COLUMNS - 1, ROWS - 1], [0, ROWS - 1]], np.float32)
    place = cv2.getPerspectiveTransform(outer, np.asarray(corners_px, np.float32))
    result = np.empty((ROWS * COLUMNS, 3))
    for number in range(ROWS * COLUMNS):
        row, column = divmod(number, COLUMNS)
        half = 0.5 * _MIDDLE
        corners = [[column + x, row + y] for x, y in ((-half, -half), (half, -half), (half, half), (-half, half))]
        outline = cv2.perspectiveTransform(np.array([corners], np.float32), place)[0]
        if outline.min() < 0 or (outline.max(axis=0) > [width - 1, height - 1]).any():
            raise CalibrationError(f"patch {number + 1} lies outside the picture: name the corners in px of {name}")
        mask = np.zeros((height, width), np.uint8)
        cv2.fillConvexPoly(mask, np.rint(outline).astype(np.int32), 1)
        values = image[mask > 0].astype(np.float64) / full
        if (values > _SATURATED).mean() > 0.01:
            raise CalibrationError(f"{name} is at full scale in patch {number + 1}: expose shorter")
        result[number] = values.mean(axis=0)
    return result


def _of_primary(
    light: FloatArray, logs: FloatArray, primary: int
) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.float64]]:
    """Return a primary's wavelengths and their deviations, (3,), and each patch's rest and weight, (24, 3)."""
    place = np.stack(np.divmod(np.arange(len(logs)), COLUMNS)).astype(np.float64)
    place -= place.mean(axis=1, keepdims=True)
    seen = np.log(np.maximum(light, 1e-5))
    weights = (np.maximum(light, 0) / (np.maximum(light, 0) + _HALF)) ** 2
    slope, chosen = np.zeros(2), np.zeros(3, int)
    rests = np.zeros_like(seen)
    # The channel that is named after the primary sees most of it, and shows where it is.
    for turn in range(_ROUNDS):
        flat = seen - (slope @ place)[:, None]
        for channel in sorted(range(3), key=lambda i: i != primary):
            weight = weights[:, channel]
            off = flat[:, channel, None] - logs
            off = off - weight @ off / weight.sum()
            costs = weight @ off**2 / weight.sum()
            scale = max(float(costs.min()), 1e-4) / len(logs)
            if channel != primary:
                costs = costs + scale * ((_TRIED - _TRIED[chosen[primary]]) / _APART) ** 2
            chosen[channel] = int(costs.argmin())
            rests[:, channel] = off[:, chosen[channel]]
        if turn < _ROUNDS - 1:
            both = weights.sum(axis=1)
            mean = (weights * rests).sum(axis=1) / both
            design = place * np.sqrt(both)
            slope = slope + np.linalg.solve(design @ design.T, design @ (mean * np.sqrt(both)))
    steepness = np.gradient(logs, _TRIED, axis=1)[:, chosen]
    steepness = steepness - (weights * steepness).sum(axis=0) / weights.sum(axis=0)
    variance = (weights * rests**2).sum(axis=0) / weights.sum(axis=0)
    certainty = (weights * steepness**2).sum(axis=0) / np.maximum(variance, 1e-5)
    return _TRIED[chosen], 1 / np.sqrt(certainty + 1 / _APART**2), rests, weights
