"""Measure with which period a projector's light repeats, and whether its colours come one after another.

Light w(t) of period T, exposed for e from the time t on, makes L(t, e), the integral of w. Where e is a whole number of
periods L is the same for every t. Elsewhere it varies from frame to frame, by an amount that depends on e modulo T
only. So the range of L over frames that begin at any time, as a function of the exposure, has the period T and its
zeros at whole numbers of it.

The picture is of vertical bars. Light of the room falls on the dark bars as on the lit ones, so it is subtracted frame
by frame, and its own variation is measured at the same time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from pipeline.acquisition.rig_faults import MAX_SATURATED, SURE_S, RigProbe, saturated_part, shares
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray

# Width of a bar, projector px: wide enough that most of its pixels see no other bar, even out of focus.
_BAR_PX = 64
# Pixels of lit and dark bars have more and less than these parts of the brightest pixels' light.
_IN_BAR, _BETWEEN = 0.5, 0.15
# Bands of rows: with a rolling shutter each sees another time.
_BANDS = 4
# A camera that runs freely may keep its time to the projector, so it is started anew this often per exposure, and takes
# frames this often from then on; and how often where the period is refined: of an alternation that is dark for a fifth
# of the time one frame in 200 series misses it.
_STARTS, _TAKES, _MORE_STARTS = 4, 2, 8
# Exposures that are tried, evenly spread; and the shortest one and the longest period, s: colour wheels of 12 cycles
# per picture at 60 Hz, and video of 48 Hz.
_EXPOSURES, _SHORTEST_S, _LONGEST_S = 48, 0.0012, 0.021
# Step of the periods that are compared: the longest exposure has at most 30 of them, whose phase it moves by less than
# a twentieth.
_STEP = 0.0015
# The light repeats with a period where its range at a whole number of them is less than this part of the usual one.
_LEFT = 0.25
# The longest exposure is shortened by this factor until bars are not saturated.
_SHORTER = 0.8
# Pixels of each band: their noise leaves a few thousandths of a level.
_PIXELS = 4000
# From a start of the camera to frames that are exposed as it is set, s, once its automatics have settled.
_SETTLES_S = 0.2
# Parts of a period, before and after a whole number of them, at which the zero between is found by proportion.
_ASIDE = (0.1, 0.03)
# Light that varies less than this, of its mean, is constant: a thousandth makes a phase error of 0.002 rad.
_CONSTANT = 0.001


@dataclass(frozen=True)
class Variation:
    """Variation of the light from frame to frame, as parts of the projector's mean light."""

    exposure_s: float  # as read back
    projector: FloatArray  # (3,) range of each channel
    sigma: float  # standard deviation of the channel that varies most
    room: float  # standard deviation of the light on dark bars
    correlation: float  # least one of two channels
    light: float  # mean of the projector's light on lit bars, of full scale


@dataclass(frozen=True)
class LightCycle:
    """Period of a projector's light."""

    period_s: float
    in_turns: bool  # the colours come one after another

    def nearest_s(self, exposure_s: float) -> float:
        """Return the whole number of periods nearest to an exposure."""
        return max(1, round(exposure_s / self.period_s)) * self.period_s


class FlashMeter:
    """Measures how the light of bars varies from frame to frame.

    Parameters
    ----------
    probe : RigProbe
        Projector and camera; `look` was called.
    code : float
        Of the lit bars; no exposure may saturate them.
    exposure_s, gain_db : float
        Of the camera while bars are distinguished.
    to_light : callable
        The inverse of the camera's tone curve.

    Raises
    ------
    CalibrationError
        The bars cannot be seen.
    """

    def __init__(
        self,
        probe: RigProbe,
        code: float,
        exposure_s: float,
        gain_db: float,
        to_light: Callable[[FloatArray], FloatArray],
    ) -> None:
        self._probe, self._studio = probe, probe.studio
        self._to_light = to_light
        self._gain_db = gain_db
        width, height = self._studio.projector_px
        bars = (np.arange(width) // _BAR_PX % 2)[None, :, None] * np.full(3, code)
        self._bars = np.broadcast_to(bars, (height, width, 3))
        self._studio.set_camera(exposure_s, gain_db)
        frames = probe.frames(self._bars, 2)
        self._longest_s = self._unsaturated_s(probe)
        light = np.where(probe.lit, np.mean(frames, axis=0).mean(axis=-1), np.nan)
        # Row by row: those of a rolling shutter see other light of the room.
        is_lit = probe.lit.any(axis=1)
        low, high = np.zeros((2, len(light), 1))
        low[is_lit], high[is_lit] = np.nanpercentile(light[is_lit], (1, 99), axis=1)[..., None]
        bright = probe.lit & (light > low + _IN_BAR * (high - low))
        dark = probe.lit & (light < low + _BETWEEN * (high - low))
        rows = np.cumsum(bright.sum(axis=1))
        edges = [0, *np.searchsorted(rows, rows[-1] * np.arange(1, _BANDS) / _BANDS), len(rows)]
        bands = [(first, end) for first, end in pairwise(edges) if bright[first:end].any() and dark[first:end].any()]
        if not bands:
            raise CalibrationError("the camera does not see bars of 64 px: put up a bright surface, and focus")
        self._places = [[_some(mask, *band) for band in bands] for mask in (bright, dark)]

    def _unsaturated_s(self, probe: RigProbe) -> float:
        """Return the longest exposure at which the bars are not saturated, or about that of the longest cycle."""
        longest_s = self._studio.exposures_s[1]
        while longest_s > _LONGEST_S:
            self._studio.set_camera(longest_s, self._gain_db)
            self._studio.sleep(SURE_S)
            frame = shares(self._studio.take()[-1])
            if saturated_part(frame, probe.lit) < MAX_SATURATED:
                break
            longest_s *= _SHORTER
        return longest_s

    def variation(self, exposure_s: float, starts: int = _STARTS) -> Variation:
        """Return the variation at an exposure."""
        self._probe.show(self._bars)
        series = []
        for start in range(starts):
            real_s = self._studio.set_camera(exposure_s, self._gain_db)
            self._studio.sleep(_SETTLES_S if start else SURE_S)
            for _ in range(_TAKES):
                series += [self._bands(shares(frame)) for frame in self._studio.take()]
        bright, dark = np.moveaxis(np.array(series), 1, 0)  # each (frames, bands, 3)
        light = bright - dark
        # Of all channels together: short exposures may see none of one of them.
        mean = light.mean(axis=(0, 2))[:, None]
        relative = ((light - light.mean(axis=0)) / mean).reshape(-1, 3)
        room = ((dark - dark.mean(axis=0)) / mean).mean(axis=-1)
        correlation = np.corrcoef(relative.T)
        return Variation(
            exposure_s=real_s,
            projector=np.ptp(relative, axis=0),
            sigma=float(relative.std(axis=0).max()),
            room=float(room.std()),
            correlation=float(correlation[np.triu_indices(3, 1)].min()),
            light=float(light.mean()),
        )

    def _bands(self, frame: FloatArray) -> FloatArray:
        """Return the mean light of lit and dark bars, (2, bands, 3), of bands of rows."""
        return np.array([[self._to_light(frame[place]).mean(axis=0) for place in places] for places in self._places])

    def cycle(self, notify: Callable[[str], None] = lambda line: None) -> LightCycle | None:
        """Return the cycle of the light; None: the light is constant, or repeats with no period that cameras see."""
        shortest_s = max(self._studio.exposures_s[0], _SHORTEST_S)
        exposures_s = np.linspace(shortest_s, self._longest_s, _EXPOSURES)
        found = []
        for number, exposure_s in enumerate(exposures_s, start=1):
            notify(f"exposure {number} of {_EXPOSURES}")
            found.append(self.variation(float(exposure_s)))
        ranges = np.array([each.projector.max() for each in found])
        if np.percentile(ranges, 75) < _CONSTANT:
            return None
        real_s = np.array([each.exposure_s for each in found])
        period_s = _period(real_s, real_s * ranges)
        for aside in _ASIDE:
            period_s = self._refined(period_s, aside)
        usual = float(np.median(ranges))
        whole = LightCycle(period_s, in_turns=False).nearest_s(0.6 * self._longest_s)
        if self.variation(whole, _MORE_STARTS).projector.max() > max(_CONSTANT, _LEFT * usual):
            return None
        correlations = [each.correlation for each in found if each.projector.max() > usual]
        return LightCycle(period_s, in_turns=float(np.median(correlations)) < 0.5)

    def _refined(self, period_s: float, aside: float) -> float:
        """Return a period whose whole number lies where the range, which grows in proportion on both sides, is zero."""
        whole = max(1, int(self._longest_s / period_s - aside))
        longest_s = self._studio.exposures_s[1]
        below, above = (
            self.variation(min((whole + part) * period_s, longest_s), _MORE_STARTS) for part in (-aside, aside)
        )
        ranges = [each.exposure_s * each.projector.max() for each in (below, above)]
        zero_s = below.exposure_s + (above.exposure_s - below.exposure_s) * ranges[0] / sum(ranges)
        return float(zero_s) / whole


def _some(mask: npt.NDArray[np.bool_], first: int, end: int) -> tuple[npt.NDArray[np.intp], ...]:
    """Return the rows and columns of some of the pixels of a mask that lie in a band of rows."""
    y, x = np.nonzero(mask[first:end])
    step = max(1, len(y) // _PIXELS)
    return y[::step] + first, x[::step]


def _period(exposures_s: FloatArray, ranges: FloatArray) -> float:
    """Return the period of a function of the exposure, by its first two harmonics."""
    best, found_s = np.inf, _SHORTEST_S
    for period_s in np.exp(np.arange(np.log(_SHORTEST_S), np.log(_LONGEST_S), _STEP)):
        angle = 2 * np.pi * exposures_s / period_s
        model = np.stack([np.ones_like(angle), np.cos(angle), np.cos(2 * angle)], axis=1)
        residual = float(((ranges - model @ np.linalg.lstsq(model, ranges, rcond=None)[0]) ** 2).sum())
        if residual < best:
            best, found_s = residual, float(period_s)
    return found_s
