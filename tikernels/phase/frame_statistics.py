"""Statistics of a frame before it is decoded: the fringe's period, noise and brightness."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array3, I32Array1, f32, ti, vec3
from tikernels.arrays import LevelsImage
from tikernels.launching import kernel
from tikernels.phase.phase_vector import TINY, color_at, phase_vector
from tikernels.raw.linearization import LEVEL_TYPES, WHITE_LEVELS

#: Three samples per cycle and a little more is what a camera must see.
MIN_PERIOD_PX = 4.0
#: Share of full scale beyond which a channel is clipped. A pixel with two such channels has lost its phase; one alone
#: bends it by 0.03 rad at most.
CLIPPED = 0.998
#: Columns that are looked at: enough to meet every object that fills a twentieth of the image.
COLUMNS = 16
# A fringe turns one way: its power at +f without a counterpart at -f is at least this share of all chromatic power, and
# far above what noise leaves over. Reflectance and noise are real signals, alike at +f and -f.
_MIN_SHARE = 0.15
# What is brighter than this share of the brightest is lit; clipped at zero, darker light would show half of its noise.
_LIT = 0.1
# Groups of equally bright samples that show how the noise grows with the light, and the fewest samples of one.
_NOISE_GROUPS, _LEAST_GROUP = 8, 200
# Fourth differences leave out tilted stripes, and pixels two apart the effect of demosaicing on their neighbours.
_DIFFERENCE, _APART_PX = (1, -4, 6, -4, 1), 2
#: Median of a normal distribution's absolute values, in standard deviations; of their middle fifth the mean is it, too.
MEDIAN_SIZE = 0.6745


class _Probe(IntEnum):
    """Columns of what is read off a pixel."""

    COSINE = 0  # b cos(phi)
    SINE = 1  # b sin(phi)
    LIGHT = 2  # three channels
    CHANGE = 5  # their fourth differences
    COLUMNS = 8


@dataclass(frozen=True)
class FrameStatistics:
    """Results of `measure_frame`; light in 0..1 of full scale."""

    period_px: float | None  # camera px per cycle across the stripes; None: no fringe stands out
    noise: tuple[float, float]  # read noise and gain: a channel's variance is read^2 + gain * light
    brightness: float  # 95th percentile of the channels' mean
    modulation: float  # 95th percentile of the fringe's modulation
    clipped: float  # share of what is lit of which a channel is clipped


@dataclass(frozen=True)
class FrameLevels:
    """Noise and thresholds of a frame, in its levels of linear light."""

    white: float  # full scale
    read_noise: float  # standard deviation of a dark channel
    noise_gain: float  # by how much a channel's variance grows with its light
    noise: float  # standard deviation of a channel at half of the brightest
    intensity: float  # least mean of the channels of a pixel that counts
    modulation: float  # least modulation of a pixel that counts
    precision: float = 0.0  # least precision of its phase, 1 / rad^2
    least_reliable: float = 0.0  # of one that is used for frame-wide quantities, where that is more

    @property
    def reliable(self) -> float:
        """Least modulation of a pixel used to estimate frame-wide quantities: ambient light bends darker ones."""
        return max(self.modulation, self.least_reliable)

    @property
    def clipped(self) -> float:
        """The level from which on a channel is clipped."""
        return CLIPPED * self.white


@kernel
def probe_frame_kernel(
    image: AnyArray3,  # (H, W, 3) levels
    scale: f32,  # levels to 0..1
    out_samples: F32Array3,  # (columns, H, 8) 0..1; see `_Probe`
):
    columns, height, width = out_samples.shape[0], image.shape[0], image.shape[1]
    for sample in range(columns * height):
        column, y = sample // height, sample % height
        reach = ti.static(_APART_PX * (len(_DIFFERENCE) // 2))
        x = ti.max(ti.min(ti.max((2 * column + 1) * width // (2 * columns), reach), width - 1 - reach), 0)
        here, change = scale * color_at(image, y, x), vec3(0.0)
        for k in ti.static(range(len(_DIFFERENCE))):
            place = ti.min(ti.max(x + _APART_PX * k - reach, 0), width - 1)
            change += _DIFFERENCE[k] * scale * color_at(image, y, place)
        vector = phase_vector(here)
        out_samples[column, y, _Probe.COSINE] = vector.x
        out_samples[column, y, _Probe.SINE] = vector.y
        for k in ti.static(range(3)):
            out_samples[column, y, _Probe.LIGHT + k] = here[k]
            out_samples[column, y, _Probe.CHANGE + k] = change[k]


def measure_frame(image: LevelsImage, white_level: float | None = None) -> FrameStatistics:
    """Measure period, noise and brightness on a few columns.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, stripes along the rows.
    white_level : float, optional
        Full scale; None: the type's.

    Returns
    -------
    FrameStatistics
        The period to a few per cent, the noise's variance at any brightness to about 20 %, 60 % at the worst; of
        demosaiced light it is a quarter of a raw pixel's.

    Raises
    ------
    ShapeError
        Shape or dtype is another one.
    """
    image = checks.read_array("image", image, (None, None, 3), *LEVEL_TYPES)
    columns = min(COLUMNS, int(image.shape[1]))
    out = runtime.empty((columns, int(image.shape[0]), _Probe.COLUMNS), np.float32)
    dtype = runtime.dtype_name(image)
    white = white_level or WHITE_LEVELS[dtype]
    probe_frame_kernel(image, 1.0 / white, out)
    samples = runtime.to_host(out)  # synchronises
    light, changes = samples[..., _Probe.LIGHT : _Probe.CHANGE], samples[..., _Probe.CHANGE :]
    bright = _bright(light[..., 0] + light[..., 1] + light[..., 2]) / light.shape[-1]
    fringe = samples[..., _Probe.COSINE] + 1j * samples[..., _Probe.SINE]
    noise = _noise(changes, light, bright, 0.0 if dtype.startswith("float") else 1.0 / white)
    lit = light.mean(axis=-1) > _LIT * bright
    clipped = float((light[lit].max(axis=-1) >= CLIPPED).mean()) if lit.any() else 0.0
    return FrameStatistics(_period(fringe), noise, bright, _bright(np.abs(fringe)), clipped)


def _bright(values: npt.NDArray[np.float32]) -> float:
    """Return the 95th percentile; a third of the time that NumPy's own takes."""
    place = 0.95 * (values.size - 1)
    below, above = int(place), min(int(place) + 1, values.size - 1)
    low, high = np.partition(values.ravel(), (below, above))[[below, above]].astype(np.float64)
    return float(low + (place - below) * (high - low))


def _noise(
    changes: npt.NDArray[np.float32], light: npt.NDArray[np.float32], bright: float, level: float
) -> tuple[float, float]:
    """Return read noise and gain, given the channels (columns, H, 3), their fourth differences, and a grey level."""
    # Devices round differently; which samples are alike must not depend on that.
    light = np.round(light, 5)
    # Grouped by the pixel above, whose own noise is another one.
    light, changes = light[:, :-1], changes[:, 1:]
    usable = (light > _LIT * bright) & (light < CLIPPED)
    light, changes = light[usable], changes[usable]
    levels, variances = [], []
    if not len(light):
        return 0.0, 0.0
    # As far apart in brightness whatever most of the frame shows.
    brightness = np.log(light)
    lowest, highest = brightness.min(), brightness.max()
    numbers = ((brightness - lowest) * (_NOISE_GROUPS / (highest - lowest + 1e-6))).astype(np.int8)
    in_groups = np.split(
        np.argsort(numbers, kind="stable"), np.cumsum(np.bincount(numbers, minlength=_NOISE_GROUPS))[:-1]
    )
    for group in in_groups:
        if len(group) >= min(_LEAST_GROUP, len(light) / _NOISE_GROUPS):
            # The middle fifth instead of the median: that of whole levels is one or the next.
            first, last = 2 * len(group) // 5, 3 * len(group) // 5
            middle = np.sort(np.abs(changes[group]))[first : last + 1].mean()
            levels.append(light[group].mean())
            variances.append((middle / MEDIAN_SIZE) ** 2 / sum(factor**2 for factor in _DIFFERENCE))
    x, y = np.array(levels, np.float64), np.array(variances, np.float64)
    # A straight line, each variance as sure as it is small, but whole levels hide what is less than one; neither end
    # may be negative.
    weights = 1 / np.maximum(y + level**2, TINY) ** 2
    mean_x, mean_y = np.average(x, weights=weights), np.average(y, weights=weights)
    spread = np.average((x - mean_x) ** 2, weights=weights)
    gain = 0.0
    if spread > 0:
        gain = np.average((x - mean_x) * (y - mean_y), weights=weights) / spread
        gain = min(max(gain, 0.0), mean_y / mean_x)
    return float(np.sqrt(max(mean_y - gain * mean_x, 0.0))), float(gain)


def _period(signal: npt.NDArray[np.complex64]) -> float | None:
    """Return the period of the turning component of (columns, H) phase vectors."""
    height = signal.shape[1]
    if height < 2 * MIN_PERIOD_PX:
        return None
    signal = signal - signal.mean(axis=1, keepdims=True)
    power = (np.abs(np.fft.fft(signal, axis=1)) ** 2).sum(axis=0)
    frequencies = np.arange(1, (height + 1) // 2)
    turning = power[frequencies] - power[-frequencies]
    # Between two cycles in view and the shortest period that three colours resolve.
    usable = (frequencies > 1) & (frequencies * MIN_PERIOD_PX <= height)
    if not usable.any() or power.sum() <= 0:
        return None
    smooth = np.abs(np.convolve(turning, [1, 2, 1], "same")) * usable
    peak = int(frequencies[np.argmax(smooth)])
    lobe = (np.abs(np.log2(frequencies / peak)) < 0.5) & usable
    weights = np.clip(turning[lobe] * np.sign(turning[lobe].sum()), 0, None)
    if weights.sum() < _MIN_SHARE * power.sum():
        return None
    return float(height * weights.sum() / (weights @ frequencies[lobe]))


@kernel
def count_out_of_range_kernel(
    image: AnyArray3,  # (H, W, 3)
    white_level: f32,
    out_count: I32Array1,  # NaN; values below zero or above the white level
):
    height, width = image.shape[0], image.shape[1]
    for pixel in range(height * width):
        y, x = pixel // width, pixel % width
        for k in ti.static(range(3)):
            value = ti.cast(image[y, x, k], ti.f32)
            if ti.math.isnan(value):
                out_count[0] += 1
            elif value < 0.0 or value > white_level:
                out_count[1] += 1


def count_out_of_range(image: LevelsImage, white_level: float) -> tuple[int, int]:
    """Count the values that are NaN, and those outside 0..white_level.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        A frame.
    white_level : float
        Full scale.
    """
    image = checks.read_array("image", image, (None, None, 3), *LEVEL_TYPES)
    counts = np.zeros(2, np.int32)
    count_out_of_range_kernel(image, white_level, counts)
    runtime.synchronize()
    return int(counts[0]), int(counts[1])
