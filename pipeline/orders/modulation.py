"""What a coded pattern's changing contrast does to the phase, and what undoes it (`docs/coded_pattern.md`).

Response and contrast: what the response adds to the phase, in its third harmonic, goes with the contrast. Blur weakens
the fringe's upper sideband more than its lower one, which turns a change of the modulation into one of the phase: by
(2 pi s)^2 / (2 pi) of its logarithm's slope, for a Gaussian of s cycles. And what the balance's window passes of the
fringe where the contrast changes within it turns the colours, and the phase with them. How much of each there is, a
frame's phases tell: a smooth surface hardly bends within a cycle.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

from pipeline.contrast_code import CYCLES, ContrastCode
from pipeline.orders.stripe_columns import StripeColumns, column_at
from tikernels.order_evidence.modulation_correction import NODE_PX, TABLED, CodeRipples
from tikernels.phase.balance_window import SIGMA_ACROSS

# Where the phase bends by more (rad) within a cycle, the surface does.
_MAX_BEND = 0.3
# How much of the ripples is usual, as a standard deviation: shares of what the contrast makes of the response and of
# what the window passes, and rad for blur.
_USUAL_SHARES = np.array([0.3, 0.03, 0.3])
# The modulation's slope is taken over so many cycles to either side: blur rounds the tips of the code off.
_SLOPE_REACH = 0.2
# The balance's window is computed to this many cycles on either side.
_WINDOWS = 4
# Of the frame's pixels every sixteenth column tells enough, and every fourth row, another one from column to column.
_EVERY_COLUMN, _EVERY_ROW = 16, 4


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
    return np.ascontiguousarray(np.stack(shapes, axis=-1), np.float32)


def measure_ripples(
    raw: npt.NDArray[np.float32],
    unwrapped: npt.NDArray[np.float32],
    region: npt.NDArray[np.int32],
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
        Whether a region's orders are absolute.
    within : (2, bins + 1) float32
        See `CodeRipples`.
    period_px : float
        Rows a cycle.
    code : ContrastCode
        The pattern's.
    columns : StripeColumns, optional
        Where places look; a code that changes along the stripe needs them.
    """
    table = code_ripples(code)
    nodes = np.zeros((raw.shape[0] // NODE_PX + 2, raw.shape[1] // NODE_PX + 2, 4), np.float32)
    if code.cell_px is not None and columns is not None:
        nodes = columns.nodes / np.float32(code.repeats_px)
    nothing = CodeRipples(table, within, np.zeros(3, np.float32), nodes)
    half = max(1, round(period_px / 2))
    sampled = region[:, ::_EVERY_COLUMN]
    middle, above, below = sampled[half:-half], sampled[: -2 * half], sampled[2 * half :]
    inside = (middle > 0) & (middle == above) & (middle == below) & known[middle]
    inside &= np.add.outer(np.arange(inside.shape[0]), np.arange(inside.shape[1])) % _EVERY_ROW == 0
    rows, places = np.nonzero(inside)
    places *= _EVERY_COLUMN
    if len(rows) == 0:
        return nothing
    terms = np.zeros((len(rows), 4), np.float32)
    if code.cell_px is not None and columns is not None:
        terms = columns.terms(np.column_stack([rows + half, places]))
    edges = np.linspace(-0.5, 0.5, within.shape[1])
    seen, shapes = [], []
    for offset in (0, half, 2 * half):
        here = rows + offset, places
        smooth = unwrapped[here].astype(np.float64)
        # The raw phase, in the smoothed one's cycle.
        seen.append(smooth + np.remainder(raw[here] - smooth + np.pi, 2 * np.pi) - np.pi)
        cycles = smooth / (2 * np.pi)
        place = code.place_at(np.nan_to_num(column_at(terms, cycles)))
        ripples = table[np.clip(np.rint(cycles * TABLED), 0, len(table) - 1).astype(int), place].T
        linear, square = (np.interp(cycles, edges, row, period=1) for row in within)
        shapes.append(np.stack([ripples[0] * (linear + (2 + ripples[0]) * square), *ripples[1:]]))
    bend = seen[0] - 2 * seen[1] + seen[2]
    expected = shapes[0] - 2 * shapes[1] + shapes[2]
    # What the response's correction lacks is known, but for a share; a smooth surface does not bend, and what it bends
    # has nothing to do with the code.
    left = bend + expected[0]
    smooth = np.abs(left) < _MAX_BEND
    if not smooth.any():
        return nothing
    left, expected = left[smooth], expected[:, smooth]
    doubt = np.mean(left**2) / _USUAL_SHARES**2
    shares = np.linalg.solve(expected @ expected.T + np.diag(doubt + 1e-12), expected @ left)
    return nothing._replace(shares=(np.array([1.0, 0, 0]) - shares).astype(np.float32))
