"""What a coded pattern's changing contrast does to the phase, and what undoes it (`docs/coded_pattern.md`)."""

from functools import cache

import numpy as np
import numpy.typing as npt

from pipeline.contrast_code import CYCLES, ContrastCode
from pipeline.models import FloatArray
from tikernels.order_evidence.modulation_correction import SLOPE_REACH, TABLED
from tikernels.phase.balance_window import SIGMA_ACROSS

# Where the phase bends by more (rad) within a cycle, the surface does.
_MAX_BEND = 0.3
# How much of the ripples is usual, as a standard deviation: rad for blur, and shares of the others.
_USUAL_SHARES = np.array([0.03, 0.3, 0.3])
# The balance's window is computed to this many cycles on either side.
_WINDOWS = 4


@cache
def code_deviations(code: ContrastCode) -> FloatArray:
    """Return how the code's contrast deviates from the usual one.

    Returns
    -------
    (TABLED (CYCLES - 1) + 1,) float64
        As a fraction of the usual one, TABLED a cycle from the first cycle's middle on.
    """
    modulation = code.modulation(np.arange(TABLED * (CYCLES - 1) + 1) / TABLED)
    return np.asarray(modulation / (1 - modulation) / code.usual - 1)


def modulation_corrections(deviations: FloatArray, tables: npt.NDArray[np.floating]) -> FloatArray:
    """Return what the response's correction lacks where the contrast is not the usual one.

    Parameters
    ----------
    deviations : (N,) float64
        Of the contrast from the usual one, as a fraction of it, TABLED a cycle from the middle of a cycle on.
    tables : (2, bins + 1)
        rad over a cycle from -pi on: what of the correction goes with the contrast, and with its square.

    Returns
    -------
    (N,) float64
        rad.
    """
    edges = np.linspace(-0.5, 0.5, tables.shape[1])
    around = [np.interp(np.arange(TABLED) / TABLED, edges, row, period=1) for row in tables]
    linear, square = (np.resize(row, len(deviations)) for row in around)
    return np.asarray(deviations * (linear + (2 + deviations) * square))


@cache
def code_ripples(code: ContrastCode) -> FloatArray:
    """Return the shapes of what the code may leave in the phase.

    Blur weakens the fringe's upper sideband more than its lower one, which turns a change of the modulation into one of
    the phase: by (2 pi s)^2 / (2 pi) of its logarithm's slope, for a Gaussian of s cycles. And what the balance's
    window passes of the fringe where the contrast changes within it turns the colours, and the phase with them.

    Returns
    -------
    (2, TABLED (CYCLES - 1) + 1) float64
        The slope, a cycle, and what the window passes, as a fraction; TABLED a cycle from the first cycle's middle on.
    """
    inside = np.arange(TABLED * (CYCLES - 1) + 1) / TABLED
    low, here, high = (code.modulation(inside + reach) for reach in (-SLOPE_REACH, 0, SLOPE_REACH))
    slopes = (high - low) / (2 * SLOPE_REACH * here)
    modulation = code.modulation(np.arange(-_WINDOWS * TABLED, len(inside) + _WINDOWS * TABLED) / TABLED)
    window = np.arange(-_WINDOWS * TABLED, _WINDOWS * TABLED + 1) / TABLED
    weight = np.exp(-0.5 * (window / SIGMA_ACROSS) ** 2)
    passed = np.convolve(modulation / (1 - modulation), weight / weight.sum() * np.sin(2 * np.pi * window), "valid")
    return np.stack([slopes, passed])


def ripple_left(
    unwrapped: npt.NDArray[np.float32],
    region: npt.NDArray[np.int32],
    absolute: npt.NDArray[np.bool_],
    corrections: FloatArray,
    period_px: float,
    code: ContrastCode,
) -> FloatArray:
    """Return what is left in a frame's phase of the code's ripples, by how the phase bends within cycles.

    Parameters
    ----------
    unwrapped : (H, n) float32
        rad, absolute; columns of the image.
    region : (H, n) int32
        Number of each pixel's region; 0 outside.
    absolute : (regions + 1,) bool
        Whether a region's orders are absolute.
    corrections : (N,) float64
        rad to be added for the response, from `modulation_corrections`; the frame may show more or less of them.
    period_px : float
        Rows a cycle.
    code : ContrastCode
        The pattern's.

    Returns
    -------
    (N,) float64
        rad; 0 where nothing tells.
    """
    ripples = np.vstack([code_ripples(code), corrections])
    half = max(1, round(period_px / 2))
    middle, above, below = region[half:-half], region[: -2 * half], region[2 * half :]
    inside = (middle > 0) & (middle == above) & (middle == below) & absolute[middle]
    # Every fourth row tells enough: another one from column to column, so that all phases are seen.
    inside &= np.add.outer(np.arange(inside.shape[0]), np.arange(inside.shape[1])) % 4 == 0
    if not inside.any():
        return np.zeros(ripples.shape[1])
    rows, columns = np.nonzero(inside)
    phases = [unwrapped[rows + offset, columns].astype(np.float64) for offset in (0, half, 2 * half)]
    last = ripples.shape[1] - 1
    places = [np.clip(np.rint(phase * (TABLED / (2 * np.pi))), 0, last).astype(int) for phase in phases]
    phases = [phase + corrections[place] for phase, place in zip(phases, places, strict=True)]
    # A smooth surface hardly bends within a cycle; what it bends has nothing to do with the code.
    bend = phases[0] - 2 * phases[1] + phases[2]
    smooth = np.abs(bend) < _MAX_BEND
    if not smooth.any():
        return np.zeros(ripples.shape[1])
    first, here, second = (ripples[:, place[smooth]] for place in places)
    expected = first - 2 * here + second
    doubt = np.mean(bend[smooth] ** 2) / _USUAL_SHARES**2
    shares = np.linalg.solve(expected @ expected.T + np.diag(doubt + 1e-12), expected @ bend[smooth])
    return np.asarray(shares @ ripples)
