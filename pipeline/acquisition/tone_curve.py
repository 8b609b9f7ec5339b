"""Measure the camera's tone curve by pictures whose light is known, whatever the projector's response.

Of four neighbouring projector pixels none, one, two, three or all are lit. A camera that does not resolve them sees 0,
1/4, 1/2, 3/4 or all of the light, since each pixel is either black or white. The picture has tiles of all five kinds,
and five such pictures show each kind everywhere. So all of them are equally bright, and automatic exposure and flicker
act on all kinds alike.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.acquisition.rig_faults import SATURATED, RigProbe, rms
from pipeline.models import FloatArray
from tikernels.raw.linearization import TRANSFERS, linear_values

# Shares of the light, and which of 2 x 2 pixels make each; two of them are diagonal.
_SHARES = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
_CELLS = np.array([[[0, 0], [0, 0]], [[1, 0], [0, 0]], [[1, 0], [0, 1]], [[1, 1], [0, 1]], [[1, 1], [1, 1]]])
# Tiles in a row: few enough that most pixels see one kind of them.
_TILES = 10
# Pixels at least this part as bright as the brightest are counted: a curve blurs where levels are mixed.
_BRIGHT = 0.8
# Half of a tile where the projector's picture is as wide as the camera's: in the tile's other half, which is its rim,
# lenses out of focus mix tiles.
_INNER = 1 / (2 * _TILES)
# A tile is resolved where its light varies by this part of its mean: the curve is then that of single pixels.
_RESOLVED = 0.25
# Light by a named curve is off by less than this part of the range, RMS: sensors are linear to a hundredth, which
# makes .016 rad, about as much as a frame's noise.
MAX_CURVE = 0.01
# Black is clipped where more than this part of its pixels has the least level: of Gaussian noise it then lies less than
# 1.6 sigma above it.
MAX_CLIPPED = 0.05


@dataclass(frozen=True)
class ToneCurve:
    """Levels of known shares of the light."""

    levels: FloatArray  # (5,) of 0, 1/4, 1/2, 3/4 and all of the light, of full scale
    transfer: str  # the named curve that fits best
    error: float  # RMS of its light, as a part of the range
    black: float  # light of black, as a part of white's
    clipped: float  # part of the pixels of black that have the least level
    lost: float  # light that is cut off below black, as a part of white's
    resolved: bool  # the camera sees single pixels: nothing is known

    @property
    def is_named(self) -> bool:
        """True where a named curve fits."""
        return self.resolved or self.error <= MAX_CURVE

    def to_light(self, values: FloatArray) -> FloatArray:
        """Return the light of shares of full scale, 1 at full scale or, of an unnamed curve, about that."""
        if self.resolved:
            return values
        if self.is_named:
            return np.asarray(linear_values(values, self.transfer))
        slope = (self.levels[-1] - self.levels[-2]) / (_SHARES[-1] - _SHARES[-2])
        top = 1 + max(0.0, 1 - self.levels[-1]) / max(slope, 1e-3)
        light = np.interp(values, [*self.levels, 1.0], [*_SHARES, top])
        return np.asarray(light / top)


def measure_tone_curve(probe: RigProbe, code: float, takes: int = 3) -> ToneCurve:
    """Measure the camera's tone curve.

    Parameters
    ----------
    probe : RigProbe
        Projector and camera; `look` was called.
    code : float
        Of lit pixels.
    takes : int
        Number of frames of each picture.
    """
    width, height = probe.studio.projector_px
    y, x = np.arange(height)[:, None], np.arange(width)
    side = width // _TILES
    kinds = x // side + 2 * (y // side)
    pictures = [_CELLS[(kinds + n) % 5, y % 2, x % 2] for n in range(5)]
    frames = np.array(
        [np.mean(probe.frames(code * np.repeat(each[..., None], 3, axis=2), takes), axis=0) for each in pictures]
    )
    lightest = frames.mean(axis=-1).argmax(axis=0)  # the picture that lights a pixel fully
    inner = probe.lit & _is_even(lightest)
    # By share: the picture after the lightest has no light, the next a quarter.
    order = (lightest + 1 + np.arange(5)[:, None, None]) % 5
    by_share = np.take_along_axis(frames, order[..., None], axis=0)
    white = by_share[-1].mean(axis=-1)
    bright = inner & (white > _BRIGHT * np.percentile(white[inner], 99)) & (by_share[-1] < SATURATED).all(axis=-1)
    if not bright.any():
        bright = inner
    levels = by_share[:, bright].mean(axis=(1, 2))
    black = probe.frames(probe.field(0.0), 1)[-1][probe.lit]
    clipped = float((black <= 0).mean())
    variation = by_share[2][bright].std(axis=0).mean() - by_share[4][bright].std(axis=0).mean()
    known = slice(1 if clipped > MAX_CLIPPED else 0, None)
    fits = [_fit(levels, known, transfer) for transfer in TRANSFERS]
    best = int(np.argmin([error for error, _, _ in fits]))
    error, offset, scale = fits[best]
    lowest = float(linear_values(levels[0], TRANSFERS[best]))
    return ToneCurve(
        levels=np.maximum.accumulate(levels),
        transfer=TRANSFERS[best],
        error=error,
        black=lowest / (offset + scale),
        clipped=clipped,
        lost=max(0.0, (lowest - offset) / scale) if clipped > MAX_CLIPPED else 0.0,
        resolved=bool(variation > _RESOLVED * (levels[2] - levels[0])),
    )


def _fit(levels: FloatArray, known: slice, transfer: str) -> tuple[float, float, float]:
    """Return how far light is off a straight line, RMS of white's, and the line's offset and slope."""
    light = np.asarray(linear_values(levels, transfer))
    scale, offset = np.polyfit(_SHARES[known], light[known], 1)
    return rms(offset + scale * _SHARES[known] - light[known]) / abs(scale), float(offset), float(scale)


def _is_even(numbers: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """Return the pixels around which all numbers are alike."""
    side = round(_INNER * numbers.shape[1])
    around = np.ones((side, side), np.uint8)
    values = numbers.astype(np.uint8)
    return np.asarray(cv2.erode(values, around) == cv2.dilate(values, around))
