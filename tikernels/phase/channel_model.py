"""The expected value of each channel of a pixel, given its phase: the surface's light, with all that bends it.

    C_i = s A_i t_i(phi) + B_i

t_i is one cycle of channel i (`channel_template.py`), the same all over the frame: projector response, crosstalk and
lateral colour are in it, whatever they are, because it is read off the frame itself. A_i, the surface's colour, and
B_i, the ambient light that it sends back, change slowly and are fitted around every node of a coarse grid; s, the
pixel's own brightness, is free. Where the pixel turns away from the projector the fringe fades and the ambient light
stays: only a model with B_i knows.

Everything is fitted by linear least squares to the samples of `color_balance.py`, whose phase is the arctangent's,
equalised. With the phase given, s t_i is linear in the template's numbers; s itself follows from the channels' mean.
With the template, A_i and B_i are a straight line through channel against s t_i, over the balance window. Where the
window is cut off, at the edge of a surface or of the image, part of the fringe passes it, and the line is bent with it:
there A_i and B_i are those of the nodes around, whose windows are complete. The frame determines which share of the
mean background is ambient light: its modulation is proportional to the projector's light, its background is not, so a
straight line of one over the other crosses zero where only ambient light is left.

The fit that takes phases from a frame's own intensities and intensities from phases, alternating, is that of Z. Wang
and B. Han, Advanced iterative algorithm for phase extraction of randomly phase-shifted interferograms, Optics Letters
29, 2004, doi:10.1364/OL.29.001671; one turn is enough here.
"""

from enum import IntEnum

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array1, F32Array2, F32Array3, I32Array2, f32, i32, ti, u1, vec3
from tikernels.arrays import F32
from tikernels.lanes import LANES, float_lanes
from tikernels.launching import constant, kernel
from tikernels.phase.channel_template import (
    HARMONICS,
    TERMS,
    cycle_at,
    load_harmonics,
    sharpened_cycle_and_slope,
    sharpening_factors,
    sharpening_of,
    template_mismatch,
    waves_of,
)
from tikernels.phase.color_balance import Gains, WindowSum, gain_at, sample_at, shows_fringe
from tikernels.phase.crosstalk import Crosstalk, weighed_vector
from tikernels.phase.equalization import BINS, place_in_cycle
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.fringe_sharpness import TILES, FringeSharpness, equalized_at
from tikernels.phase.phase_vector import TINY, arctangent, channel_mean, matrix_of, modulation_of
from tikernels.phase.wrapped_phase import NO_PHASE, has_phase
from tikernels.strips import SPREAD, STRIP, color_of, lanes_of_colors, set_color, strip_at, strip_count

# Places of a symmetric matrix' upper triangle, row by row.
_UPPER = tuple((a, b) for a in range(TERMS) for b in range(a, TERMS))
_CORNERS, _HALF = len(_UPPER), len(_UPPER) // 2
#: The template is fitted to every fourth sample of each row: a fringe of 12 px that runs along the rows shows twelve
# phases, and nine numbers per channel need most of them.
EVERY = 4
#: What is known of the template beforehand weighs as much as this many samples: nothing where there is a surface.
PRIOR_SAMPLES = 30
# Per-channel corrections beyond a factor of two are a fit gone wrong, at a speck of a few samples.
_MIN_FACTOR, _MAX_FACTOR = 0.5, 2.0
# A node speaks for itself as far as less than this share of its window is empty: a window that ends 2.5 of its standard
# deviations away is that empty, and passes 0.003 of the fringe; one that ends in its middle passes 0.15.
_EMPTY = 0.006
# Turns of fitting, at most, while the fringe is found to be sharper here than there.
_FOCUS_TURNS = 4


class _Shared(IntEnum):
    """Columns of what a node's neighbours may take over."""

    COLOR = 0  # A
    AMBIENT = 3  # B
    WEIGHT = 6  # that they have


_SHARED = _Shared.WEIGHT + 1


class _Moment(IntEnum):
    """Columns of what `recover_samples_kernel` sums up over the samples."""

    COUNT = 0
    MODULATION = 1
    BACKGROUND = 2
    SQUARE = 3  # of the background
    PRODUCT = 4


sample_moments = ti.types.matrix(len(_Moment), LANES, ti.f32)


class LineSum(IntEnum):
    """Columns of what the straight lines of A and B are drawn through: all but the last have three channels."""

    MODEL = 0  # what the channel should be, s t_i
    SQUARE = 3  # its square
    SEEN = 6  # what the channel is
    PRODUCT = 9  # both, multiplied
    COUNT = 12  # of the samples


_LINE_SUMS = LineSum.COUNT + 1
line_sums = ti.types.matrix(_LINE_SUMS, LANES, ti.f32)


class ChannelModel:
    """The model of one frame, and the buffers to fit it, for the grid of `gains`."""

    def __init__(self, gains: Gains) -> None:
        #: What the frame's samples are balanced by.
        self.gains = gains
        height, columns = int(gains.samples.shape[0]), int(gains.samples.shape[1])
        blocks, grid = gains.window.blocks, gains.window.grid
        #: (H, Wb, 3) the samples times their gains, levels; kept next to them, so that a frame may be fitted twice.
        self.balanced = runtime.empty((height, columns, 3), np.float32)
        #: (H, Wb) rad, the samples' bare phase; NO_PHASE where there is none.
        self.phases = runtime.empty((height, columns), np.float32)
        self._histogram = runtime.empty((TILES**2, BINS), np.int32)
        strips = height * -(-columns // LANES)
        self._moments = runtime.empty((strips, len(_Moment)), np.float32)
        template_strips = height * -(-columns // (EVERY * STRIP))
        self._normal = runtime.empty((template_strips, _CORNERS + 3 * TERMS + 1), np.float32)
        self._sums = runtime.empty((*blocks, _LINE_SUMS), np.float32)
        self._half = runtime.empty((*grid, _LINE_SUMS), np.float32)
        self._smooth = runtime.empty((*grid, _LINE_SUMS), np.float32)
        self._shared = runtime.empty((*blocks, _SHARED), np.float32)
        self._half_around = runtime.empty((*grid, _SHARED), np.float32)
        self._around = runtime.empty((*grid, _SHARED), np.float32)
        #: (Hg, Wg, 6) A and B of the channels that the gains belong to, in levels where s is in levels.
        self.nodes = runtime.empty((*grid, _Shared.WEIGHT), np.float32)
        #: (3, terms) t_i: 1, cosines, sines.
        self.template = np.zeros((3, TERMS), np.float32)
        #: Sharpness of the fringe around every node, relative to the template.
        self.sharpness = FringeSharpness(blocks, grid, (gains.height / gains.period_px, gains.width / gains.period_px))
        #: How far the template's fundamentals are from those that crosstalk and lateral colour make, as a fraction.
        self.mismatch = np.nan
        #: The samples' mean modulation over their mean background; NaN without samples.
        self.contrast = np.nan
        # Which share of the background is ambient light.
        self._share = 0.0

    def recover(self, crosstalk: Crosstalk, levels: FrameLevels) -> npt.NDArray[np.int64]:
        """Balance the samples that the gains were measured from, find their bare phase, and what is ambient light.

        Parameters
        ----------
        crosstalk : Crosstalk
            Crosstalk of the measurement.
        levels : FrameLevels
            Clipped samples, and those with less modulation, have no phase.

        Returns
        -------
        (tiles, bins) int64
            Counts of the bare phase in each bin of the cycle from -pi to pi, by tile of the image. A sample
            with one clipped channel counts: else the phases at which that channel is bright would be missing.
        """
        gains = self.gains
        samples = (gains.samples, gains.gains, gains.sums, gains.spacing_px, crosstalk.weights)
        self._histogram.fill(0)
        out = (self._histogram, self.balanced, self.phases, self._moments)
        recover_samples_kernel(*samples, levels.modulation, levels.reliable, levels.clipped, *out)
        moments = runtime.to_host(self._moments)  # synchronises
        count, modulation, background, square, product = moments.sum(axis=0, dtype=np.float64)
        # Over the frame the modulation is proportional to what the projector sends, the background has the ambient
        # light in it, too.
        self.contrast = float(modulation / background) if background > 0 else np.nan
        self._share = 0.0
        if count > 0:
            variance, covariance = square - background**2 / count, product - background * modulation / count
            if covariance > 0:
                self._share = max(0.0, float(1 - modulation * variance / (covariance * background)))
        return runtime.to_host(self._histogram).astype(np.int64)  # synchronises

    def fit(
        self,
        crosstalk: Crosstalk,
        correction: F32,
        known: F32,
        contrast_doubt: float,
        *,
        fixed: bool = False,
    ) -> None:
        """Fit the template to the samples that have been recovered, then A and B around every node.

        Parameters
        ----------
        crosstalk : Crosstalk
            Crosstalk of the measurement.
        correction : (bins + 1,) float32
            rad, to be added to the bare phase; see `equalization.correction_table`.
        known : (3, terms) float32
            The template as far as it is known: it helps to determine the samples' brightness, and stays where there are
            hardly any.
        contrast_doubt : float
            Standard deviation of a pixel's contrast about what its neighbourhood shows, as a fraction.
        fixed : bool
            True if the template is known for sure, and not fitted.

        Raises
        ------
        ShapeError
            A shape or dtype is another one.
        """
        correction = checks.read_array("correction", correction, (None,), np.float32)
        known = checks.read_array("known", known, (3, TERMS), np.float32)
        gains, sharpness = self.gains, self.sharpness
        self.nodes = runtime.empty(tuple(self.nodes.shape), np.float32)  # a frame keeps those that it was fitted
        sharpness.forget()
        if fixed:
            self.template = runtime.to_host(known)
            self.mismatch = template_mismatch(self.template, crosstalk.weights)
        for _ in range(_FOCUS_TURNS):
            if not fixed:
                self._fit_template(crosstalk.weights, correction, known)
            self._fit_nodes(correction)
            seen = (gains.samples, self.phases, correction)
            if not sharpness.refine(*seen, self.template, self.nodes, gains.window.rows, contrast_doubt):
                break

    def _fit_template(self, weights: npt.NDArray[np.float32], correction: F32, known: F32) -> None:
        """Fit one cycle of the channels to the samples."""
        gains, samples = self.gains, (self.balanced, self.phases, correction)
        light = (gains.smooth, self.sharpness.values, gains.spacing_px, self._share)
        sum_template_kernel(*samples, weights, known, *light, self._normal)
        normal = runtime.to_host(self._normal).sum(axis=0, dtype=np.float64)  # synchronises
        gram = np.zeros((TERMS, TERMS))
        gram[tuple(np.transpose(_UPPER))] = normal[:_CORNERS]
        gram += np.triu(gram, 1).T
        weight = max(gram[0, 0], TINY) / max(normal[-1], 1)
        prior = PRIOR_SAMPLES * weight * np.array([1.0] + [0.5] * (2 * HARMONICS))
        gram += np.diag(prior)
        right = normal[_CORNERS:-1].reshape(TERMS, 3) + prior[:, None] * runtime.to_host(known).T
        solved = np.linalg.solve(gram, right)
        self.template = constant(np.ascontiguousarray((solved / solved[0]).T, np.float32))
        self.mismatch = template_mismatch(self.template, weights)

    def _fit_nodes(self, correction: F32) -> None:
        """Fit A and B around every node."""
        gains, samples = self.gains, (self.balanced, self.phases, correction)
        light = (gains.smooth, self.sharpness.values, gains.window.rows, self._share)
        sum_model_kernel(*samples, self.template, *light, self._sums)
        gains.window.smooth(self._sums, self._half, self._smooth)
        fit_nodes_kernel(self._smooth, gains.smooth, gains.gains, self._share, gains.window.samples, self._shared)
        gains.window.smooth(self._shared, self._half_around, self._around)
        settle_nodes_kernel(self._shared, self._around, self.nodes)


@ti.func
def is_lit(light: vec3, min_intensity: f32, clipped: f32) -> u1:
    """Return whether a pixel is bright enough, and not two of its channels are clipped.

    Leaving out whatever has a single clipped channel would leave out the phases at which it is bright.
    """
    low, high = ti.min(light.x, light.y), ti.max(light.x, light.y)
    second_brightest = ti.max(low, ti.min(high, light.z))
    return (channel_mean(light) > min_intensity) & (second_brightest < clipped)


@kernel
def recover_samples_kernel(
    samples: F32Array3,  # (H, Wb, 3) the channels that the gains belong to, levels
    gains: F32Array3,  # (Hg, Wg, 3)
    sums: F32Array3,  # (Hb, Wb, 8) see `WindowSum`
    spacing_px: i32,
    phase_weights: F32Array2,  # (3, 3)
    min_modulation: f32,  # levels
    reliable: f32,  # modulation of a sample that shows which share of the light is ambient, levels
    max_level: f32,
    out_histogram: I32Array2,  # (tiles, bins) how often each phase is seen, to be added to
    out_balanced: F32Array3,  # (H, Wb, 3) the same, times their gains
    out_phase: F32Array2,  # (H, Wb) rad; NO_PHASE where there is none
    out_moments: F32Array2,  # (strips, 5) see `_Moment`
):
    """Balance the samples, take their phase and count it, and sum up each strip's modulation and background."""
    bins = out_histogram.shape[1]
    for strip in range(samples.shape[0] * strip_count(samples.shape[1], LANES)):
        y, first, count = strip_at(strip, samples.shape[1], LANES)
        weights = matrix_of(phase_weights)
        light, color_gains = lanes_of_colors(0.0), lanes_of_colors(1.0)
        angle, place, moments = float_lanes(0.0), float_lanes(0.0), sample_moments(0.0)
        tile = y * TILES // samples.shape[0] * TILES + first * TILES // samples.shape[1]
        for k in range(count):
            x = (first + k) * spacing_px + spacing_px // 2
            fringed = ti.select(shows_fringe(sums, spacing_px // 2, y, first + k), 1.0, 0.0)
            set_color(light, k, fringed * sample_at(samples, y, first + k))
            set_color(color_gains, k, gain_at(gains, spacing_px, y, x))
        for k in range(LANES):
            seen, gain = color_of(light, k), color_of(color_gains, k)
            vector = weighed_vector(seen, gain, weights)
            modulation, background = modulation_of(vector), vector.z
            whole = (seen.max() < max_level) & (k < count)
            bare = arctangent(vector.y, vector.x)
            angle[k] = ti.select(whole & (modulation > min_modulation), bare, NO_PHASE)
            counts = is_lit(seen, 0.0, max_level) & (modulation > reliable) & (k < count)
            place[k] = ti.select(counts, place_in_cycle(bare, bins), -1.0)
            counted = ti.select(whole & (modulation > reliable), 1.0, 0.0)
            moments[_Moment.COUNT, k] = counted
            moments[_Moment.MODULATION, k] = counted * modulation
            moments[_Moment.BACKGROUND, k] = counted * background
            moments[_Moment.SQUARE, k] = counted * background * background
            moments[_Moment.PRODUCT, k] = counted * background * modulation
            set_color(light, k, seen * gain)
        for k in range(count):
            out_phase[y, first + k] = angle[k]
            if place[k] >= 0.0:
                out_histogram[tile, ti.min(ti.cast(place[k], i32), bins - 1)] += 1
            for c in ti.static(range(3)):
                out_balanced[y, first + k, c] = light[c, k]
        for n in ti.static(range(len(_Moment))):
            moment = 0.0
            for k in range(LANES):
                moment += moments[n, k]
            out_moments[strip, n] = moment


@ti.func
def ambient_at(smooth: F32Array3, spacing_px: i32, share: f32, y: i32, x: i32) -> f32:
    """Ambient light near a pixel: the frame's share of the mean background there."""
    i = ti.min(y // spacing_px, smooth.shape[0] - 1)
    j = ti.min(x // spacing_px, smooth.shape[1] - 1)
    return share * smooth[i, j, WindowSum.BACKGROUND] / ti.max(smooth[i, j, WindowSum.SAMPLES], TINY)


@kernel
def sum_template_kernel(
    samples: F32Array3,  # (H, Wb, 3) balanced, levels
    phases: F32Array2,  # (H, Wb) rad
    correction: F32Array1,  # (bins + 1,) rad
    phase_weights: F32Array2,  # (3, 3)
    known: F32Array2,  # (3, terms)
    smooth: F32Array3,  # (Hg, Wg, 8) see `WindowSum`
    sharpness: F32Array2,  # (Hg, Wg) see `fringe_sharpness.py`
    spacing_px: i32,
    share: f32,
    out_normal: F32Array2,  # (strips, terms) the normal equations: upper triangle, right sides; then the samples
):
    """Sum up the normal equations of the template's least squares, strip by strip."""
    columns = strip_count(samples.shape[1], EVERY)
    for t in range(SPREAD * samples.shape[0] * strip_count(columns, STRIP)):
        if t % SPREAD > 0:
            continue
        strip = t // SPREAD
        y, first, count = strip_at(strip, columns, STRIP)
        # The upper triangle of the symmetric equations, row by row, and the right sides.
        # Taichi compiles vectors of up to 32 numbers well.
        upper, lower = ti.Vector.zero(f32, _HALF), ti.Vector.zero(f32, _CORNERS - _HALF)
        right, asked = ti.Matrix.zero(f32, TERMS, 3), 0.0
        background_weights = vec3(phase_weights[2, 0], phase_weights[2, 1], phase_weights[2, 2])
        for number in range(first, first + count):
            # Another one from row to row, so that all columns are sampled.
            j = ti.min(number * EVERY + y % EVERY, samples.shape[1] - 1)
            if has_phase(phases[y, j]):
                ambient = ambient_at(smooth, spacing_px, share, y, j * spacing_px)
                sharper = sharpness[ti.min(y // spacing_px, sharpness.shape[0] - 1), j]
                factors = sharpening_factors(sharper)
                waves = waves_of(equalized_at(phases[y, j], correction, factors[2]))
                waves *= factors
                light = sample_at(samples, y, j) - ambient
                asked += 1.0
                # Each sample with its own brightness: bright ones count more, as they are more certain. The background
                # shows it at any phase, apart from what is known of the response and lateral colour.
                waves *= light.dot(background_weights) / cycle_at(known, waves).dot(background_weights)
                for place in ti.static(range(_HALF)):
                    upper[place] += waves[_UPPER[place][0]] * waves[_UPPER[place][1]]
                for place in ti.static(range(_HALF, _CORNERS)):
                    lower[place - _HALF] += waves[_UPPER[place][0]] * waves[_UPPER[place][1]]
                right += waves.outer_product(light)
        for place in ti.static(range(_HALF)):
            out_normal[strip, place] = upper[place]
        for place in ti.static(range(_HALF, _CORNERS)):
            out_normal[strip, place] = lower[place - _HALF]
        for a in ti.static(range(TERMS)):
            for k in ti.static(range(3)):
                out_normal[strip, _CORNERS + 3 * a + k] = right[a, k]
        out_normal[strip, _CORNERS + 3 * TERMS] = asked


@kernel
def sum_model_kernel(
    samples: F32Array3,  # (H, Wb, 3) balanced, levels
    phases: F32Array2,  # (H, Wb) rad
    correction: F32Array1,  # (bins + 1,) rad
    template: F32Array2,  # (3, terms)
    smooth: F32Array3,  # (Hg, Wg, 8) see `WindowSum`
    sharpness: F32Array2,  # (Hg, Wg) see `fringe_sharpness.py`
    rows: i32,
    share: f32,
    out_sums: F32Array3,  # (Hb, Wb, 13) see `LineSum`
):
    """Sum up, block by block, what the straight lines of A and B are drawn through."""
    height = samples.shape[0]
    for t in range(SPREAD * out_sums.shape[0] * strip_count(out_sums.shape[1], LANES)):
        if t % SPREAD > 0:
            continue
        i, first, count = strip_at(t // SPREAD, out_sums.shape[1], LANES)
        harmonics = load_harmonics(template)
        light, phase, ambient, sums = lanes_of_colors(0.0), float_lanes(0.0), float_lanes(0.0), line_sums(0.0)
        sharper = lanes_of_colors(1.0)
        for k in range(count):
            ambient[k] = ambient_at(smooth, 2 * rows, share, i * rows, (first + k) * 2 * rows)
            set_color(sharper, k, sharpening_of(sharpness[ti.min(i // 2, sharpness.shape[0] - 1), first + k]))
        for y in range(i * rows, ti.min((i + 1) * rows, height)):
            for k in range(count):
                set_color(light, k, sample_at(samples, y, first + k))
                # Beyond the cycle where there is no phase.
                phase[k] = NO_PHASE
                if has_phase(phases[y, first + k]):
                    phase[k] = equalized_at(phases[y, first + k], correction, sharper[0, k])
            for k in range(LANES):
                counts = ti.select(has_phase(phase[k]) & (k < count), 1.0, 0.0)
                cycle, _ = sharpened_cycle_and_slope(harmonics, counts * phase[k], color_of(sharper, k))
                seen = color_of(light, k)
                expected = counts * (seen - ambient[k]).dot(cycle) / cycle.dot(cycle) * cycle
                sums[LineSum.COUNT, k] += counts
                for c in ti.static(range(3)):
                    sums[LineSum.MODEL + c, k] += expected[c]
                    sums[LineSum.SQUARE + c, k] += expected[c] * expected[c]
                    sums[LineSum.SEEN + c, k] += counts * seen[c]
                    sums[LineSum.PRODUCT + c, k] += expected[c] * seen[c]
        for k in range(count):
            for c in ti.static(range(_LINE_SUMS)):
                out_sums[i, first + k, c] = sums[c, k]


@kernel
def fit_nodes_kernel(
    sums: F32Array3,  # (Hg, Wg, 13) see `LineSum`, over the window
    smooth: F32Array3,  # (Hg, Wg, 8) see `WindowSum`
    gains: F32Array3,  # (Hg, Wg, 3)
    share: f32,
    whole: f32,  # samples in a window that nothing cuts off
    out_shared: F32Array3,  # (Hb, Wb, 7) at the two blocks around a node: A and B times their weight, and that
):
    """Draw a straight line through what each channel is over what it should be, around every node."""
    for node in range(sums.shape[0] * sums.shape[1]):
        i, j = node // sums.shape[1], node % sums.shape[1]
        ambient = ambient_at(smooth, 1, share, i, j)
        count = sums[i, j, LineSum.COUNT]
        empty = ti.max(1.0 - count / whole, 0.0)
        weight = _EMPTY * _EMPTY / (_EMPTY * _EMPTY + empty * empty)
        for k in ti.static(range(3)):
            model, square = sums[i, j, LineSum.MODEL + k], sums[i, j, LineSum.SQUARE + k]
            seen, product = sums[i, j, LineSum.SEEN + k], sums[i, j, LineSum.PRODUCT + k]
            determinant = count * square - model * model
            factor, left = 1.0, ambient
            if determinant > 0.0:
                factor = ti.min(ti.max((count * product - model * seen) / determinant, _MIN_FACTOR), _MAX_FACTOR)
                left = (seen - factor * model) / count
            for block in range(2 * i, ti.min(2 * i + 2, out_shared.shape[0])):
                out_shared[block, j, _Shared.COLOR + k] = weight * factor / gains[i, j, k]
                out_shared[block, j, _Shared.AMBIENT + k] = weight * left / gains[i, j, k]
                out_shared[block, j, _Shared.WEIGHT] = weight


@kernel
def settle_nodes_kernel(
    shared: F32Array3,  # (Hb, Wb, 7) see `fit_nodes_kernel`
    around: F32Array3,  # (Hg, Wg, 7) the same, over the window
    out_nodes: F32Array3,  # (Hg, Wg, 6) A and B
):
    """Take the nodes whose windows are whole as they are, and the others as those around them are."""
    for node in range(out_nodes.shape[0] * out_nodes.shape[1]):
        i, j = node // out_nodes.shape[1], node % out_nodes.shape[1]
        weight, total = shared[2 * i, j, _Shared.WEIGHT], around[i, j, _Shared.WEIGHT]
        for k in ti.static(range(_Shared.WEIGHT)):
            own, theirs = shared[2 * i, j, k] / ti.max(weight, TINY), around[i, j, k] / ti.max(total, TINY)
            out_nodes[i, j, k] = theirs + weight * (own - theirs)
