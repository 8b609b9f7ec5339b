"""The first pass over a frame, before its surfaces are known: colours, ambient light and unlit places.

The first look takes all surfaces for neutral. What is seen, over what phases predict, is a surface's colour then.
"""

import math
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from tikernels import runtime
from tikernels.arrays import LevelsImage
from tikernels.phase.camera_blur import VARIANCE_PX
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.color_balance import WindowSum
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_vector import SIGMAS, TINY
from tikernels.phase.surface_colors import color_ratios, common_colors, nearest_colors
from tikernels.phase.surface_labels import LEAST_PX
from tikernels.phase.surface_misfits import REACH_PX, Lattice, average_light
from tikernels.phase.surface_samples import SurfaceSamples
from tikernels.phase.surfaces import NO_SURFACE
from tikernels.phase.wrapped_phase import LEAST_NO_PHASE

_Labels = npt.NDArray[np.uint8]

# Colours are averaged across the stripes by a Gaussian of this standard deviation, cycles; along them over one block.
# It need not hold whole cycles, since what phases predict is seen through the same window.
_COLOR_CYCLES = 0.3
# Where colours change by as much from node to node, as logarithms of ratios, the window sees two surfaces. A colour has
# at least the second share of what is even: of a fine print little is.
_SHARP, _LEAST_SHARE = 0.065, 0.05
# A node has a colour if this share of its window is lit.
_FILLED = 0.3
# What all of a frame's light has in common is measured on about this many samples.
_SAMPLES = 3000
# A fringe swings by twice its modulation over this part of a cycle, about ten pixels, whose noise alone swings by less
# than this many standard deviations.
_SWING_CYCLES, _SWING_SIGMAS = 0.65, 5.0
# How far the fringe's change is averaged for its contrast, in nodes.
_CONTRAST_NODES = 0.7
# No camera is better than this fraction of its light.
_LEAST_NOISE = 2e-4


class FirstLook:
    """A frame as the balance alone sees it, stripes along the rows.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels.
    model : ChannelModel
        The frame's samples, balanced.
    crosstalk : Crosstalk
        The crosstalk that they were balanced with.
    levels : FrameLevels
        The frame's noise, and the least of a pixel with a phase.

    Attributes
    ----------
    spacing_px : int
        Between the nodes.
    ratios : (Hn, Wn, 3) float64
        The colour around every one of them; see `color_ratios`.
    lit : (Hn, Wn) bool
        True where the colour is known.
    """

    def __init__(
        self,
        image: LevelsImage,
        model: ChannelModel,
        crosstalk: Crosstalk,
        levels: FrameLevels,
    ) -> None:
        gains = model.gains
        self.device_image, self.gains, self.levels = image, gains, levels
        self._model, self.crosstalk = model, crosstalk
        self.spacing_px = gains.spacing_px
        self._smooth = runtime.to_host(gains.smooth)
        near = _smoothed_across(runtime.to_host(gains.sums), _COLOR_CYCLES * gains.period_px / gains.window.rows)
        predicted = np.maximum(near[..., WindowSum.PREDICTED : WindowSum.BACKGROUND], TINY)
        self.ratios = color_ratios(near[..., WindowSum.SEEN : WindowSum.PREDICTED] / predicted)
        self.lit = self._smooth[..., WindowSum.SAMPLES] > _FILLED * gains.window.samples

    @cached_property
    def image(self) -> npt.NDArray[Any]:
        """(H, W, 3) levels, as an array."""
        return runtime.to_host(self.device_image)

    @cached_property
    def lattice(self) -> Lattice:
        """Places all over the frame, one a node's column, and their light."""
        rows = max(1, self.gains.window.rows // 2)
        nodes = (self.contrast, self.unlit, self.levels)
        seen = average_light(self.device_image, self.gains, self.crosstalk, *nodes, rows, self.spacing_px, REACH_PX)
        light, contrast = (runtime.to_host(part) for part in seen)
        # The bare phase does not go evenly over a cycle.
        contrast = cv2.blur(contrast, (1, max(1, round(self.gains.period_px / rows))))
        return Lattice(light, contrast, rows, self.gains.spacing_px, self.gains.period_px)

    @cached_property
    def around(self) -> FloatArray:
        """(h, w) mean brightness around each place, levels."""
        samples = np.maximum(self._smooth[..., WindowSum.SAMPLES], TINY)
        return np.asarray(self._at_places(self._smooth[..., WindowSum.BACKGROUND] / samples), np.float64)

    @cached_property
    def ambient(self) -> float:
        """Ambient light that the surfaces send back on average, levels: what the modulation does not follow."""
        _, vector, contrast = self._looked_at
        modulation = np.hypot(vector[:, 0], vector[:, 1]) / contrast
        shown = modulation > self.levels.modulation
        if not shown.any():
            return 0.0
        modulation, background = modulation[shown], vector[shown, 2]
        mean, variance = float(background.mean()), float(background.var())
        covariance = float(((background - mean) * modulation).mean())
        if covariance <= 0:
            return 0.0
        return max(0.0, mean - float(modulation.mean()) * variance / covariance)

    @cached_property
    def contrast(self) -> npt.NDArray[np.float32]:
        """(Hn, Wn) share of the fringe's contrast that the camera's blur leaves at every node, relative to the usual.

        Where a surface turns away the fringe is finer, and blur takes more of it.
        """
        phase = runtime.to_host(self._model.phases)
        shown = phase < LEAST_NO_PHASE
        # Every second row shows the same column. What the arctangent is off by is the same everywhere.
        change = 0.5 * (phase[2:] - phase[:-2])
        change -= np.pi * np.rint(change / np.pi)
        weight = (shown[2:] & shown[:-2]).astype(np.float32)
        size = self.ratios.shape[1::-1]
        squares, weights = (
            cv2.GaussianBlur(cv2.resize(part, size, interpolation=cv2.INTER_AREA), (0, 0), _CONTRAST_NODES)
            for part in (weight * change**2, weight)
        )
        known = weights > _FILLED
        slopes = squares / np.maximum(weights, TINY)
        usual = float(np.median(slopes[known])) if known.any() else 0.0
        lost = np.where(known, 0.5 * VARIANCE_PX * (slopes - usual), 0)
        return np.asarray(np.exp(-lost), np.float32)

    def common_colors(self) -> FloatArray:
        """Return the colours that many nodes have in common, (n, 3) ratios, the commonest first."""
        mean, square = (
            cv2.blur(values, (3, 3), borderType=cv2.BORDER_REPLICATE) for values in (self.ratios, self.ratios**2)
        )
        # Of a slope, two thirds of its square; a corner where squares of two colours meet has none.
        change = (square - mean**2).sum(axis=-1)
        weights = (1 / (1 + change / _SHARP**2) ** 4)[self.lit]
        least = min(LEAST_PX / self.spacing_px**2 / 2, _LEAST_SHARE * float(weights.sum()))
        return common_colors(self.ratios[self.lit], weights, least)

    def labels(self, colors: FloatArray) -> _Labels:
        """Return (h, w) uint8: which colour the node nearest to each place has, or NO_SURFACE."""
        labels = self._at_places(nearest_colors(self.ratios, colors).astype(np.uint8), cv2.INTER_NEAREST)
        rows, columns = (np.arange(n) for n in labels.shape)
        columns = np.minimum(columns * self.lattice.columns + self.lattice.columns // 2, self.gains.width - 1)
        labels[self.unlit[rows[:, None] * self.lattice.rows, columns]] = NO_SURFACE
        return labels

    @cached_property
    def unlit(self) -> npt.NDArray[np.bool_]:
        """Return which pixels are dark, or show no fringe over most of a cycle, (H, W)."""
        part = np.ones((max(3, int(_SWING_CYCLES * self.gains.period_px)), 1), np.uint8)
        # Channel by channel: NumPy reduces an axis of three at a tenth of the speed.
        red, green, blue = cv2.split(cv2.morphologyEx(self.image, cv2.MORPH_GRADIENT, part))
        swing = cv2.max(cv2.max(red, green), blue)
        red, green, blue = cv2.split(self.image)
        light = cv2.add(cv2.add(red, green, dtype=cv2.CV_32F), blue, dtype=cv2.CV_32F)
        least = max(2 * self.levels.modulation, _SWING_SIGMAS * self.levels.noise)
        return np.asarray((light < self.image.shape[2] * self.levels.intensity) | (swing < least))

    def some_samples(self) -> FloatArray:
        """Return the light of samples that show a fringe, (N, 3) levels."""
        seen, vector, _ = self._looked_at
        shown = np.hypot(vector[:, 0], vector[:, 1]) > self.levels.modulation
        return np.asarray(seen[shown & (seen.max(axis=1) < self.levels.clipped)])

    @cached_property
    def _looked_at(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Samples from all over the frame, (N, 3), their b cos(phi), b sin(phi) and a, levels, and contrast."""
        samples, balanced_samples = (
            runtime.to_host(part).reshape(-1, 3) for part in (self.gains.samples, self._model.balanced)
        )
        step = max(1, len(samples) // _SAMPLES)
        while math.gcd(step, int(self.gains.samples.shape[1])) > 1:  # or it meets the same columns again and again
            step += 1
        seen, balanced = samples[::step].astype(np.float64), balanced_samples[::step].astype(np.float64)
        contrast = self._contrast_at(np.arange(0, len(samples), step))
        return seen, np.asarray(balanced @ self.crosstalk.weights.T.astype(np.float64)), contrast

    def _contrast_at(self, samples: npt.NDArray[np.intp]) -> FloatArray:
        """Return what blur leaves of the contrast around some samples (N,), a factor."""
        row, column = np.divmod(samples, int(self.gains.samples.shape[1]))
        # Where these lie between the nodes, whose values are those of the middles of their squares.
        y = (row + 0.5) / self.spacing_px - 0.5
        places = (column.astype(np.float32)[None], y.astype(np.float32)[None])
        border = cv2.BORDER_REPLICATE
        return np.asarray(cv2.remap(self.contrast, *places, cv2.INTER_LINEAR, borderMode=border)[0], np.float64)

    def _at_places(self, values: npt.NDArray[Any], how: int = cv2.INTER_LINEAR) -> npt.NDArray[Any]:
        """Return values at nodes as values at the lattice's places."""
        (height, width), rows = self.lattice.contrast.shape, self.spacing_px // self.lattice.rows
        size = (values.shape[1], values.shape[0] * rows)
        between = cv2.resize(np.ascontiguousarray(values), size, interpolation=how)
        return np.ascontiguousarray(between[:height, :width])

    def surface_samples(
        self,
        light: npt.NDArray[np.floating],
        around: npt.NDArray[np.floating],
        contrast: npt.NDArray[np.floating],
        weights: FloatArray,
        ambient: FloatArray,
        share: FloatArray,
        contrast_doubt: float,
    ) -> SurfaceSamples:
        """Return places of n surfaces, with the phase that the arctangent gives them.

        Parameters
        ----------
        light : (n, 3, S)
            The camera's, levels.
        around, contrast, share, contrast_doubt
            See `SurfaceSamples`.
        weights : (n, 3, 3)
            Takes each surface's channels to b cos(phi), b sin(phi) and a.
        ambient : (n, 3)
            Its ambient light, levels.
        """
        channels, mean, sharp = (np.asarray(part, np.float32, order="C") for part in (light, around, contrast))
        vector = weights.astype(np.float32) @ (channels - ambient[..., None].astype(np.float32))
        bare = np.arctan2(vector[:, 1], vector[:, 0])
        noise = self.levels.read_noise**2 + self.levels.noise_gain * np.maximum(channels, 0)
        noise += (_LEAST_NOISE * channels) ** 2
        found = (channels, noise, bare, np.maximum(mean, TINY), sharp)
        return SurfaceSamples(*found, share, contrast_doubt)


def _smoothed_across(sums: npt.NDArray[np.floating], sigma: float) -> npt.NDArray[np.floating]:
    """Return (Hg, Wb, N) blocks' sums, smoothed across the stripes, at the nodes between two of them."""
    near = cv2.GaussianBlur(
        sums, (1, 2 * math.ceil(SIGMAS * sigma) + 1), 0, sigmaY=sigma, borderType=cv2.BORDER_CONSTANT
    )
    above = near[::2]
    return np.asarray(above + near[np.minimum(2 * np.arange(len(above)) + 1, len(near) - 1)])
