"""Undo motion between the colours of a frame, where the projector shows them one after another.

A surface that moves while red, green and blue follow each other is seen at three phases: that of primary j is ahead by
v tau_j, with v the phase's change from frame to frame and tau_j the colour's mean time after the middle of the
exposure, in frames (`color_fields.py`). A fit of one phase to that is off by

    -v / 3 sum_j tau_j cos(2 phi + 2 d_j),    d_j the channel's delay,

twice per cycle. Where it is not known when an exposure starts, that term in the first fit's phase distinguishes the
times: each hypothesis of `ColorFields` predicts another one, and its likelihood is that of what it leaves. The times
that are used are the mean over all hypotheses, and their spread is the uncertainty.

The image is given the light that a surface at rest would send back, and everything after it sees a frame of one moment:

    C + s T A M (p(phi) - p(phi + v tau)),    p = M^-1 t,

with s, T and A of `phase_fit.py`, M the crosstalk, t the template, and p_j what primary j sends. v is the phase's
change since the frame before, averaged over about a cycle, over which the error of either frame cancels. phi is that of
a first fit, in which the motion still is. Its template is read off the frame as it is and has the mean of v tau_j, the
lags, in it.

A rolling shutter exposes row after row, and what moves is sheared by that. At the end of the chain the phase of a row
that is exposed t frames after the middle one is carried to the middle one's time: it loses v t. Here both frames are as
of one moment, so that v is averaged over a part of a cycle only and follows the surface.
"""

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array2, F32Array3, Static, U8Array2, f32, ti, vec3
from tikernels.arrays import F32, LevelsImage
from tikernels.launching import kernel
from tikernels.phase.balance_window import SIGMA_ACROSS, SIGMA_ALONG
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.channel_template import cycle_and_slope, load_harmonics
from tikernels.phase.color_fields import ColorFields
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import MEDIAN_SIZE
from tikernels.phase.phase_fit import FittedPhase, doubted, node_model
from tikernels.phase.phase_vector import TINY, channel_delays, channel_mean, color_at
from tikernels.phase.surfaces import surface_at, surface_matrix
from tikernels.phase.wrapped_phase import LEAST_NO_PHASE, has_phase
from tikernels.raw.linearization import LEVEL_TYPES

# The change is averaged on a coarser grid, px; between rows over this part of the window that fields need, for curved
# things change unevenly, and noise must not grow by carrying it.
_GRID_PX, _ROW_WINDOW = 2, 0.25
# It is known where this share of the window has a phase in both frames, and where it is less than a third of a cycle.
_FILLED, _FASTEST = 0.1, 2.0 * np.pi / 3
# Standard deviation of what is undone, as a fraction of it, after one time from frame to frame: surfaces speed up and
# turn, the more the longer ago the frame before is. From which fraction on the motion is a guess.
_DOUBT, _GUESS = 0.2, 0.5
# The change of the error over a cycle is sampled this often; half a cycle both ways is one independent sample, for so
# far texture and compression reach.
_SAMPLES = 8
# Neighbourhood that the phase is compared with, standard deviations along and across the stripes in cycles: a second
# harmonic averages out, and no more of the surface's shape than need be. It is known where so much of it is seen.
_ALONG, _ACROSS, _SURE = 0.3, 1.0, 0.9
# Deviations of this many standard deviations count half: edges and textures are off by more than noise.
_HALF_SIGMAS = 2.0
# Times are distinguished if less than this part of them is unsure.
_DISTINCT = 0.5
# Phase that motion may leave unnoticed, rad: the noise of good frames.
_UNNOTICED = 0.01


class FieldMotion(NamedTuple):
    """Motion between a frame's colours."""

    change: npt.NDArray[np.float32]
    """(H, W) rad, what the phase has changed by since the frame before; NaN where it is not known."""
    times: npt.NDArray[np.float32]
    """(H or 1, W or 1, 3) when red, green and blue are seen, after the middle of a row's exposure, in times from frame
    to frame."""
    unsure: npt.NDArray[np.float32]
    """(H or 1, W or 1) their standard deviation."""
    shares: npt.NDArray[np.float64]
    """(hypotheses,) probability of each of `ColorFields`."""
    too_fast: float
    """Share of the pixels seen in both frames whose change they do not show, because it is too fast."""
    doubt: float = _DOUBT
    """Standard deviation of what is undone, as a fraction of it."""

    @property
    def guessed(self) -> float:
        """Share of the pixels that move so much that it shows, while the frame before is too long ago to know by it."""
        return _moving_share(self.change, self.times.std(axis=-1)) if self.doubt >= _GUESS else 0.0

    @property
    def unknown(self) -> float:
        """Share of the pixels that move so much that it shows, while the colours' times are not distinguished."""
        unsure = np.where(self.unsure > _DISTINCT * self.times.std(axis=-1), self.unsure, 0)
        return _moving_share(self.change, unsure)

    def lags(self, modulation: F32) -> npt.NDArray[np.float64]:
        """Return (3,) rad, the phase that each primary's template has in it which is read off this very frame.

        Parameters
        ----------
        modulation : (H, W) float32
            Levels; the template's samples count by its square.
        """
        weight = runtime.to_host(modulation) ** 2 * np.isfinite(self.change)
        ahead = _summed(np.nan_to_num(self.change) * weight, self.times.shape)
        return np.asarray(np.tensordot(ahead, self.times, axes=2) / max(weight.sum(dtype=np.float64), TINY))


class RowMotion(NamedTuple):
    """Motion between a frame's rows."""

    change: npt.NDArray[np.float32]
    """(H, W) rad, what the phase has changed by since the frame before; NaN where it is not known."""
    times: npt.NDArray[np.float32]
    """(H or 1, W or 1) when a row is exposed, after the middle one, in times from frame to frame."""
    too_fast: float
    """Share of the pixels seen in both frames whose change is a third of a cycle or more."""
    doubt: float = _DOUBT
    """See `FieldMotion`."""

    @property
    def guessed(self) -> float:
        """See `FieldMotion`."""
        return _moving_share(self.change, np.abs(self.times)) if self.doubt >= _GUESS else 0.0

    @property
    def since_middle(self) -> npt.NDArray[np.float32]:
        """(H, W) rad, by how much the phase changes from the middle row's exposure to a row's own; 0: not known."""
        return np.asarray(np.nan_to_num(self.change) * self.times)


def _moving_share(change: npt.NDArray[np.float32], times: npt.NDArray[np.float32]) -> float:
    """Return the share of the pixels with a change, (H, W) rad, that moves noticeably in (H or 1, W or 1) times."""
    moving = np.count_nonzero(np.abs(np.nan_to_num(change)) * times > _UNNOTICED)
    return float(moving / max(int(np.count_nonzero(np.isfinite(change))), 1))


def measure_rows(
    unwrapped: F32, before: F32, row: float, period_px: float, *, elapsed: float = 1.0, rows_last: bool = False
) -> RowMotion:
    """Measure by how much the phase changes while a frame's rows are exposed one after another.

    Parameters
    ----------
    unwrapped, before : (H, W) float32
        rad, of a frame and of the one before, as their rows were exposed; NaN where there is none.
    row : float
        From one row's exposure to the next one's, in times from frame to frame.
    period_px : float
        Camera px per cycle.
    elapsed : float
        Since the frame before, in times from frame to frame.
    rows_last : bool
        True if the camera's rows are the image's columns.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    now = runtime.to_host(checks.read_array("unwrapped", unwrapped, (None, None), np.float32))
    then = runtime.to_host(checks.read_array("before", before, now.shape, np.float32))
    step = now - then
    change, too_fast = _averaged_change(step, np.isfinite(step), _ROW_WINDOW * period_px)
    rows = now.shape[1 if rows_last else 0]
    after = row / elapsed * (np.arange(rows) - 0.5 * (rows - 1))
    times = np.expand_dims(after, 0 if rows_last else 1).astype(np.float32)
    return RowMotion(change, times, too_fast, _doubt_after(elapsed))


def _averaged_change(
    step: npt.NDArray[np.float32], known: npt.NDArray[np.bool_], window_px: float
) -> tuple[npt.NDArray[np.float32], float]:
    """Return (H, W) rad, the mean change around each pixel, NaN where not known, and the share too fast."""
    step = np.where(known, step, np.float32(0))
    size = (-(-step.shape[1] // _GRID_PX), -(-step.shape[0] // _GRID_PX))
    sigmas = (SIGMA_ALONG * window_px / _GRID_PX, SIGMA_ACROSS * window_px / _GRID_PX)

    def averaged(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
        coarse = cv2.resize(np.asarray(values, np.float32), size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.GaussianBlur(coarse, (0, 0), sigmas[0], sigmaY=sigmas[1]), np.float64)

    share = averaged(known)
    mean = averaged(known * np.cos(step)) + 1j * averaged(known * np.sin(step))
    change = np.angle(mean)
    slow = np.abs(change) < _FASTEST
    filled = share > _FILLED
    change = np.where(slow & filled, change, np.nan).astype(np.float32)
    too_fast = float(share[filled & ~slow].sum()) / max(float(share[filled].sum()), TINY)
    return np.asarray(cv2.resize(change, step.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32), too_fast


def measure_motion(
    phase: F32,
    before: F32,
    fields: ColorFields,
    shares: npt.NDArray[np.float64] | None,
    period_px: float,
    *,
    elapsed: float = 1.0,
    rows_last: bool = False,
) -> FieldMotion:
    """Measure by how much the phase has changed around every pixel, and when the colours were seen.

    Parameters
    ----------
    phase : (H, W) float32
        rad, modulo whole cycles; NO_PHASE where there is none.
    before : (H, W) float32
        The frame before; NaN where there is none.
    fields : ColorFields
        Times of the projector's colours.
    shares : (hypotheses,), optional
        Of the frame before; None: not known.
    period_px : float
        Camera px per cycle.
    elapsed : float
        Since the frame before, in times from frame to frame.
    rows_last : bool
        True if the camera's rows are the image's columns.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    now = runtime.to_host(checks.read_array("phase", phase, (None, None), np.float32))
    then = runtime.to_host(checks.read_array("before", before, now.shape, np.float32))
    both = (now < LEAST_NO_PHASE) & np.isfinite(then)
    then = np.where(both, then, np.float32(0))
    step = np.where(both, now - then, np.float32(0))
    change, too_fast = _averaged_change(step, both, period_px)
    fields = replace(fields, cycle=fields.cycle / elapsed)
    rows = 1 if fields.row == 0 else now.shape[1 if rows_last else 0]
    times = np.expand_dims(fields.times(rows), 1 if rows_last else 2)
    expected = fields.expect(shares)
    if len(expected) > 1:
        unwrapped = np.where(both, then + step - 2 * np.pi * np.rint(step / (2 * np.pi)), 0).astype(np.float32)
        likelihood = _log_likelihood(unwrapped, np.where(both, change, np.nan), times, period_px, _doubt_after(elapsed))
        expected *= np.exp(likelihood - likelihood.max())
        expected /= expected.sum()
    mean_times = np.tensordot(expected, times, axes=1)
    spread = np.tensordot(expected, (times - mean_times) ** 2, axes=1).mean(axis=-1)
    unsure = np.sqrt(spread).astype(np.float32)
    return FieldMotion(change, mean_times.astype(np.float32), unsure, expected, too_fast, _doubt_after(elapsed))


def _doubt_after(elapsed: float) -> float:
    return min(1.0, _DOUBT * elapsed)


def _summed(values: npt.NDArray[np.float32], shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Return sums of (H, W) over those axes that a shape (H or 1, W or 1, ...) has not."""
    axes = tuple(axis for axis in (0, 1) if shape[axis] == 1)
    return np.asarray(values.sum(axis=axes, keepdims=True, dtype=np.float64))


def _log_likelihood(
    phase: npt.NDArray[np.float32],
    change: npt.NDArray[np.float32],
    times: npt.NDArray[np.float64],
    period_px: float,
    doubt: float,
) -> npt.NDArray[np.float64]:
    """Return that of times (N, H or 1, W or 1, 3), by the second harmonic that motion puts into a phase (H, W), rad."""
    every = max(1, int(period_px / _SAMPLES))
    phase, change = phase[::every, ::every], change[::every, ::every]
    times = times[:, slice(None, None, every), slice(None, None, every)]
    seen = np.isfinite(change).astype(np.float32)

    def around(values: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        sigmas = (_ALONG * period_px / every, _ACROSS * period_px / every)
        return np.asarray(cv2.GaussianBlur(values, (0, 0), sigmas[0], sigmaY=sigmas[1]), np.float32)

    share = around(seen)
    straight = seen * (phase - around(seen * phase) / np.maximum(share, TINY))
    deviation = straight - around(straight) / np.maximum(share, TINY)  # without what bends
    sure = (seen > 0) & (share > _SURE)
    if not sure.any():
        return np.zeros(len(times))
    size = float(np.median(np.abs(deviation[sure]))) / MEDIAN_SIZE
    weight = sure / (1 + (deviation / max(_HALF_SIGMAS * size, TINY)) ** 2)
    # The effect of motion on these two waves; and the waves themselves, the same all over the frame, as a template
    # leaves them that has the mean motion in it: they are fitted to what each hypothesis leaves.
    both = np.stack([np.cos(2 * phase), np.sin(2 * phase)])
    waves, delays, shape = np.nan_to_num(change) * both, channel_delays(), times.shape[1:]
    factors = np.stack([-(times @ np.cos(2 * delays)) / 3, times @ np.sin(2 * delays) / 3])
    explained, predicted = np.zeros(len(times)), np.zeros(len(times))  # sums of squares
    left = np.tile(np.tensordot(weight * both, deviation, axes=2), (len(times), 1))
    for factor, wave in zip(factors, waves, strict=True):
        explained += 2 * (factor * _summed(weight * wave * deviation, shape)).sum(axis=(1, 2))
        for other, other_wave in zip(factors, waves, strict=True):
            predicted += (factor * other * _summed(weight * wave * other_wave, shape)).sum(axis=(1, 2))
        for k in range(2):
            left[:, k] -= (factor * _summed(weight * both[k] * wave, shape)).sum(axis=(1, 2))
    normal = np.tensordot(weight * both, both, axes=((1, 2), (1, 2))) + TINY * np.eye(2)
    explained += (left * np.linalg.solve(normal, left.T).T).sum(axis=1) - predicted
    variance = float((weight * deviation**2).sum() / max(weight.sum(), TINY))
    samples = (2 * every / period_px) ** 2 / max(variance, TINY)
    # More samples do not help beyond what a prediction is off by itself.
    return np.asarray(0.5 * samples * explained / (1 + doubt**2 * samples * predicted[explained.argmax()]))


@ti.func
def shifted_cycle(harmonics: Static, unmixing: Static, phase: f32, offsets: vec3) -> vec3:
    """Return what each primary sends while its fringe is ahead by an offset, rad, given the channels' template."""
    sent = vec3(0.0)
    for primary in ti.static(range(3)):
        cycle, _slope = cycle_and_slope(harmonics, phase + offsets[primary])
        sent[primary] = (unmixing @ cycle)[primary]
    return sent


@cache
def _hold_still_kernel(mixed: bool) -> Any:
    @kernel
    def hold_still_kernel(
        image: AnyArray3,  # (H, W, 3) levels
        phase: F32Array2,  # (H, W) rad
        brightness: F32Array2,  # (H, W) levels
        change: F32Array2,  # (H, W) rad; NaN where it is not known
        labels: U8Array2,  # (H, W) see `Surfaces`
        mixing: F32Array3,  # (N, 3, 3)
        template: F32Array2,  # (3, terms)
        nodes: F32Array3,  # (Hg, Wg, 6) A and B
        primaries: F32Array2,  # (7, 3) M, its inverse, and the phase that the template has of them, rad
        times: F32Array3,  # (H or 1, W or 1, 3) when the primaries are seen, in times from frame to frame
        spacing: f32,  # px between two nodes
        out: F32Array3,  # (H, W, 3) levels
    ):
        for pixel in range(phase.shape[0] * phase.shape[1]):
            y, x = pixel // phase.shape[1], pixel % phase.shape[1]
            moved, seen = change[y, x], color_at(image, y, x)
            if has_phase(phase[y, x]) and not ti.math.isnan(moved):
                harmonics = load_harmonics(template)
                matrix, inverse, lags = ti.Matrix.zero(f32, 3, 3), ti.Matrix.zero(f32, 3, 3), vec3(0.0)
                for row, column in ti.static(ti.ndrange(3, 3)):
                    matrix[row, column] = primaries[row, column]
                    inverse[row, column] = primaries[3 + row, column]
                    lags[column] = primaries[6, column]
                v = ti.min(ti.max((y + 0.5) / spacing - 0.5, 0.0), ti.cast(nodes.shape[0] - 1, ti.f32))
                u = ti.min(ti.max((x + 0.5) / spacing - 0.5, 0.0), ti.cast(nodes.shape[1] - 1, ti.f32))
                j = ti.cast(u, ti.i32)
                color, _ambient = node_model(nodes, v, j)
                right_color, _right = node_model(nodes, v, j + 1)
                color += (u - j) * (right_color - color)
                seen_at = color_at(times, ti.min(y, times.shape[0] - 1), ti.min(x, times.shape[1] - 1))
                at_once = shifted_cycle(harmonics, inverse, phase[y, x], -lags)
                in_turns = shifted_cycle(harmonics, inverse, phase[y, x], moved * seen_at - lags)
                added = color * (matrix @ (in_turns - at_once))
                if ti.static(mixed):
                    surface = surface_matrix(mixing, surface_at(labels, y, x))
                    added, color = surface @ added, surface @ color
                seen -= brightness[y, x] / ti.max(channel_mean(color), TINY) * added
            for k in ti.static(range(3)):
                out[y, x, k] = seen[k]

    return hold_still_kernel


def hold_still(
    image: LevelsImage,
    fit: FittedPhase,
    motion: FieldMotion,
    model: ChannelModel,
    crosstalk: Crosstalk,
    lags: npt.ArrayLike = (0.0, 0.0, 0.0),
    out: F32 | None = None,
) -> F32:
    """Return the image as it would be if nothing moved between its colours.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels, stripes along the rows.
    fit : FittedPhase
        Of `fit_phase`, of this image or of the result of an earlier pass.
    motion : FieldMotion
        See `measure_motion`.
    model : ChannelModel
        Model of the fit.
    crosstalk : Crosstalk
        The same.
    lags : (3,)
        rad, the phase that the model's template has in it; see `FieldMotion.lags`.
    out : (H, W, 3) float32, optional
        Output array.

    Returns
    -------
    (H, W, 3) float32
        Levels; as they were where no phase or no change is known. A buffer of the device if none is given.

    Raises
    ------
    ShapeError
        A shape or dtype is another one, or `out` cannot be written.
    """
    shape = (model.gains.height, model.gains.width)
    image = checks.read_array("image", image, (*shape, 3), *LEVEL_TYPES)
    change = checks.read_array("change", motion.change, shape, np.float32)
    out = checks.out_buffer("out", out, (*shape, 3), np.float32)
    white, surfaces = crosstalk.matrix.astype(np.float64), crosstalk.surfaces
    primaries = np.vstack([white, np.linalg.inv(white), lags]).astype(np.float32)
    look = (image, fit.phase, fit.brightness, change, surfaces.labels, surfaces.mixing, model.template, model.nodes)
    _hold_still_kernel(surfaces.mixed)(*look, primaries, motion.times, model.gains.spacing_px, out)
    return out


@kernel
def doubt_motion_kernel(
    change: F32Array2,  # (H, W) rad; NaN where it is not known
    doubts: F32Array2,  # (H or 1, W or 1) standard deviation of the primaries' times, in times from frame to frame
    precision: F32Array2,  # (H, W) 1 / rad^2
    out_misfit: F32Array2,  # (H, W) in units of the precision's variance; added to
):
    for pixel in range(change.shape[0] * change.shape[1]):
        y, x = pixel // change.shape[1], pixel % change.shape[1]
        if not ti.math.isnan(change[y, x]):
            doubt = change[y, x] * doubts[ti.min(y, doubts.shape[0] - 1), ti.min(x, doubts.shape[1] - 1)]
            out_misfit[y, x] = doubted(out_misfit[y, x], doubt, precision[y, x])


def doubt_motion(motion: FieldMotion | RowMotion, precision: F32, out: F32) -> None:
    """Add to the phases' misfit what is unsure of a motion that was undone, or is left for want of times.

    Parameters
    ----------
    motion : FieldMotion or RowMotion
        See `measure_motion` and `measure_rows`.
    precision : (H, W) float32
        1 / rad^2, one over the phase's variance.
    out : (H, W) float32
        The misfit, in units of that variance, which is added to.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    precision = checks.read_array("precision", precision, (None, None), np.float32)
    shape = (int(precision.shape[0]), int(precision.shape[1]))
    change = checks.read_array("change", motion.change, shape, np.float32)
    out = checks.out_buffer("misfit", out, shape, np.float32)
    if isinstance(motion, RowMotion):
        doubts = np.abs(motion.doubt * motion.times)
    else:
        doubts = np.hypot(motion.doubt * motion.times.std(axis=-1), motion.unsure)
    doubt_motion_kernel(change, doubts, precision, out)
