"""The effect of a coded pattern's changing contrast on the phase, and its correction (`docs/coded_pattern.md`).

Response and contrast: what the response adds to the phase, in its third harmonic, goes with the contrast. Blur weakens
the fringe's upper sideband more than its lower one, which turns a change of the modulation into one of the phase: by
(2 pi s)^2 / (2 pi) of its logarithm's slope, for a Gaussian of s cycles. And what the balance's window passes of the
fringe where the contrast changes within it turns the colours, and the phase with them. A frame's phases show how much
of each there is: a smooth surface hardly bends within a cycle.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from pipeline.contrast_code import CYCLES, ContrastCode
from pipeline.orders.stripe_columns import StripeColumns
from tikernels.arrays import F32, I32
from tikernels.launching import constant
from tikernels.order_evidence.modulation_correction import NODE_PX, TABLED, CodeRipples, measure_bends
from tikernels.phase.balance_window import SIGMA_ACROSS

# Where the phase bends by more (rad) within a cycle, the surface does.
_MAX_BEND = 0.3
# How much of the ripples is usual, as a standard deviation: shares of the contrast's effect on the response and of what
# the window passes, and rad for blur.
_USUAL_SHARES = np.array([0.3, 0.03, 0.3])
# The modulation's slope is taken over so many cycles to either side: blur rounds the tips of the code off.
_SLOPE_REACH = 0.2
# The balance's window is computed to this many cycles on either side.
_WINDOWS = 4


@cache
def code_ripples(code: ContrastCode) -> npt.NDArray[np.float32]:
    """Return the table of `CodeRipples`, (N, places, 3)."""
    cycles = np.arange(TABLED * (CYCLES - 1) + 1)[:, None] / TABLED
    along = code.places_px
    low, here, high = (code.modulation(cycles + reach, along) for reach in (-_SLOPE_REACH, 0, _SLOPE_REACH))
    deviations = here / (1 - here) / code.usual - 1
    slopes = (high - low) / (2 * _SLOPE_REACH * here)
    # The window is wider along the stripe than a repeat of the code.
    reach = _WINDOWS * TABLED
    around = code.modulation(np.arange(-reach, len(cycles) + reach)[:, None] / TABLED, along)
    window = np.arange(-reach, reach + 1) / TABLED
    weight = np.exp(-0.5 * (window / SIGMA_ACROSS) ** 2)
    contrast = (around / (1 - around)).mean(axis=1)
    passed = np.convolve(contrast, weight / weight.sum() * np.sin(2 * np.pi * window), "valid")
    shapes = (deviations, slopes, np.broadcast_to(passed[:, None], slopes.shape))
    return constant(np.ascontiguousarray(np.stack(shapes, axis=-1), np.float32))


def measure_ripples(
    raw: F32,
    unwrapped: F32,
    region: I32,
    known: npt.NDArray[np.bool_],
    *,
    within: npt.NDArray[np.float32],
    period_px: float,
    code: ContrastCode,
    columns: StripeColumns | None,
) -> CodeRipples:
    """Return what a frame shows of the code's ripples, by how its phase bends within cycles.

    Parameters
    ----------
    raw : (H, W) float32
        rad, the phase before it is smoothed.
    unwrapped : (H, W) float32
        rad, absolute.
    region : (H, W) int32
        Number of each pixel's region; 0 outside.
    known : (regions + 1,) bool
        True where a region's orders are absolute.
    within : (2, bins + 1) float32
        See `CodeRipples`.
    period_px : float
        Rows per cycle.
    code : ContrastCode
        The pattern's.
    columns : StripeColumns, optional
        Projector columns of places; a code that changes along the stripe needs them.
    """
    table = code_ripples(code)
    nodes = np.zeros((raw.shape[0] // NODE_PX + 2, raw.shape[1] // NODE_PX + 2, 4), np.float32)
    if code.cell_px is not None and columns is not None:
        nodes = columns.nodes / np.float32(code.repeats_px)
    nothing = CodeRipples(table, within, np.zeros(3, np.float32), nodes)
    moments = measure_bends(raw, unwrapped, region, known, nothing, max(1, round(period_px / 2)), _MAX_BEND)
    count, bends, expected = moments[0, 0], moments[2:, 1], moments[2:, 2:]
    if count == 0:
        return nothing
    # A smooth surface does not bend, and what it bends has nothing to do with the code.
    doubt = moments[1, 1] / count / _USUAL_SHARES**2
    shares = np.linalg.solve(expected + np.diag(doubt + 1e-12), bends)
    return nothing._replace(shares=(np.array([1.0, 0, 0]) - shares).astype(np.float32))
