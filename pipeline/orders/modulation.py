"""What a coded pattern's changing modulation does to the phase, and what undoes it (`docs/coded_pattern.md`)."""

from functools import cache

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from pipeline.pattern.contrast_code import CYCLES, modulation_at
from tikernels.order_evidence.modulation_correction import SLOPE_REACH, TABLED

# Where the phase bends by more (rad) within a cycle, the surface does.
_MAX_BEND = 0.3


@cache
def code_deviations(usual: float) -> tuple[FloatArray, FloatArray]:
    """Return how the code's modulation deviates from the usual one, and the slope of its logarithm.

    Parameters
    ----------
    usual : float
        Fraction of full scale.

    Returns
    -------
    two (TABLED (CYCLES - 1) + 1,) float64
        Deviations as a fraction of the usual one, and slopes a cycle, TABLED a cycle from the first cycle's middle on.
    """
    place = np.arange(TABLED * (CYCLES - 1) + 1) / TABLED
    low, here, high = (modulation_at(place + reach) for reach in (-SLOPE_REACH, 0, SLOPE_REACH))
    return here / usual - 1, (high - low) / (2 * SLOPE_REACH * here)


def modulation_corrections(deviations: FloatArray, tables: npt.NDArray[np.floating]) -> FloatArray:
    """Return what the response's correction lacks where the modulation is not the usual one.

    Parameters
    ----------
    deviations : (N,) float64
        Of the modulation from the usual one, as a fraction of it, TABLED a cycle from the middle of a cycle on.
    tables : (2, bins + 1)
        rad over a cycle from -pi on: what of the correction goes with the modulation, and with its square.

    Returns
    -------
    (N,) float64
        rad.
    """
    edges = np.linspace(-0.5, 0.5, tables.shape[1])
    around = [np.interp(np.arange(TABLED) / TABLED, edges, row, period=1) for row in tables]
    linear, square = (np.resize(row, len(deviations)) for row in around)
    return np.asarray(deviations * (linear + (2 + deviations) * square))


def blur_shift(
    unwrapped: npt.NDArray[np.float32],
    region: npt.NDArray[np.int32],
    absolute: npt.NDArray[np.bool_],
    slopes: FloatArray,
    period_px: float,
) -> float:
    """Return how far blur shifts the phase where the modulation rises e-fold a cycle, rad.

    Blur weakens the fringe's upper sideband more than its lower one, which turns a change of the modulation into one of
    the phase: by (2 pi s)^2 / (2 pi) of its logarithm's slope, for a Gaussian of s cycles.

    Parameters
    ----------
    unwrapped : (H, n) float32
        rad, absolute; columns of the image.
    region : (H, n) int32
        Number of each pixel's region; 0 outside.
    absolute : (regions + 1,) bool
        Whether a region's orders are absolute.
    slopes : (N,) float64
        Of the modulation's logarithm, a cycle; see `code_deviations`.
    period_px : float
        Rows a cycle.

    Returns
    -------
    float
        rad; 0 where nothing tells.
    """
    half = max(1, round(period_px / 2))
    # Every fourth row tells enough.
    middle, above, below = (region[half:-half:4], region[: -2 * half : 4], region[2 * half :: 4])
    inside = (middle > 0) & (middle == above) & (middle == below) & absolute[middle]
    if not inside.any():
        return 0.0
    rows, columns = np.nonzero(inside)
    phases = [unwrapped[4 * rows + offset, columns].astype(np.float64) for offset in (0, half, 2 * half)]
    places = [np.clip(np.rint(phase * (TABLED / (2 * np.pi))), 0, len(slopes) - 1).astype(int) for phase in phases]
    # A smooth surface hardly bends within a cycle; what it bends has nothing to do with the code.
    bend, expected = (a[0] - 2 * a[1] + a[2] for a in (phases, [slopes[place] for place in places]))
    smooth = np.abs(bend) < _MAX_BEND
    return float(bend[smooth] @ expected[smooth] / max(float(expected[smooth] @ expected[smooth]), 1e-9))
