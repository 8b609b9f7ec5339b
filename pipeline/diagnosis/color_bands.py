"""Bands along the rows of one picture in which the colours are balanced otherwise.

A projector that shows its colours in turn, and a rolling shutter whose rows do not expose for a whole number of such
turns: every row then sees another mixture, whatever is in view. The logarithms of a row's red and blue over its green
change by the same step in every part of the row's length, where a surface's colours change in one part and not in
another.
"""

import numpy as np
import numpy.typing as npt

from pipeline.diagnosis.ripple_finding import RippleFinding
from pipeline.models import FloatArray

#: What makes them.
BANDS = ("colours in turn and a rolling shutter", "a surface striped along the rows")
# Parts of a row that are compared: as many as leave each of them some 50 px of a small picture.
_PARTS = 10
# Steps are the picture's where they are known in this many of them.
_MIN_PARTS = 5
# A part of a row counts where it is lit by this share.
_MOSTLY = 0.8
# Nobody notices a smaller step: a camera's automatic white balance makes one of it from frame to frame.
_LEAST_STEP = 0.03
# The median of ten parts is off by a third of their scatter: at three times the scatter it is none of theirs.
_SCATTERS = 3.0
# Standard deviations of normal values that the median of their sizes is.
_SIGMAS_A_MEDIAN = 0.6745
# Rows, as a part of those that tell, from which on they are bands. Surfaces have none of them (bust, ball, waves
# and painted planes, simulated), bands of 40 rows 0.6.
_LEAST_ROWS = 0.1
# How often means are taken of means.
_MEANS = 3
# The fewest cycles in a picture: the difference of two such means takes this many, and a few rows are left of it.
_MIN_CYCLES = _MEANS + 2


def find_bands(light: FloatArray, mask: npt.NDArray[np.bool_], period_px: float) -> RippleFinding | None:
    """Return bands of another colour balance along the rows, if there are any.

    Parameters
    ----------
    light : (H, W, 3)
        Linear.
    mask : (H, W) bool
        Where a phase was found.
    period_px : float
        Camera px a cycle: means over a whole one do not show the fringe.
    """
    side = max(1, round(period_px))
    if len(mask) < _MIN_CYCLES * side:
        return None
    ratios = _color_ratios(light, mask, side)
    steps = ratios[side:] - ratios[:-side]  # (rows, parts, 2)
    steps = steps[np.isfinite(steps).all(axis=2).sum(axis=1) >= _MIN_PARTS]
    if len(steps) < side:
        return None
    common = np.nanmedian(steps, axis=1)
    scatter = np.nanmedian(abs(steps - common[:, None]), axis=1) / _SIGMAS_A_MEDIAN
    banded = (abs(common) > np.maximum(_LEAST_STEP, _SCATTERS * scatter)).any(axis=1)
    if banded.mean() < _LEAST_ROWS:
        return None
    most = float(np.quantile(abs(common[banded]).max(axis=1), 0.95))
    return RippleFinding(
        BANDS,
        f"from rows to rows the colours' balance changes by up to {100 * np.expm1(most):.0f} %",
        {1: 0.0},  # a gain, which the balance undoes; what it does to the fringe's levels shows in the harmonics
        0.9,
        "take a global shutter, or expose for a whole number of the projector's colour cycles",
    )


def _color_ratios(light: FloatArray, mask: npt.NDArray[np.bool_], side: int) -> FloatArray:
    """Return the logarithms of red and blue over green, (rows, parts, 2), of means about every row; NaN: dark.

    The mean over `side` rows is taken three times: a fringe whose period is off by a seventh, as on a ball, keeps 0.002
    of its amplitude.
    """
    borders = np.linspace(0, mask.shape[1], _PARTS + 1).astype(int)
    shown = np.add.reduceat(mask, borders[:-1], axis=1, dtype=np.float64)[..., None]
    total = np.add.reduceat(light * mask[..., None], borders[:-1], axis=1)
    sums = np.concatenate([shown, total], axis=2)
    for _ in range(_MEANS):
        above = np.cumsum(np.concatenate([0 * sums[:1], sums]), axis=0)
        sums = above[side:] - above[:-side]
    means = sums[..., 1:]
    lit = (sums[..., 0] > _MOSTLY * side**_MEANS * np.diff(borders)) & (means.min(axis=2) > 0)
    means[~lit] = np.nan
    return np.asarray(np.log(means[..., ::2] / means[..., 1:2]))
