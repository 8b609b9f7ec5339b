"""Equalise the distribution of the phase, which undoes the projector's response without knowing it.

Over many cycles a surface shows every phase equally often; a response that is not linear crowds them (section 3.2 of
Je, Lee and Park 2004). The cumulative distribution, interpolated, is the map that spreads them again. Its free
constant is set so that the mean correction is zero; otherwise the whole phase would shift with the branch cut.

The assumption fails where few cycles are in view. But a response is the same everywhere, and what a surface shows too
often is not: histograms of tiles of the image distinguish the two, harmonic by harmonic.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array1, F32Array2, I32Array2, Static, f32, i32, ti
from tikernels.arrays import F32, Mask
from tikernels.errors import ShapeError
from tikernels.lanes import LANES
from tikernels.launching import constant, kernel
from tikernels.phase.phase_vector import PI, TINY, wrap
from tikernels.phase.wrapped_phase import has_phase, mark_no_phase_kernel

#: Bins of the cycle that phases are counted in.
BINS = 256


class MeasuredCorrection(NamedTuple):
    """Correction to a frame's phases, determined from their distribution."""

    spectrum: npt.NDArray[np.complex128]
    """(bins / 2 + 1,) of the correction at the bins' lower edges, rad."""
    variance: npt.NDArray[np.float64]
    """(bins / 2 + 1,) of each harmonic; infinite where nothing is known."""
    counts: npt.NDArray[np.float64]
    """(bins,) how often a phase fell into each bin."""

    def beyond(self, expected: npt.NDArray[np.complex128] | float) -> npt.NDArray[np.complex128]:
        """Return what the spectrum has beyond an expected one, each harmonic weighed by its certainty (Wiener)."""
        rest = self.spectrum - expected
        power = np.maximum(np.abs(rest) ** 2, TINY)
        return np.asarray(rest * np.maximum(1 - self.variance / power, 0))

    def table(self, spectrum: npt.NDArray[np.complex128]) -> npt.NDArray[np.float32]:
        """Return (bins + 1,) float32: the correction with this spectrum, its mean over all counted phases zero, rad."""
        bins = len(self.counts)
        correction = np.zeros(bins + 1)
        correction[:-1] = np.fft.irfft(spectrum, bins)
        correction[-1] = correction[0]
        mean = self.counts @ (correction[1:] + correction[:-1]) / (2 * max(self.counts.sum(), 1))
        return constant(np.asarray(correction - mean, np.float32))


def resolved_harmonics(period_px: float) -> int:
    """Return how many harmonics of the cycle a fringe of this period (px) resolves: the next is the pixel grid."""
    return math.ceil(period_px) - 1


def measure_correction(
    histogram: npt.NDArray[np.float64 | np.int64], harmonics: int | None = None
) -> MeasuredCorrection:
    """Measure what is to be added to phases so that all are equally frequent.

    Parameters
    ----------
    histogram : (bins,) or (tiles, bins) numbers
        Counts of the wrapped phase in each bin of [-pi, pi], in the whole image or in each of its tiles, whose
        scatter determines the variance.
    harmonics : int, optional
        Nothing is known of harmonics beyond this one. A fringe of P pixels that runs along the pixel rows shows only P
        phases, which look like a distortion of harmonic P: keep it below P.
    """
    tiles = np.atleast_2d(histogram).astype(np.float64)
    counts = tiles.sum(axis=0)
    bins, total = len(counts), counts.sum()
    if total < bins:  # fewer do not make a distribution
        nothing = np.zeros(bins // 2 + 1)
        return MeasuredCorrection(nothing.astype(np.complex128), np.full(len(nothing), np.inf), counts)
    edges = np.linspace(-np.pi, np.pi, bins, endpoint=False)
    correction = 2 * np.pi * np.concatenate([[0.0], np.cumsum(counts)[:-1]]) / total - np.pi - edges
    spectrum = np.fft.rfft(correction)
    variance = np.abs(spectrum) ** 2 * _scatter(tiles)
    if harmonics is not None:
        variance[harmonics + 1 :] = np.inf
    return MeasuredCorrection(spectrum, variance, counts)


def correction_table(
    histogram: npt.NDArray[np.float64 | np.int64], harmonics: int | None = None
) -> npt.NDArray[np.float32]:
    """Return what to add to a phase, at the edges of the histogram's bins, by the histogram alone.

    Parameters
    ----------
    histogram, harmonics
        See `measure_correction`.

    Returns
    -------
    (bins + 1,) float32
        rad; zero where there are too few counts.
    """
    measured = measure_correction(histogram, harmonics)
    return measured.table(measured.beyond(0.0))


def _scatter(tiles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return by harmonic the variance of the mean of all (tiles, bins) over its square; 0 where there is only one."""
    totals = tiles.sum(axis=1)
    spectra, seen = np.fft.rfft(tiles[totals > 0], axis=1), totals[totals > 0]
    if len(seen) < 2:
        return np.zeros(spectra.shape[1])
    mean = spectra.sum(axis=0) / seen.sum()
    deviations = np.abs(spectra - seen[:, None] * mean) ** 2
    variance = deviations.sum(axis=0) / seen.sum() ** 2 * len(seen) / (len(seen) - 1)
    return np.asarray(variance / np.maximum(np.abs(mean) ** 2, TINY))


def modulation_tables(table: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return what of a correction changes with the modulation.

    What a response that is not linear adds to the phase, in the true phase's harmonics 3, 6 ..., is proportional to the
    modulation, its square ...; what crosstalk and gains leave is not.

    Parameters
    ----------
    table : (bins + 1,) float32
        rad to add to a measured phase, for the usual modulation.

    Returns
    -------
    (2, bins + 1) float32
        The harmonics 3 and 6 of the correction over the corrected phase, rad.
    """
    bins = len(table) - 1
    edges = np.linspace(-np.pi, np.pi, bins + 1)
    corrected = edges + table
    error = np.interp(edges, corrected[:-1], table[:-1], period=2 * np.pi)
    spectrum = np.fft.rfft(error[:-1])
    # Whatever is added to a phase moves it along the correction's slope.
    slope = 1 - np.gradient(error, edges[1] - edges[0])
    tables = np.zeros((2, bins + 1))
    for row, harmonic in enumerate((3, 6)):
        if harmonic < len(spectrum):
            alone = np.zeros_like(spectrum)
            alone[harmonic] = spectrum[harmonic]
            tables[row, :-1] = np.fft.irfft(alone, bins)
    tables[:, -1] = tables[:, 0]
    return (tables / np.maximum(slope, 0.2)).astype(np.float32)


@ti.func
def place_in_cycle(phase: f32, bins: i32) -> f32:
    """Return where a phase lies among the bins of a cycle, 0 at -pi."""
    return (phase + PI) * (ti.cast(bins, ti.f32) / (2.0 * PI))


@ti.func
def equalized(phase: f32, table: F32Array1) -> f32:
    """Add the interpolated correction to a phase in [-pi, pi]; the sum may lie a little beyond."""
    bins = table.shape[0] - 1
    place = place_in_cycle(phase, bins)
    low = ti.min(ti.max(ti.cast(place, ti.i32), 0), bins - 1)
    fraction = place - low
    return phase + table[low] + fraction * (table[low + 1] - table[low])


@ti.func
def equalized_lanes(phase: Static, table: F32Array1):
    """Return lanes of `equalized`."""
    bins = table.shape[0] - 1
    place = place_in_cycle(phase, bins)
    low = ti.min(ti.max(ti.floor(place), 0.0), ti.cast(bins - 1, ti.f32))
    before, after = 0.0 * phase, 0.0 * phase
    for k in range(phase.n):
        number = ti.cast(low[k], ti.i32)
        before[k], after[k] = table[number], table[number + 1]
    return phase + before + (place - low) * (after - before)


@kernel
def measure_distribution_kernel(
    phase: F32Array2,  # (H, W) rad; NO_PHASE where nothing counts
    step: i32,  # px between two samples along a row
    out_histogram: I32Array2,  # (copies, bins), to be added to: threads seldom wait for each other
):
    height, width = phase.shape[0], phase.shape[1]
    bins = out_histogram.shape[1]
    columns = (width + step - 1) // step
    for sample in range(height * columns):
        y, x = sample // columns, (sample % columns) * step
        if has_phase(phase[y, x]):
            place = ti.cast(place_in_cycle(phase[y, x], bins), ti.i32)
            out_histogram[y % out_histogram.shape[0], ti.min(ti.max(place, 0), bins - 1)] += 1


def measure_distribution(phase: F32, bins: int, step: int = 1) -> npt.NDArray[np.int64]:
    """Count how often a phase falls into each bin of the cycle.

    Parameters
    ----------
    phase : (H, W) float32
        rad in [-pi, pi]; NO_PHASE where nothing counts.
    bins : int
        Bins of the cycle.
    step : int
        px between two samples along a row.

    Returns
    -------
    (bins,) int64
        From -pi to pi.

    Raises
    ------
    ShapeError
        The shape or dtype is another one.
    """
    phase = checks.read_array("phase", phase, (None, None), np.float32)
    histogram = np.zeros((LANES, bins), np.int32)
    measure_distribution_kernel(phase, step, histogram)
    runtime.synchronize()
    return np.asarray(histogram.sum(axis=0), np.int64)


@kernel
def equalize_phase_kernel(
    wrapped_phase: F32Array2,  # (H, W) rad
    marked: F32Array2,  # (H, W) rad; NO_PHASE where nothing is to be corrected
    table: F32Array1,  # (bins + 1,) rad
    out: F32Array2,  # (H, W) rad
):
    for pixel in range(wrapped_phase.shape[0] * wrapped_phase.shape[1]):
        y, x = pixel // wrapped_phase.shape[1], pixel % wrapped_phase.shape[1]
        phase = wrapped_phase[y, x]
        if has_phase(marked[y, x]):
            phase = wrap(equalized(wrap(phase), table))
        out[y, x] = phase


def equalize_phase(
    wrapped_phase: F32, mask: Mask, bins: int = BINS, *, harmonics: int | None = None, out: F32 | None = None
) -> F32:
    """Spread the phases of the masked pixels evenly over the cycle.

    Parameters
    ----------
    wrapped_phase : (H, W) float32
        rad in [-pi, pi].
    mask : (H, W) bool or uint8
        Pixels bright enough to count, and to correct.
    bins : int
        Bins of the histogram, of which the table is interpolated.
    harmonics : int, optional
        Number of harmonics of the correction that are kept; see `correction_table`.
    out : (H, W) float32, optional
        Output array.

    Returns
    -------
    (H, W) float32
        rad in [-pi, pi]; unchanged outside the mask, where it is NaN, and everywhere if too few pixels count. The mean
        correction over the counted pixels is zero.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, bins is not at least 8, or `out` cannot be written.

    Examples
    --------
    >>> import numpy as np, tikernels
    >>> _ = tikernels.init("cpu")
    >>> true = np.linspace(-np.pi, np.pi, 9600, endpoint=False, dtype=np.float32).reshape(80, 120)
    >>> bent = true + np.float32(0.2) * np.sin(3 * true)
    >>> fixed = equalize_phase(bent, np.ones(bent.shape, bool))
    >>> error = np.angle(np.exp(1j * (fixed - true)))  # modulo a cycle
    >>> round(float(np.abs(bent - true).max()), 2), bool(np.abs(error).max() < 0.02)
    (0.2, True)
    """
    wrapped_phase = checks.read_array("wrapped_phase", wrapped_phase, (None, None), np.float32)
    shape = (int(wrapped_phase.shape[0]), int(wrapped_phase.shape[1]))
    mask = checks.read_mask("mask", mask, shape)
    if bins < 8:
        raise ShapeError(f"bins is {bins}: take 8 or more")
    out = checks.out_array("out", out, shape, np.float32)
    marked = runtime.empty(shape, np.float32)
    mark_no_phase_kernel(wrapped_phase, mask, marked)
    # Some hundred thousand samples pin the table down to a milliradian; more only cost time.
    histogram = measure_distribution(marked, bins, max(1, shape[0] * shape[1] // 2**18))
    equalize_phase_kernel(wrapped_phase, marked, correction_table(histogram, harmonics), out)
    return out
