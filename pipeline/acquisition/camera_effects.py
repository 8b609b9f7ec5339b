"""Test by pairs of pictures what a camera does to its picture.

Each test compares two pictures, or two parts of one, that an unprocessed camera sees alike. Stray light and blur act on
them in a known direction, and processing in the other one, so that most limits are as low as the noise allows.
"""

from itertools import pairwise
from math import expm1, log, pi, sqrt

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.acquisition.focus import FocusMeter
from pipeline.acquisition.rig_faults import RAD_PER_PART, RigFault, RigProbe
from pipeline.acquisition.tone_curve import ToneCurve
from pipeline.models import FloatArray

# Codes of a patch: dark enough that an automatic exposure, which multiplies by a few, does not saturate it.
_PATCH = 0.45
# A patch that stays lit may become darker by this part, and its colour shift by it, when its surroundings change. Stray
# light makes it brighter, and more like its surroundings, never less; what remains is noise of 0.001 and a projector's
# supply that gives way to a bright picture.
_MAX_CHANGE = 0.02
# Pixels within half of this part of the picture's width from others may see both: lenses out of focus mix them.
_RIM = 0.06
# Parts of the light on both sides of an edge: both leave room for levels beyond them.
_EDGE = (0.25, 0.6)
# Width of the bars whose edges are seen, projector px; distances from an edge, camera px, at which overshoot is sought;
# and beyond which there is none.
_BAR_PX, _NEAR_PX, _FAR_PX = 64, (1, 2, 3, 4), (7, 9)
# Overshoot of an edge, of its height: a lens makes none, and interpolation of a mosaic about a hundredth.
_MAX_OVERSHOOT = 0.02
# Correlation of the noise of neighbouring pixels: 0 on a sensor, above where pixels are interpolated or compressed.
# Only sharpening makes it negative, -0.06 where it adds half of the difference to the mean.
_MIN_CORRELATION = -0.03
# Parts of R, G and B in the brightness (Rec. ITU-R BT.601), which is sharpened, and stored for every pixel.
_LUMA = np.array([0.299, 0.587, 0.114])
# Noise below this variance, of full scale, is that of levels: a fifth of 8 bits.
_LEAST_VARIANCE = (0.2 / 255) ** 2
# Steps of the noise across the borders of blocks of 8 px are larger than others by this part, in frames taken so often;
# those of a sensor are by 0.01.
_BLOCK_PX, _MAX_BLOCKS, _NOISE_TAKES = 8, 0.1, 3
# Steps of colour between pixels 2n and 2n+1 against those between 2n+1 and 2n+2: alike, but where colour is stored for
# every second pixel. JPEG of full chroma makes a difference of 0.06, of half chroma 0.14.
_MAX_PAIRS = 0.1
# A step where there is no noise at all, of full scale: a thousandth of a level of 8 bits.
_LEAST_STEP = 0.001 / 255
# Camera px per spot of colour: the finest that the camera resolves.
_SPOT_PX = 2.0
# Fringes of the working period have this part of the contrast of coarse ones, where noise is 1.4 times that in focus.
_MIN_FOCUS = 0.7


class CameraEffects:
    """Tests a camera.

    Parameters
    ----------
    probe : RigProbe
        Projector and camera, set so that white is bright and not saturated; its scale was measured.
    curve : ToneCurve
        The camera's.
    code : float
        Of white.
    period_px : float
        The pattern's, of projector px.
    axis : {0, 1}
        Along which the phase grows: 0 is down the picture's rows.

    Attributes
    ----------
    contrast : (3,) or None
        Of the fringes, once `defocus` was called.
    """

    def __init__(self, probe: RigProbe, curve: ToneCurve, code: float, period_px: float, axis: int) -> None:
        self._probe, self._curve, self._code = probe, curve, code
        self._period_px = period_px
        self._focus = FocusMeter(probe, curve.to_light, code, period_px, axis)
        self.contrast: FloatArray | None = None

    def find(self) -> list[RigFault]:
        """Return the faults that are found."""
        checks = (
            self.auto_exposure,
            self.auto_white_balance,
            self.sharpening,
            self.compression,
            self.chroma_subsampling,
            self.defocus,
        )
        return [fault for check in checks if (fault := check()) is not None]

    def auto_exposure(self) -> RigFault | None:
        """Return the fault that a patch becomes darker when its surroundings become bright."""
        patch = self._patch()
        if not patch.any():
            return None
        among_black, among_white = self._patch_among(0.0), self._patch_among(1.0)
        change = float(among_white[patch].mean() / among_black[patch].mean()) - 1
        if change >= -_MAX_CHANGE:
            return None
        return RigFault(
            "automatic exposure",
            f"a patch becomes {-change:.0%} darker when the rest of the picture becomes white: switch off automatic "
            "exposure and gain, and backlight compensation",
            RAD_PER_PART * -change,
        )

    def auto_white_balance(self) -> RigFault | None:
        """Return the fault that a grey patch loses red when its surroundings become red."""
        patch = self._patch()
        if not patch.any():
            return None
        among_white, among_red = self._patch_among(1.0), self._patch_among(np.array([1.0, 0.0, 0.0]))
        before, after = (
            seen[patch].mean(axis=0)[0] / seen[patch].mean(axis=0)[1:].mean() for seen in (among_white, among_red)
        )
        change = float(after / before) - 1
        if change >= -_MAX_CHANGE:
            return None
        return RigFault(
            "automatic white balance",
            f"a grey patch loses {-change:.0%} of its red when the rest of the picture becomes red: switch off "
            "automatic white balance",
            RAD_PER_PART * -change / sqrt(3),  # one channel of three
        )

    def sharpening(self) -> RigFault | None:
        """Return the fault that edges overshoot, or that the noise of neighbouring pixels is opposite."""
        overshoot, correlation = self._overshoot(), self._noise_correlation()
        if overshoot <= _MAX_OVERSHOOT and correlation >= _MIN_CORRELATION:
            return None
        return RigFault(
            "sharpening",
            f"edges overshoot by {max(overshoot, 0):.0%} of their height, and the noise of neighbouring pixels "
            f"correlates by {correlation:.2f}: set the camera's sharpness to its least, and the projector's",
            RAD_PER_PART * max(overshoot, -correlation),
        )

    def compression(self) -> RigFault | None:
        """Return the fault that the noise has larger steps where blocks of 8 px meet; the scene is subtracted."""
        frames = [
            frame.mean(axis=-1) for frame in self._probe.frames(self._probe.field(0.7 * self._code), _NOISE_TAKES)
        ]
        noise = [second - first for first, second in pairwise(frames)]
        excess = 0.0
        for steps in np.mean([_steps(each, self._probe.lit) for each in noise], axis=0):
            # Of a mosaic, steps after even pixels differ from those after odd ones.
            alike = np.array([np.delete(steps[n % 2 :: 2], n // 2).mean() for n in range(_BLOCK_PX)])
            excess = max(excess, float((steps / np.maximum(alike, _LEAST_STEP)).max()) - 1)
        if excess <= _MAX_BLOCKS:
            return None
        return RigFault(
            "compression",
            f"the noise's steps between blocks of 8 px are {min(excess, 9.99):.0%} larger than within: choose an "
            "uncompressed format (raw, RGB8, YUV), not MJPEG or H.264",
            RAD_PER_PART * 0.01,
        )

    def chroma_subsampling(self) -> RigFault | None:
        """Return the fault that neighbouring pixels share their colour, in pairs."""
        if self._probe.studio.is_mosaic:
            return None
        width, height = self._probe.studio.projector_px
        # Spots of no grid, which could keep step with the camera's.
        noise = np.random.default_rng(0).standard_normal((height, width))
        red = cv2.GaussianBlur(noise, (0, 0), max(0.5, _SPOT_PX / 2 * self._probe.px_per_px)) > 0
        codes = self._code * np.stack([red, np.zeros_like(red), ~red], axis=-1)
        colors = [seen[..., 0] - seen[..., 2] for seen in self._probe.frames(codes, 2)]
        uneven = 0.0
        for steps in np.mean([_steps(color, self._probe.lit) for color in colors], axis=0):
            even, odd = steps[0::2].mean(), steps[1:-1:2].mean()  # the last is at a block's border
            uneven = max(uneven, abs(log(max(even, _LEAST_STEP) / max(odd, _LEAST_STEP))))
        if uneven <= _MAX_PAIRS:
            return None
        period_px = self._period_px / self._probe.px_per_px
        return RigFault(
            "chroma subsampling",
            f"steps of colour are {expm1(uneven):.0%} larger between every second pair of pixels: choose a format with "
            "the full resolution of colour (raw, RGB8, YUV 4:4:4), not YUYV, NV12, MJPEG or H.264",
            2 * pi * 0.5 / period_px,  # a pixel's colour is up to half a pixel off it
        )

    def defocus(self) -> RigFault | None:
        """Return the fault that fringes of the working period have lost their contrast."""
        contrast = self.contrast = self._focus.contrast()
        if contrast.min() >= _MIN_FOCUS:
            return None
        return RigFault(
            "focus",
            "fringes have lost contrast: R {:.2f}, G {:.2f}, B {:.2f} of 1. Focus the projector, then the camera, with "
            "--focus-s; stop down the camera if both are sharp".format(*contrast),
            # Noise of a level of 8 bits, over the contrast that is left.
            RAD_PER_PART * 2 / 255 / max(float(contrast.min()), 0.02),
        )

    def _patch_among(self, code: float | FloatArray) -> FloatArray:
        """Return the light of a grey patch among a plain colour."""
        width, height = self._probe.studio.projector_px
        codes = np.broadcast_to(np.asarray(code, np.float64), (height, width, 3)).copy()
        codes[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = _PATCH
        return self._light(self._code * codes, 3)

    def _patch(self) -> npt.NDArray[np.bool_]:
        """Return the pixels that see the patch, and nothing but it."""
        lit = self._probe.lit
        light = (self._patch_among(0.0) / np.maximum(self._curve.to_light(self._probe.white), _LEAST_STEP)).mean(
            axis=-1
        )
        others = lit & (light < np.percentile(light[lit], 99) / 2)
        side = round(_RIM * lit.shape[1])
        return np.asarray(lit & (cv2.dilate(others.astype(np.uint8), np.ones((side, side), np.uint8)) == 0))

    def _overshoot(self) -> float:
        """Return how far levels near an edge lie beyond those further away, as a part of the edge's height."""
        width, height = self._probe.studio.projector_px
        low, high = (self._code * sqrt(part) for part in _EDGE)
        is_high = (np.arange(width) // _BAR_PX % 2)[None, :, None] * np.ones((height, 1, 3)) > 0
        # Two pictures of the same mean, which divide the surface's own colour out.
        one, other = (self._light(np.where(each, high, low), 3).mean(axis=-1) for each in (is_high, ~is_high))
        edge = 0.5 + (one - other) / np.maximum(one + other, _LEAST_STEP)
        bright = (edge > 0.5).astype(np.uint8)
        beyond = [0.0]
        for side, sign in ((bright, 1), (1 - bright, -1)):
            away_px = cv2.distanceTransform(side, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            rings = {n: self._probe.lit & (np.rint(away_px) == n) for n in _NEAR_PX}
            far = self._probe.lit & (away_px >= _FAR_PX[0]) & (away_px <= _FAR_PX[1])
            level = edge[far].mean()
            height_of_edge = 2 * abs(level - 0.5)
            beyond += [
                float(sign * (edge[ring].mean() - level) / height_of_edge) for ring in rings.values() if ring.any()
            ]
        return max(beyond)

    def _noise_correlation(self) -> float:
        """Return the correlation of the noise of neighbouring pixels, 0 where there is hardly any noise."""
        first, second = self._probe.frames(self._probe.field(0.7 * self._code), 1)[:2]
        noise = (first - second) @ _LUMA
        noise = noise - noise[self._probe.lit].mean()
        lit = self._probe.lit
        variance = (noise[lit] ** 2).mean()
        if variance < _LEAST_VARIANCE:
            return 0.0
        across = (noise[:, 1:] * noise[:, :-1])[lit[:, 1:] & lit[:, :-1]].mean()
        down = (noise[1:] * noise[:-1])[lit[1:] & lit[:-1]].mean()
        return float((across + down) / 2 / variance)

    def _light(self, codes: npt.NDArray[np.floating], takes: int) -> FloatArray:
        return np.asarray(np.mean([self._curve.to_light(frame) for frame in self._probe.frames(codes, takes)], axis=0))


def _steps(values: FloatArray, lit: npt.NDArray[np.bool_]) -> list[FloatArray]:
    """Return the mean step to the next pixel, by the pixel's place in a block of 8: along rows, along columns."""
    found = []
    for seen, mask in ((values, lit), (values.T, lit.T)):
        steps, both = np.abs(np.diff(seen, axis=1)), mask[:, 1:] & mask[:, :-1]
        found.append(np.array([steps[:, n::_BLOCK_PX][both[:, n::_BLOCK_PX]].mean() for n in range(_BLOCK_PX)]))
    return found
