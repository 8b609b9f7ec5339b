"""Measure when in a cycle a projector's colours are on, and the time from one row of the camera to the next.

Row y of a frame that starts at the time t sees each colour for the part of [t + y row_s, t + y row_s + exposure] in
which it is on, modulo the cycle. In frames that start anywhere in the cycle, exposed for a part of it, each colour goes
on and off in ramps as long as the exposure.

The picture is of vertical bars: black, red, green, blue and white. Black bars show the room's light, which is
subtracted row by row. Bars of one colour show no other one, whatever the camera's channels see of it; the channel is
used that sees most of it, because cameras mix the colours of neighbouring pixels. White bars are brighter than the
three together where the projector has a white segment.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import log10

import numpy as np

from pipeline.acquisition.rig_faults import SURE_S, RigProbe, shares
from pipeline.models import FloatArray

# Black, red, green, blue and white; and the width of a bar, projector px.
_BARS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)], np.float64)
_BAR_PX = 64
# A pixel belongs to a bar whose middle half sends it this part of white: others are too far away to be mixed with it.
_MIDDLE, _OWN = (1 / 4, 3 / 4), 0.8
# Rows are averaged in this many bands at most: the rows of one are exposed nearly together.
_BANDS = 128
# Exposure in cycles: some frames see the ramp of each edge. A camera whose shortest exposure is longer than the most
# has two colours in nearly every frame.
_EXPOSED, _MOST_EXPOSED = 1 / 5, 1 / 3
# Light of the brightest pixels, of full scale, and most gain, dB: 8 bits hold little but noise beyond it.
_LIGHT, _MOST_GAIN_DB = 0.7, 24.0
# Starts of the camera, which may keep step with the projector; and how long after one it takes frames, s.
_STARTS, _SETTLES_S = 32, 0.2
# The cycle is known to this part before the fit; its first search, and that of the rows, has steps of so many cycles.
_KNOWN, _STEP = 3e-3, 0.05
# Overlaps of colours, and times from the first row to the last one, below this part of the cycle are none.
_NONE = 1e-3
# Standard deviation of the frames' times at first, s, and steps of the fit, which finds it.
_JITTER_S, _FIT_STEPS = 1e-4, 40
# Part of the values that is below a colour's full light: it is on for more than a tenth of the cycle.
_FULL = 97
# Standard deviation, in cycles, that an edge has which no frame shows.
_LOOSE = 0.5
# RMS residual that is left where lamp or wheel take a fifth of a field to change colours.
_MISFIT = 0.06
# Black that is clipped at the least of 256 levels hides this part of a colour's light.
_LEVEL = 1 / 255
# White bars have more light by this part where there is a white segment: a small one, of 60 degrees, makes it 0.6. Tone
# curves that are not known leave 0.16.
_WHITE = 0.25
# Standard deviations that are significant; edges are known where it is less than this part of the cycle.
_SIGMAS, _SHARP = 3.0, 0.02
# Parameters: frequency, rows, then when each of three colours goes on, how long it is on, and its brightness.
_ROW, _ON, _WIDTH, _BRIGHTNESS, _ERRORS = 1, slice(2, 5), slice(5, 8), slice(8, 11), slice(11, None)


@dataclass(frozen=True)
class MeasuredFields:
    """Times of a projector's colours and of a camera's rows."""

    period_s: float
    shown_s: FloatArray  # (3, 2) when red, green and blue go on and off, after red goes on
    shown_sigma_s: float  # largest standard deviation of these
    row_s: float  # from one row to the next one; 0: all rows at once
    row_sigma_s: float
    misfit: float  # RMS residual, as a part of a colour's light
    white: float  # light of white bars beyond that of the three colours, as a part of it

    @property
    def is_periodic(self) -> bool:
        """True where the light is that of colours that go on once per cycle, so that the times mean something."""
        return self.misfit < _MISFIT and self.shown_sigma_s < _SHARP * self.period_s

    @property
    def doubt(self) -> str | None:
        """Return why a rig file cannot state the colours' times; None: it can."""
        if self.misfit >= _MISFIT:
            return (
                f"light of colours that go on once per cycle leaves a residual of {self.misfit:.0%}: they go on more "
                "often, or the times of the frames are not exact (a webcam has no clock)"
            )
        if not self.is_periodic:
            return "the frames see a part of the cycle only: the camera keeps step with it, so change timing.period_s"
        if self.white > _WHITE:
            return (
                f"white has {self.white:.0%} more light than red, green and blue: switch off the white segment in the "
                "projector's menu (BrilliantColor, white boost)"
            )
        overlap_s = self._overlaps().max()
        if overlap_s > max(_SIGMAS * self.shown_sigma_s, _NONE * self.period_s):
            return (
                f"two colours are on at the same time for {1e3 * overlap_s:.3f} ms: switch off segments of mixed "
                "colours in the projector's menu (BrilliantColor)"
            )
        return None

    @property
    def apart_s(self) -> FloatArray:
        """`shown_s` without overlaps: a colour ends where the next one begins."""
        shown_s = self.shown_s.copy()
        shown_s[:, 1] -= np.maximum(self._overlaps(), 0)
        return shown_s

    def _overlaps(self) -> FloatArray:
        """Return for how long each colour is on together with the one after it, (3,) s; below 0: it is dark between."""
        on, off = self.shown_s.T
        order = np.argsort(on)
        overlaps = np.empty(3)
        overlaps[order] = off[order] - np.append(on[order[1:]], on[order[0]] + self.period_s)
        return overlaps


def measure_fields(
    probe: RigProbe, to_light: Callable[[FloatArray], FloatArray], period_s: float, light_per_s: float
) -> MeasuredFields | str:
    """Measure the times of colours and rows by short exposures, or return why they cannot be known.

    Parameters
    ----------
    probe : RigProbe
        Projector and camera; `look` was called.
    to_light : callable
        The inverse of the camera's tone curve.
    period_s : float
        The cycle of the projector's light, to three thousandths.
    light_per_s : float
        Light of the brightest pixels under white, of full scale, per exposure without gain.
    """
    studio = probe.studio
    shortest_s = studio.exposures_s[0]
    if shortest_s > _MOST_EXPOSED * period_s:
        return f"the camera's shortest exposure, {1e3 * shortest_s:.3f} ms, is longer than a third of the cycle"
    studio.set_camera(period_s, 0.0)
    width, height = studio.projector_px
    across, bar = np.modf(np.arange(width) / _BAR_PX)
    bar %= len(_BARS)
    is_middle = (across > _MIDDLE[0]) & (across < _MIDDLE[1])
    black, white = probe.settled(0.0), probe.settled(1.0)
    middles = [np.broadcast_to((is_middle & (bar == n))[:, None], (height, width, 3)) for n in range(len(_BARS))]
    seen = np.array([(probe.frames(1.0 * middle, 1)[-1] - black).mean(axis=-1) for middle in middles])
    own = probe.lit & (seen > _OWN * (white - black).mean(axis=-1))
    rows = np.flatnonzero(own.any(axis=2).all(axis=0))
    if not len(rows):
        return f"the camera does not see black, red, green, blue and white bars of {_BAR_PX} px side by side"
    weights = own[:, rows] / own[:, rows].sum(axis=2, keepdims=True)
    bands = np.array_split(np.arange(len(rows)), min(_BANDS, len(rows)))
    # A colour has all of its light in a third of the cycle.
    exposure_s = max(min(_EXPOSED * period_s, _LIGHT / (3 * light_per_s)), shortest_s)
    gain_db = min(max(0.0, 20 * log10(_LIGHT / (3 * light_per_s * exposure_s))), _MOST_GAIN_DB)
    probe.show(np.broadcast_to(_BARS[bar.astype(int)], (height, width, 3)))
    light, times_s = [], []
    for start in range(_STARTS):
        real_s = studio.set_camera(exposure_s, round(gain_db, 1))
        studio.sleep(_SETTLES_S if start else SURE_S)
        for frame in studio.take():
            means = np.einsum("brw,rwc->rbc", weights, to_light(shares(frame)[rows]))
            light.append([(means[band, 1:] - means[band, :1]).mean(axis=0) for band in bands])
        times_s += studio.taken_s
    heights = np.array([rows[band].mean() for band in bands])
    return fit_fields(np.array(light), np.array(times_s), heights, real_s, period_s)


def fit_fields(
    light: FloatArray, times_s: FloatArray, rows: FloatArray, exposure_s: float, period_s: float
) -> MeasuredFields:
    """Fit the times of colours and rows to light.

    The light of each colour is a rectangle in the cycle, averaged over the exposure. The time of each frame has an
    error, whose variance is found by expectation maximisation.

    Parameters
    ----------
    light : (F, B, 4, 3)
        Of red, green, blue and white bars, in frames and bands of rows, in the camera's channels.
    times_s : (F,)
        Times of the exposures, plus a constant.
    rows : (B,)
        Middles of the bands.
    exposure_s : float
        Of all frames.
    period_s : float
        The cycle, to three thousandths.
    """
    total = light.sum(axis=(0, 1))
    white = float(total[3].sum() / total[:3].sum() - 1)
    values = light[..., range(3), total[:3].argmax(axis=-1)]
    values = values / np.percentile(values, _FULL, axis=(0, 1))
    times_s, rows = times_s - times_s.mean(), rows - rows.mean()
    period_s, row, edges = _first_guess(values, times_s, rows, exposure_s, period_s)
    # All times are in cycles of that guess.
    times, exposed, variance = times_s / period_s, exposure_s / period_s, (_JITTER_S / period_s) ** 2
    x = np.concatenate([[1.0, row], *edges, np.ones(3), np.zeros(len(times))])
    damping = 1e-3
    for _ in range(_FIT_STEPS):
        seen, slopes = _model(x, times, rows, exposed)
        residual = (values - seen).ravel()
        noise = float((residual**2).mean())
        prior = np.full(len(x), _LOOSE**-2)
        prior[_ERRORS] = 1 / variance
        normal, pull = slopes.T @ slopes / noise + np.diag(prior), slopes.T @ residual / noise
        pull[_ERRORS] -= x[_ERRORS] / variance
        moved = x + np.linalg.solve(normal + damping * np.diag(np.diag(normal)), pull)
        after = ((values - _model(moved, times, rows, exposed)[0]) ** 2).sum() / noise
        gain = (residual**2).sum() / noise - after + ((x[_ERRORS] ** 2).sum() - (moved[_ERRORS] ** 2).sum()) / variance
        x, damping = (moved, damping / 10) if gain > 0 else (x, damping * 10)
        covariance = np.linalg.inv(normal)
        variance = float((x[_ERRORS] ** 2 + np.diag(covariance)[_ERRORS]).mean())
    # Edges, after red goes on, by the parameters.
    from_red = np.zeros((3, 2, len(x)))
    from_red[range(3), :, range(2, 5)] = 1
    from_red[range(3), 1, range(5, 8)] = 1
    from_red[..., 2] -= 1
    sigma = np.sqrt(np.einsum("...i,ij,...j", from_red, covariance, from_red))
    on = (x[_ON] - x[2]) % 1
    period_s /= x[0]
    # A part that is missing of a ramp's light moves its middle by as much of it.
    misfit, height = float(np.sqrt(noise)), float(np.ptp(rows))
    bent_s = (misfit + _LEVEL) * exposure_s
    row_s = float(period_s * x[_ROW] * x[0])
    row_sigma_s = float(np.hypot(period_s * np.sqrt(covariance[_ROW, _ROW]), bent_s / height))
    rolls = abs(row_s) > max(_SIGMAS * row_sigma_s, _NONE * period_s / height)
    return MeasuredFields(
        period_s=float(period_s),
        shown_s=period_s * np.stack([on, on + x[_WIDTH]], axis=1),
        shown_sigma_s=float(np.hypot(period_s * sigma.max(), bent_s)),
        row_s=row_s if rolls else 0.0,
        row_sigma_s=row_sigma_s,
        misfit=misfit,
        white=white,
    )


def _model(x: FloatArray, times: FloatArray, rows: FloatArray, exposed: float) -> tuple[FloatArray, FloatArray]:
    """Return the light of three colours, (F, B, 3), and its derivatives, (F B 3, parameters)."""
    passed = (times + x[_ERRORS])[:, None] + x[_ROW] * rows
    start, exposed = x[0] * passed[..., None] - x[_ON], x[0] * exposed
    width, brightness = x[_WIDTH], x[_BRIGHTNESS]

    def lit(until: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return how long colours have been on, and its derivatives by time and width."""
        whole = np.floor(until)
        rest = until - whole
        return whole * width + np.minimum(rest, width), np.asarray(rest < width, np.float64), whole + (rest >= width)

    seen, by_time, by_width = (
        (late - early) / exposed for late, early in zip(lit(start + exposed), lit(start), strict=True)
    )
    by_time = brightness * by_time
    slopes = np.zeros((*seen.shape, len(x)))
    slopes[..., 0] = by_time * passed[..., None]
    slopes[..., _ROW] = by_time * x[0] * rows[:, None]
    for colour in range(3):
        slopes[..., colour, 2 + colour] = -by_time[..., colour]
        slopes[..., colour, 5 + colour] = brightness[colour] * by_width[..., colour]
        slopes[..., colour, 8 + colour] = seen[..., colour]
    frames = np.arange(len(times))
    slopes[frames, ..., _ERRORS.start + frames] = x[0] * by_time
    return brightness * seen, slopes.reshape(-1, len(x))


def _first_guess(
    values: FloatArray, times_s: FloatArray, rows: FloatArray, exposure_s: float, period_s: float
) -> tuple[float, float, tuple[FloatArray, FloatArray]]:
    """Return period, rows in cycles, and when colours go on and for how long, by the first waves of their light.

    The period and the rows' time are those at which the light of all frames and rows adds up to the largest wave.
    """
    half = max(1.0, np.ceil(_KNOWN * np.ptp(times_s) / period_s / _STEP))
    periods_s = period_s * (1 + _KNOWN * np.arange(-half, half + 1) / half)
    # A camera reads all rows before the next frame.
    longest_s = np.diff(np.sort(times_s)).min() / np.ptp(rows)
    rows_s = np.linspace(0, longest_s, 1 + int(np.ceil(longest_s * np.ptp(rows) / period_s / _STEP)))
    by_frame = np.exp(-2j * np.pi * np.outer(1 / periods_s, times_s))
    by_row = np.exp(-2j * np.pi * np.outer(rows_s, rows) / period_s)
    waves = np.einsum("pf,rb,fbc->prc", by_frame, by_row, values - values.mean(axis=(0, 1)), optimize=True)
    power = (np.abs(waves) ** 2).sum(axis=-1)
    period, row = np.unravel_index(power.argmax(), power.shape)
    found_s = float(periods_s[period])
    angle = 2 * np.pi * np.add.outer(times_s, rows_s[row] * rows).ravel() / found_s
    waves = np.stack([np.ones_like(angle), *(wave(n * angle) for n in (1, 2) for wave in (np.cos, np.sin))], axis=1)
    mean, cosine, sine = np.linalg.lstsq(waves, values.reshape(-1, 3), rcond=None)[0][:3]
    width = np.clip(mean, 0.1, 0.9)
    # Exposures are counted from their start.
    middle = np.arctan2(sine, cosine) / (2 * np.pi) + exposure_s / found_s / 2
    return found_s, float(rows_s[row] / found_s), (middle - width / 2, width)
