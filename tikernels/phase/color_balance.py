"""Balance the colours locally, so that the surface's own colour does not bend the phase.

The camera's channel i sees r_i times what a neutral surface would send back, r_i changing slowly. A window of a few
cycles averages the fringes out and leaves r_i (section 3.1 of Je, Lee and Park 2004); a Gaussian window does so without
the ripple that a box leaves when it is not a whole number of cycles. At the edge of a surface the window is one-sided
and 13 % of the fringe passes it, so a second look, which knows the phase by then, compares what each channel sums up to
with what the phase says it should. A third look gains less than 0.001 rad.
"""

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import _checks, runtime
from tikernels._taichi import AnyArray3, F32Array1, F32Array2, F32Array3, Static, U8Array2, f32, i32, mat3, ti, vec3
from tikernels.arrays import F32, LevelsImage, Mask
from tikernels.errors import ShapeError
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import MIN_PERIOD_PX, FrameLevels
from tikernels.phase.phase_vector import channel_waves, matrix_of
from tikernels.raw.linearization import LEVEL_TYPES

#: The balance window: a Gaussian of this standard deviation across and along the stripes, in cycles. At 0.85 cycles it
#: passes 1e-6 of the fringe; wider ones blur the reflectance without gaining anything. The channels' model is fitted
#: over the same window (`channel_model.py`), and `uncertainty.py` knows how wide it is.
SIGMA_ACROSS, SIGMA_ALONG = 0.85, 1.0
# Sums below this hold no colour worth measuring.
_DARK = 1e-6
# Whoever balances an image alone has chosen its pixels by the mask.
_ANYTHING_LIT = FrameLevels(white=1.0, read_noise=0.0, noise_gain=0.0, noise=0.0, intensity=_DARK, modulation=_DARK)


def block_rows(period_px: float) -> int:
    """Rows of a block: the largest power of two that still samples a cycle two and a half times."""
    rows = 1
    while 2 * rows * 2.5 <= period_px and rows < 64:
        rows *= 2
    return rows


class Gains:
    """Per-channel gains on a coarse grid, and the buffers to measure them for one image size and period.

    Along the stripes neighbours say the same, so one pixel a row of each block stands for it. A block is `rows` image
    rows by twice as many columns; the grid has a node in the middle of every two blocks, one above the other, so its
    cells are squares of `cell` pixels.
    """

    def __init__(self, height: int, width: int, period_px: float) -> None:
        self.height, self.width = height, width
        self.rows = block_rows(period_px)
        self.cell = 2 * self.rows
        blocks = (-(-height // self.rows), -(-width // self.cell))
        self.grid = (-(-blocks[0] // 2), blocks[1])
        #: Of the channels that the gains belong to, in levels; zero where it is too dark.
        self.samples = runtime.empty((height, blocks[1], 3), np.float32)
        self.sums = runtime.empty((*blocks, 8), np.float32)
        self.half = runtime.empty((*self.grid, 8), np.float32)
        self.smooth = runtime.empty((*self.grid, 8), np.float32)
        self.gains = runtime.empty((*self.grid, 3), np.float32)
        self.visibility = runtime.empty((-(-height // _SPARSE) + 1, 2), np.float32)
        # Across, a node stands between two blocks, so the taps sit at half-integer distances.
        self.taps_across = _gaussian(SIGMA_ACROSS * period_px / self.rows, offset=0.5)
        self.taps_along = _gaussian(SIGMA_ALONG * period_px / self.cell)

    def measure(self, image: LevelsImage, crosstalk: Crosstalk, levels: FrameLevels) -> None:
        """Measure the gains of one frame; see `balance_color`.

        Parameters
        ----------
        image : (H, W, 3) uint8, uint16 or float32
            Linear light, levels, stripes along the rows.
        crosstalk : Crosstalk
            With `balance_first` the gains belong to the camera's channels, before it is undone, otherwise to the
            projector's, after that.
        levels : FrameLevels
            Darker pixels, and those with less modulation, say nothing of the colour.

        Raises
        ------
        ShapeError
            The image has another shape or dtype.
        """
        image = _checks.read_array("image", image, (self.height, self.width, 3), *LEVEL_TYPES)
        collect_samples, predict_blocks = _sample_kernels(crosstalk.balance_first)
        collect_samples(image, crosstalk.inverse, levels.intensity, self.rows, self.samples)
        sum_blocks_kernel(self.samples, self.rows, self.sums)
        self._find_gains(predicted=False)
        waves = channel_waves(crosstalk.lag)
        of_phase, to_phase = waves.astype(np.float32), np.linalg.inv(waves).astype(np.float32)
        light = (self.samples, crosstalk.inverse, crosstalk.matrix, of_phase, to_phase, self.gains, self.rows)
        predict_blocks(*light, levels.modulation, self.visibility, self.sums)
        self._find_gains(predicted=True)

    def smooth_sums(self, sums: F32, half: F32, out: F32) -> None:
        """Add up (Hb, Wb, N) sums of the blocks over a Gaussian window at every node, (Hg, Wg, N)."""
        smooth_blocks_kernel(int(sums.shape[2]), sums, self.taps_across, self.taps_along, half, out)

    def _find_gains(self, predicted: bool) -> None:
        self.smooth_sums(self.sums, self.half, self.smooth)
        find_gains_kernel(self.smooth, predicted, self.gains)


@ti.func
def gain_at(gains: F32Array3, cell: i32, y: i32, x: i32) -> vec3:
    """Interpolate the gains at a pixel, bilinearly."""
    v = (ti.cast(y, ti.f32) + 0.5) / cell - 0.5
    u = (ti.cast(x, ti.f32) + 0.5) / cell - 0.5
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


# The visibility is averaged over every eighth row.
_SPARSE = 8


@cache
def _sample_kernels(balance_first: bool) -> tuple[Any, Any]:
    @ti.kernel
    def collect_samples_kernel(
        image: AnyArray3,  # (H, W, 3) levels
        inverse_matrix: F32Array2,  # (3, 3) undoes the crosstalk
        min_intensity: f32,  # levels; darker pixels are left out
        rows: i32,
        out_samples: F32Array3,  # (H, Wb, 3) the channels that the gains belong to; 0 where left out
    ):
        width, blocks = image.shape[1], out_samples.shape[1]
        for sample in range(out_samples.shape[0] * blocks):
            y, j = sample // blocks, sample % blocks
            inverse = matrix_of(inverse_matrix)
            x = j * 2 * rows + (y & 1) * rows
            kept = vec3(0.0)
            if x < width:
                light = vec3(
                    ti.cast(image[y, x, 0], ti.f32), ti.cast(image[y, x, 1], ti.f32), ti.cast(image[y, x, 2], ti.f32)
                )
                if light.sum() > 3.0 * min_intensity:
                    kept = light
                    if ti.static(not balance_first):
                        kept = inverse @ light
            for k in ti.static(range(3)):
                out_samples[y, j, k] = kept[k]

    @ti.func
    def projected_light(sample: vec3, gain: vec3, inverse: mat3) -> vec3:
        """Return the projector's channels as a neutral surface sends them back."""
        result = sample * gain
        if ti.static(balance_first):
            result = inverse @ result
        return result

    @ti.kernel
    def predict_blocks_kernel(
        samples: F32Array3,  # (H, Wb, 3)
        inverse_matrix: F32Array2,  # (3, 3) undoes the crosstalk
        crosstalk_matrix: F32Array2,  # (3, 3)
        channel_matrix: F32Array2,  # (3, 3) `channel_waves`
        phase_matrix: F32Array2,  # (3, 3) its inverse
        gains: F32Array3,  # (Hg, Wg, 3) of the first look
        rows: i32,
        min_modulation: f32,
        visibility: F32Array2,  # (H / 8 + 1, 2) scratch: sums of modulation and background a row; last: their totals
        out_sums: F32Array3,  # (Hb, Wb, 8) what is there, what the phase predicts, the background, and the samples
    ):
        height, columns = samples.shape[0], 2 * rows
        sparse_rows = visibility.shape[0] - 1
        for i in range(sparse_rows):
            inverse, to_phase = matrix_of(inverse_matrix), matrix_of(phase_matrix)
            modulation_sum, background_sum = 0.0, 0.0
            y = i * _SPARSE
            for j in range(samples.shape[1]):
                sample = vec3(samples[y, j, 0], samples[y, j, 1], samples[y, j, 2])
                gain = gain_at(gains, columns, y, j * columns + rows)
                wave = to_phase @ projected_light(sample, gain, inverse)
                modulation = ti.sqrt(wave.y * wave.y + wave.z * wave.z)
                if modulation > min_modulation:
                    modulation_sum += modulation
                    background_sum += wave.x
            visibility[i, 0] = modulation_sum
            visibility[i, 1] = background_sum
        # One thread adds the rows up in order, so that the sum is the same every time.
        ti.loop_config(serialize=True)
        for _ in range(1):
            modulation_sum, background_sum = 0.0, 1e-12
            for i in range(sparse_rows):
                modulation_sum += visibility[i, 0]
                background_sum += visibility[i, 1]
            visibility[sparse_rows, 0] = ti.min(modulation_sum / background_sum, 1.5)
        for block in range(out_sums.shape[0] * out_sums.shape[1]):
            i, j = block // out_sums.shape[1], block % out_sums.shape[1]
            inverse, matrix = matrix_of(inverse_matrix), matrix_of(crosstalk_matrix)
            of_phase, to_phase = matrix_of(channel_matrix), matrix_of(phase_matrix)
            seen, predicted = vec3(0.0), vec3(0.0)
            background, count = 0.0, 0.0
            contrast = visibility[sparse_rows, 0]
            # One gain serves the block: it changes slowly, and the pixels' errors from it cancel.
            gain = gain_at(gains, columns, ti.min(i * rows + rows // 2, height - 1), j * columns + rows)
            for y in range(i * rows, ti.min((i + 1) * rows, height)):
                sample = vec3(samples[y, j, 0], samples[y, j, 1], samples[y, j, 2])
                wave = to_phase @ projected_light(sample, gain, inverse)
                modulation = ti.sqrt(wave.y * wave.y + wave.z * wave.z)
                if modulation > min_modulation:
                    # Cosine and sine of the phase come from the phase vector itself: no arctangent needed.
                    share = contrast / modulation
                    model = wave.x * (of_phase @ vec3(1.0, share * wave.y, share * wave.z))
                    if ti.static(balance_first):
                        model = matrix @ model
                    seen += sample
                    predicted += model
                    background += (sample * gain).sum() / 3.0
                    count += 1.0
            for k in ti.static(range(3)):
                out_sums[i, j, k] = seen[k]
                out_sums[i, j, 3 + k] = predicted[k]
            out_sums[i, j, 6] = background
            out_sums[i, j, 7] = count

    return collect_samples_kernel, predict_blocks_kernel


@ti.kernel
def sum_blocks_kernel(
    samples: F32Array3,  # (H, Wb, 3)
    rows: i32,
    out_sums: F32Array3,  # (Hb, Wb, >= 3)
):
    height = samples.shape[0]
    for block in range(out_sums.shape[0] * out_sums.shape[1]):
        i, j = block // out_sums.shape[1], block % out_sums.shape[1]
        total = vec3(0.0)
        for y in range(i * rows, ti.min((i + 1) * rows, height)):
            total += vec3(samples[y, j, 0], samples[y, j, 1], samples[y, j, 2])
        for k in ti.static(range(3)):
            out_sums[i, j, k] = total[k]


@ti.kernel
def smooth_blocks_kernel(
    channels: Static,  # N
    sums: F32Array3,  # (Hb, Wb, N) a block's sums
    taps_across: F32Array1,  # half a Gaussian, from its middle
    taps_along: F32Array1,
    half: F32Array3,  # (Hg, Wg, N) scratch: smoothed across the stripes
    out: F32Array3,  # (Hg, Wg, N)
):
    blocks = sums.shape[0]
    for node in range(half.shape[0] * half.shape[1]):
        i, j = node // half.shape[1], node % half.shape[1]
        total = ti.Vector.zero(f32, channels)
        for tap in range(taps_across.shape[0]):
            weight = taps_across[tap]
            above, below = 2 * i - tap, 2 * i + 1 + tap
            if above >= 0:
                for k in ti.static(range(channels)):
                    total[k] += weight * sums[above, j, k]
            if below < blocks:
                for k in ti.static(range(channels)):
                    total[k] += weight * sums[below, j, k]
        for k in ti.static(range(channels)):
            half[i, j, k] = total[k]
    for node in range(half.shape[0] * half.shape[1]):
        i, j = node // half.shape[1], node % half.shape[1]
        total = ti.Vector.zero(f32, channels)
        for k in ti.static(range(channels)):
            total[k] = taps_along[0] * half[i, j, k]
        for tap in range(1, taps_along.shape[0]):
            weight = taps_along[tap]
            left, right = j - tap, j + tap
            if left >= 0:
                for k in ti.static(range(channels)):
                    total[k] += weight * half[i, left, k]
            if right < half.shape[1]:
                for k in ti.static(range(channels)):
                    total[k] += weight * half[i, right, k]
        for k in ti.static(range(channels)):
            out[i, j, k] = total[k]


@ti.kernel
def find_gains_kernel(
    sums: F32Array3,  # (Hg, Wg, 8) what is there, and what the phase predicts
    predicted: i32,  # 0: nothing is predicted yet, and the channels are to be equal
    out_gains: F32Array3,  # (Hg, Wg, 3)
):
    for node in range(sums.shape[0] * sums.shape[1]):
        i, j = node // sums.shape[1], node % sums.shape[1]
        color = vec3(sums[i, j, 0], sums[i, j, 1], sums[i, j, 2])
        least = color.min()
        if predicted == 1:
            model = vec3(sums[i, j, 3], sums[i, j, 4], sums[i, j, 5])
            least = ti.min(least, model.min())
            color = color / model
        # Where nothing is lit, the gains stay one.
        gain = vec3(1.0)
        if least > _DARK:
            gain = color.sum() / 3.0 / color
        for k in ti.static(range(3)):
            out_gains[i, j, k] = gain[k]


def _gaussian(sigma: float, offset: float = 0.0) -> npt.NDArray[np.float32]:
    """Half of a Gaussian of this deviation (in samples) from an offset on, cut at three deviations."""
    reach = np.arange(int(np.ceil(3 * sigma)) + 1) + offset
    return np.asarray(np.exp(-0.5 * (reach / sigma) ** 2), np.float32)


@ti.kernel
def apply_gains_kernel(
    image: F32Array3,  # (H, W, 3) linear light
    gains: F32Array3,  # (Hg, Wg, 3)
    cell: i32,
    out: F32Array3,  # (H, W, 3)
):
    for pixel in range(image.shape[0] * image.shape[1]):
        y, x = pixel // image.shape[1], pixel % image.shape[1]
        gain = gain_at(gains, cell, y, x)
        for k in ti.static(range(3)):
            out[y, x, k] = image[y, x, k] * gain[k]


@ti.kernel
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
        Camera px a cycle; sizes the window.
    mask : (H, W) bool or uint8, optional
        Pixels that count; None: all.
    crosstalk_matrix : (3, 3), optional
        camera = matrix @ projector; what the second look needs to predict a channel. None: no crosstalk.
    out : (H, W, 3) float32, optional
        Where the result goes.

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
    image = _checks.read_array("image", image, (None, None, 3), np.float32)
    height, width = int(image.shape[0]), int(image.shape[1])
    if not period_px >= MIN_PERIOD_PX:
        raise ShapeError(f"period_px is {period_px}: three colours resolve a cycle of {MIN_PERIOD_PX:g} px or more")
    counted = image
    if mask is not None:
        mask = _checks.read_mask("mask", mask, (height, width))
        counted = np.empty((height, width, 3), np.float32)
        darken_kernel(image, mask, counted)
    crosstalk = Crosstalk.of(np.eye(3) if crosstalk_matrix is None else crosstalk_matrix, balance_first=True)
    out = _checks.out_array("out", out, (height, width, 3), np.float32)
    gains = Gains(height, width, period_px)
    gains.measure(counted, crosstalk, _ANYTHING_LIT)
    apply_gains_kernel(image, gains.gains, gains.cell, out)
    return out
