"""Balance the colours locally, so that the surface's own colour does not bend the phase.

The camera's channel i sees r_i times what a neutral surface would send back, r_i changing slowly. Over a window that
averages the fringes out (section 3.1 of Je, Lee and Park, Color-phase analysis for sinusoidal structured light in rapid
range imaging, 2004), with C_i the channel and P_i that of a neutral surface,

    r_i = sum C_i / sum P_i,    gain_i = mean(r) / r_i.

A Gaussian window does so without the ripple that a box leaves when it is not a whole number of cycles. A first look
takes every P_i for the same. At the edge of a surface the window is one-sided and 13 % of the fringe passes it, so a
second look, which knows the phase by then, predicts P_i from it: the channels' waves with the pixel's background and
the frame's mean contrast. A third look gains less than 0.001 rad. The second look leaves out blocks of even light,
where nothing of the projector's falls: their phase is that of their colour and hardly changes across the stripes.
"""

from enum import IntEnum
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array2, F32Array3, Static, U8Array2, f32, i32, mat3, ti, vec3
from tikernels.arrays import F32, LevelsImage, Mask
from tikernels.errors import ShapeError
from tikernels.lanes import LANES
from tikernels.launching import kernel
from tikernels.phase.balance_window import BalanceWindow
from tikernels.phase.crosstalk import Crosstalk, unmixed
from tikernels.phase.frame_statistics import MIN_PERIOD_PX, FrameLevels
from tikernels.phase.phase_change import LEAST_CHANGE, SAMPLE
from tikernels.phase.phase_vector import TINY, channel_mean, color_at, matrix_of, modulation_of
from tikernels.phase.surfaces import neutral_light, shows_surface
from tikernels.raw.linearization import LEVEL_TYPES
from tikernels.strips import SPREAD, color_of, lanes_of_colors, set_color, strip_at, strip_count

# Whoever balances an image alone has chosen its pixels by the mask.
_ANYTHING_LIT = FrameLevels(white=1.0, read_noise=0.0, noise_gain=0.0, noise=0.0, intensity=TINY, modulation=TINY)
# Columns of the sums that determine it, one row of the image each; in the last row the first has the contrast itself.
_MODULATION, _BACKGROUND = range(2)
_CONTRAST = 0
# In even light two samples of a column, so many rows apart, have nearly the same phase (`LEAST_CHANGE`).
_TURN_ROWS = 2


class WindowSum(IntEnum):
    """Columns of what is summed up over the window."""

    SEEN = 0  # the three channels, levels
    PREDICTED = 3  # what the phase predicts of them, up to a factor
    BACKGROUND = 6  # of the balanced channels, levels
    SAMPLES = 7  # how many there are


_WINDOW_SUMS = WindowSum.SAMPLES + 1
window_sums = ti.types.matrix(_WINDOW_SUMS, LANES, ti.f32)


class Gains:
    """Per-channel gains on a coarse grid, and the buffers to measure them for one image size and period.

    Parameters
    ----------
    height, width : int
        The image's, stripes along the rows, px.
    period_px : float
        Camera px per cycle.
    """

    def __init__(self, height: int, width: int, period_px: float) -> None:
        self.height, self.width, self.period_px = height, width, period_px
        self.window = BalanceWindow(height, width, period_px)
        #: px between two nodes.
        self.spacing_px = self.window.spacing_px
        blocks, grid = self.window.blocks, self.window.grid
        #: (H, Wb, 3) of the channels that the gains belong to, levels; zero where it is too dark.
        self.samples = runtime.empty((height, blocks[1], 3), np.float32)
        #: (Hg, Wg, 8) over the window, see `WindowSum`.
        self.smooth = runtime.empty((*grid, _WINDOW_SUMS), np.float32)
        #: (Hg, Wg, 3) by node.
        self.gains = runtime.empty((*grid, 3), np.float32)
        #: (Hb, Wb, 8) by block, likewise; see `shows_fringe`.
        self.sums = runtime.empty((*blocks, _WINDOW_SUMS), np.float32)
        self._half = runtime.empty((*grid, _WINDOW_SUMS), np.float32)
        # The first look needs the channels alone.
        self._color_sums = runtime.empty((*blocks, 3), np.float32)
        self._color_half = runtime.empty((*grid, 3), np.float32)
        self._color_smooth = runtime.empty((*grid, 3), np.float32)
        self._contrast_sums = runtime.empty((-(-height // SAMPLE) + 1, 2), np.float32)

    def measure(self, image: LevelsImage, crosstalk: Crosstalk, levels: FrameLevels) -> None:
        """Measure the gains of one frame; see `balance_color`.

        Parameters
        ----------
        image : (H, W, 3) uint8, uint16 or float32
            Linear light, levels, stripes along the rows.
        crosstalk : Crosstalk
            The gains belong to a neutral surface's channels, before it is undone.
        levels : FrameLevels
            Darker pixels, and those with less modulation, show nothing of the colour.

        Raises
        ------
        ShapeError
            The image has another shape or dtype.
        """
        image = checks.read_array("image", image, (self.height, self.width, 3), *LEVEL_TYPES)
        rows, surfaces = self.window.rows, crosstalk.surfaces
        shown = (surfaces.unmixing, surfaces.ambient, surfaces.labels)
        _collect_samples_kernel(surfaces.mixed)(image, *shown, levels.intensity, rows, self.samples, self._color_sums)
        self.window.smooth(self._color_sums, self._color_half, self._color_smooth)
        find_gains_kernel(self._color_smooth, False, self.gains)
        matrices = (crosstalk.inverse, crosstalk.matrix, crosstalk.waves, crosstalk.inverse_waves)
        light = (self.samples, *matrices, self.gains, rows)
        least_turn = float(np.tan(LEAST_CHANGE * _TURN_ROWS * 2 * np.pi / self.period_px))
        predict_blocks_kernel(*light, levels.modulation, least_turn, self._contrast_sums, self.sums)
        self.window.smooth(self.sums, self._half, self.smooth)
        find_gains_kernel(self.smooth, True, self.gains)


@ti.func
def gain_at(gains: F32Array3, spacing_px: i32, y: i32, x: i32) -> vec3:
    """Interpolate the gains at a pixel, bilinearly."""
    v = (ti.cast(y, ti.f32) + 0.5) / spacing_px - 0.5
    u = (ti.cast(x, ti.f32) + 0.5) / spacing_px - 0.5
    v = ti.min(ti.max(v, 0.0), ti.cast(gains.shape[0] - 1, ti.f32))
    u = ti.min(ti.max(u, 0.0), ti.cast(gains.shape[1] - 1, ti.f32))
    i, j = ti.cast(v, ti.i32), ti.cast(u, ti.i32)
    i1, j1 = ti.min(i + 1, gains.shape[0] - 1), ti.min(j + 1, gains.shape[1] - 1)
    fv, fu = v - i, u - j
    result = vec3(0.0)
    for k in ti.static(range(3)):
        upper = gains[i, j, k] + fu * (gains[i, j1, k] - gains[i, j, k])
        lower = gains[i1, j, k] + fu * (gains[i1, j1, k] - gains[i1, j, k])
        result[k] = upper + fv * (lower - upper)
    return result


@ti.func
def projected_vector(sample: vec3, gain: vec3, inverse: mat3, to_phase: mat3) -> vec3:
    """Return b cos(phi), b sin(phi) and a of a sample, as a neutral surface sends the projector's light back."""
    # What `weighed_vector` gives in exact arithmetic; with the inverse in the weights, float32 rounds differently.
    wave = to_phase @ unmixed(sample * gain, inverse)
    return vec3(wave.y, wave.z, wave.x)


@ti.func
def neutral_channels(vector: vec3, share: f32, of_phase: mat3, matrix: mat3) -> vec3:
    """Return what the channels of a neutral surface are, given a pixel's `projected_vector`.

    Its background, and its phase with the frame's contrast: `share` is that over the pixel's modulation. Cosine and
    sine come from the vector itself: no arctangent is needed.
    """
    return matrix @ (vector.z * (of_phase @ vec3(1.0, share * vector.x, share * vector.y)))


@ti.func
def balancing_gain(seen: vec3, predicted: vec3) -> vec3:
    """Return the gains that make sums over the window what is predicted, up to a factor; one where nothing is lit."""
    gain = vec3(1.0)
    if ti.min(seen.min(), predicted.min()) > TINY:
        color = seen / predicted
        gain = channel_mean(color) / color
    return gain


@ti.func
def shows_fringe(sums: F32Array3, rows: i32, y: i32, j: i32) -> ti.i32:
    """Return whether a pixel's block, whose column is j, has a fringe: it is neither dark nor lit evenly."""
    return sums[y // rows, j, WindowSum.SAMPLES] > 0.0


@ti.func
def sample_at(samples: F32Array3, y: i32, j: i32) -> vec3:
    """Load a sample's channels."""
    return channels_at(samples, y, j, 0)


@ti.func
def channels_at(sums: F32Array3, i: i32, j: i32, first: Static) -> vec3:
    """Load three channels that begin at a column."""
    return vec3(sums[i, j, first], sums[i, j, first + 1], sums[i, j, first + 2])


@cache
def _collect_samples_kernel(mixed: bool) -> Any:
    @kernel
    def collect_samples_kernel(
        image: AnyArray3,  # (H, W, 3) levels
        unmixing: F32Array3,  # (N, 3, 3) of each surface
        besides: F32Array2,  # (N, 3) levels
        labels: U8Array2,  # (H, W) its number
        min_intensity: f32,  # levels; darker pixels are left out
        rows: i32,
        out_samples: F32Array3,  # (H, Wb, 3) a neutral surface's channels; 0 where left out
        out_sums: F32Array3,  # (Hb, Wb, 3) of every block's samples
    ):
        """Take one pixel a row of every block, and sum up each block's."""
        height, width, blocks = image.shape[0], image.shape[1], out_sums.shape[1]
        for block in range(out_sums.shape[0] * blocks):
            i, j = block // blocks, block % blocks
            total = vec3(0.0)
            for y in range(i * rows, ti.min((i + 1) * rows, height)):
                x, kept = j * 2 * rows + (y & 1) * rows, vec3(0.0)
                light = color_at(image, y, ti.min(x, width - 1))
                lit = (x < width) & (channel_mean(light) > min_intensity)
                if ti.static(mixed):
                    lit = lit & shows_surface(labels, y, x)
                if lit:
                    kept = neutral_light(light, unmixing, besides, labels, y, x, mixed)
                total += kept
                for k in ti.static(range(3)):
                    out_samples[y, j, k] = kept[k]
            for k in ti.static(range(3)):
                out_sums[i, j, k] = total[k]

    return collect_samples_kernel


# Without flow analysis its sums are rounded otherwise, which shows in sigma.
@kernel(flow_analysis=True)
def predict_blocks_kernel(
    samples: F32Array3,  # (H, Wb, 3)
    inverse_matrix: F32Array2,  # (3, 3) undoes the crosstalk
    crosstalk_matrix: F32Array2,  # (3, 3)
    channel_matrix: F32Array2,  # (3, 3) `channel_waves`
    phase_matrix: F32Array2,  # (3, 3) its inverse
    gains: F32Array3,  # (Hg, Wg, 3) of the first look
    rows: i32,
    min_modulation: f32,
    least_turn: f32,  # tangent of the least change of phase in _TURN_ROWS that is no even light's
    contrast_sums: F32Array2,  # (H / 8 + 1, 2) scratch: see _MODULATION and so on
    out_sums: F32Array3,  # (Hb, Wb, 8) see `WindowSum`
):
    """Measure the frame's contrast, then sum up every block's channels and what they should be."""
    height, columns = samples.shape[0], 2 * rows
    contrast_row = contrast_sums.shape[0] - 1
    for i in range(contrast_row):
        inverse, to_phase = matrix_of(inverse_matrix), matrix_of(phase_matrix)
        modulation_sum, background_sum = 0.0, 0.0
        y = i * SAMPLE
        for j in range(samples.shape[1]):
            gain = gain_at(gains, columns, y, j * columns + rows)
            vector = projected_vector(sample_at(samples, y, j), gain, inverse, to_phase)
            modulation = modulation_of(vector)
            if modulation > min_modulation:
                modulation_sum += modulation
                background_sum += vector.z
        contrast_sums[i, _MODULATION] = modulation_sum
        contrast_sums[i, _BACKGROUND] = background_sum
    # One thread adds the rows up in order, so that the sum is the same every time.
    ti.loop_config(serialize=True)
    for _ in range(1):
        modulation_sum, background_sum = 0.0, TINY
        for i in range(contrast_row):
            modulation_sum += contrast_sums[i, _MODULATION]
            background_sum += contrast_sums[i, _BACKGROUND]
        contrast_sums[contrast_row, _CONTRAST] = modulation_sum / background_sum
    strips = strip_count(out_sums.shape[1], LANES)
    for t in range(SPREAD * out_sums.shape[0] * strips):
        if t % SPREAD > 0:
            continue
        i, first, count = strip_at(t // SPREAD, out_sums.shape[1], LANES)
        inverse, matrix = matrix_of(inverse_matrix), matrix_of(crosstalk_matrix)
        of_phase, to_phase = matrix_of(channel_matrix), matrix_of(phase_matrix)
        contrast = contrast_sums[contrast_row, _CONTRAST]
        light, color_gains, sums = lanes_of_colors(0.0), lanes_of_colors(1.0), window_sums(0.0)
        # b cos(phi) and b sin(phi) of the last row and of the row before it; sums of b b' of the latter and the present
        # row times the cosine and the sine of the change.
        last, before, turn = lanes_of_colors(0.0), lanes_of_colors(0.0), lanes_of_colors(0.0)
        # One gain serves the block: it changes slowly, and the pixels' errors from it cancel.
        middle = ti.min(i * rows + rows // 2, height - 1)
        for k in range(count):
            set_color(color_gains, k, gain_at(gains, columns, middle, (first + k) * columns + rows))
        end = ti.min((i + 1) * rows, height)
        for y in range(i * rows, ti.min(end + _TURN_ROWS, height)):
            for k in range(count):
                set_color(light, k, sample_at(samples, y, first + k))
            for k in range(LANES):
                sample, gain = color_of(light, k), color_of(color_gains, k)
                vector = projected_vector(sample, gain, inverse, to_phase)
                modulation = modulation_of(vector)
                turn[0, k] += before[0, k] * vector.x + before[1, k] * vector.y
                turn[1, k] += before[0, k] * vector.y - before[1, k] * vector.x
                for c in ti.static(range(2)):
                    before[c, k] = last[c, k]
                last[0, k], last[1, k] = vector.x, vector.y
                counts = ti.select((modulation > min_modulation) & (y < end), 1.0, 0.0)
                share = contrast / ti.max(modulation, TINY)
                predicted = neutral_channels(vector, share, of_phase, matrix)
                for c in ti.static(range(3)):
                    sums[WindowSum.SEEN + c, k] += counts * sample[c]
                    sums[WindowSum.PREDICTED + c, k] += counts * predicted[c]
                sums[WindowSum.BACKGROUND, k] += counts * channel_mean(sample * gain)
                sums[WindowSum.SAMPLES, k] += counts
        for k in range(count):
            fringed = ti.select(ti.abs(turn[1, k]) < least_turn * turn[0, k], 0.0, 1.0)
            for c in ti.static(range(_WINDOW_SUMS)):
                out_sums[i, first + k, c] = fringed * sums[c, k]


@kernel
def find_gains_kernel(
    sums: F32Array3,  # (Hg, Wg, 3 or 8) see `WindowSum`
    predicted: i32,  # 0: nothing is predicted yet, and the channels are to be equal
    out_gains: F32Array3,  # (Hg, Wg, 3)
):
    """Find the gains of every node."""
    for node in range(sums.shape[0] * sums.shape[1]):
        i, j = node // sums.shape[1], node % sums.shape[1]
        model = vec3(1.0)
        if predicted == 1:
            model = channels_at(sums, i, j, WindowSum.PREDICTED)
        gain = balancing_gain(channels_at(sums, i, j, WindowSum.SEEN), model)
        for k in ti.static(range(3)):
            out_gains[i, j, k] = gain[k]


@kernel
def apply_gains_kernel(
    image: F32Array3,  # (H, W, 3) linear light
    gains: F32Array3,  # (Hg, Wg, 3)
    spacing_px: i32,
    out: F32Array3,  # (H, W, 3)
):
    for pixel in range(image.shape[0] * image.shape[1]):
        y, x = pixel // image.shape[1], pixel % image.shape[1]
        gain = gain_at(gains, spacing_px, y, x)
        for k in ti.static(range(3)):
            out[y, x, k] = image[y, x, k] * gain[k]


@kernel
def darken_kernel(
    image: F32Array3,  # (H, W, 3)
    mask: U8Array2,  # (H, W) 0: left out
    out: F32Array3,  # (H, W, 3) the image, black where left out
):
    for pixel in range(image.shape[0] * image.shape[1]):
        y, x = pixel // image.shape[1], pixel % image.shape[1]
        keep = ti.cast(mask[y, x] != 0, ti.f32)
        for k in ti.static(range(3)):
            out[y, x, k] = image[y, x, k] * keep


def balance_color(
    image: F32,
    period_px: float,
    mask: Mask | None = None,
    *,
    crosstalk_matrix: npt.ArrayLike | None = None,
    out: F32 | None = None,
) -> F32:
    """Balance the colours over a smooth window of about a cycle, twice: the second time the phase is known.

    Parameters
    ----------
    image : (H, W, 3) float32
        Linear light at the camera, stripes running along the rows.
    period_px : float
        Camera px per cycle; sizes the window.
    mask : (H, W) bool or uint8, optional
        Pixels that count; None: all.
    crosstalk_matrix : (3, 3), optional
        camera = matrix @ projector; what the second look needs to predict a channel. None: no crosstalk.
    out : (H, W, 3) float32, optional
        Output array.

    Returns
    -------
    (H, W, 3) float32
        Each channel times a slowly varying gain, so that a neutral projector colour comes out grey; the mean of the
        three channels stays what it was. Undo the crosstalk afterwards, with its rows divided by their sums.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, the period is below 4 px, or `out` cannot be written.
    """
    image = checks.read_array("image", image, (None, None, 3), np.float32)
    height, width = int(image.shape[0]), int(image.shape[1])
    if not period_px >= MIN_PERIOD_PX:
        raise ShapeError(f"period_px is {period_px}: three colours resolve a cycle of {MIN_PERIOD_PX:g} px or more")
    counted = image
    if mask is not None:
        mask = checks.read_mask("mask", mask, (height, width))
        counted = np.empty((height, width, 3), np.float32)
        darken_kernel(image, mask, counted)
    crosstalk = Crosstalk.of(np.eye(3) if crosstalk_matrix is None else crosstalk_matrix)
    out = checks.out_array("out", out, (height, width, 3), np.float32)
    gains = Gains(height, width, period_px)
    gains.measure(counted, crosstalk, _ANYTHING_LIT)
    apply_gains_kernel(image, gains.gains, gains.spacing_px, out)
    return out
