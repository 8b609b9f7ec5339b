"""Undo motion between the colours of a frame, where the projector shows them one after another.

A surface that moves while red, green and blue follow each other is seen at three phases: that of primary j is ahead by
v tau_j, with v the phase's change from frame to frame and tau_j the field's time beside the middle one's, in frames. A
fit of one phase to that is off by an error that changes twice a cycle. The image is therefore given the light that a
surface at rest would send back, and everything after it sees a frame of one moment:

    C + s T A M (p(phi) - p(phi + v tau)),    p = M^-1 t,

with s, T and A of `phase_fit.py`, M the crosstalk, t the template, and p_j what primary j sends. v is the phase's
change since the frame before, averaged over about a cycle, over which the error of either frame cancels. phi is that of
a first look, in which the motion still is; a second turn with the phase of the image at rest leaves a hundredth of it.
The first template is read off the frame as it is and has the mean change, the lag, in it.
"""

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
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.phase_fit import FittedPhase, doubted, node_model
from tikernels.phase.phase_vector import TINY, channel_mean, color_at
from tikernels.phase.surfaces import surface_at, surface_matrix
from tikernels.phase.wrapped_phase import LEAST_NO_PHASE, has_phase
from tikernels.raw.linearization import LEVEL_TYPES

# The change is averaged on a coarser grid, px.
_GRID_PX = 2
# It is known where this share of the window has a phase in both frames, and where it is less than a third of a cycle.
_FILLED, _FASTEST = 0.1, 2.0 * np.pi / 3
# What is undone is right to this fraction: surfaces speed up and turn.
_DOUBT = 0.2
#: Turns of fitting the phase and taking the motion out of the image.
MOTION_TURNS = 2


class FieldMotion(NamedTuple):
    """What moved between a frame's colours."""

    change: npt.NDArray[np.float32]
    """(H, W) rad, what the phase has changed by since the frame before; NaN where it is not known."""
    times: npt.NDArray[np.float64]
    """(3,) when red, green and blue are shown, beside the middle one, in times from frame to frame."""
    too_fast: float
    """Share of the pixels seen in both frames whose change is not told by them, because it is too fast."""

    def mean_change(self, modulation: F32) -> float:
        """Return the change, rad, that a template has in it which is read off this very frame.

        Parameters
        ----------
        modulation : (H, W) float32
            Levels; the template's samples count by its square.
        """
        weight = runtime.to_host(modulation) ** 2 * np.isfinite(self.change)
        total = (np.nan_to_num(self.change) * weight).sum(dtype=np.float64)
        return float(total / max(weight.sum(dtype=np.float64), TINY))


def measure_motion(phase: F32, before: F32, field_times: npt.NDArray[np.float64], period_px: float) -> FieldMotion:
    """Measure by how much the phase has changed around every pixel.

    Parameters
    ----------
    phase : (H, W) float32
        rad, modulo whole cycles; NO_PHASE where there is none.
    before : (H, W) float32
        The frame before; NaN where there is none.
    field_times : (3,)
        When red, green and blue are shown, in times from frame to frame.
    period_px : float
        Camera px a cycle.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    now = runtime.to_host(checks.read_array("phase", phase, (None, None), np.float32))
    then = runtime.to_host(checks.read_array("before", before, now.shape, np.float32))
    both = (now < LEAST_NO_PHASE) & np.isfinite(then)
    step = np.where(both, now - np.where(both, then, np.float32(0)), np.float32(0))
    size = (-(-now.shape[1] // _GRID_PX), -(-now.shape[0] // _GRID_PX))
    sigmas = (SIGMA_ALONG * period_px / _GRID_PX, SIGMA_ACROSS * period_px / _GRID_PX)

    def averaged(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
        coarse = cv2.resize(np.asarray(values, np.float32), size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.GaussianBlur(coarse, (0, 0), sigmas[0], sigmaY=sigmas[1]), np.float64)

    share = averaged(both)
    mean = averaged(both * np.cos(step)) + 1j * averaged(both * np.sin(step))
    change = np.angle(mean)
    told = np.abs(change) < _FASTEST
    filled = share > _FILLED
    change = np.where(told & filled, change, np.nan).astype(np.float32)
    everywhere = cv2.resize(change, now.shape[::-1], interpolation=cv2.INTER_NEAREST)
    seen = max(float(share[filled].sum()), TINY)
    times = np.asarray(field_times, np.float64) - np.sort(field_times)[1]
    return FieldMotion(np.asarray(everywhere, np.float32), times, float(share[filled & ~told].sum()) / seen)


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
        primaries: F32Array2,  # (7, 3) M, its inverse, and their times
        lag: f32,  # rad, what change the template has in it
        spacing: f32,  # px between two nodes
        out: F32Array3,  # (H, W, 3) levels
    ):
        for pixel in range(phase.shape[0] * phase.shape[1]):
            y, x = pixel // phase.shape[1], pixel % phase.shape[1]
            moved, seen = change[y, x], color_at(image, y, x)
            if has_phase(phase[y, x]) and not ti.math.isnan(moved):
                harmonics = load_harmonics(template)
                matrix, inverse, times = ti.Matrix.zero(f32, 3, 3), ti.Matrix.zero(f32, 3, 3), vec3(0.0)
                for row, column in ti.static(ti.ndrange(3, 3)):
                    matrix[row, column] = primaries[row, column]
                    inverse[row, column] = primaries[3 + row, column]
                    times[column] = primaries[6, column]
                v = ti.min(ti.max((y + 0.5) / spacing - 0.5, 0.0), ti.cast(nodes.shape[0] - 1, ti.f32))
                u = ti.min(ti.max((x + 0.5) / spacing - 0.5, 0.0), ti.cast(nodes.shape[1] - 1, ti.f32))
                j = ti.cast(u, ti.i32)
                color, _ambient = node_model(nodes, v, j)
                right_color, _right = node_model(nodes, v, j + 1)
                color += (u - j) * (right_color - color)
                at_once = shifted_cycle(harmonics, inverse, phase[y, x], -lag * times)
                in_turns = shifted_cycle(harmonics, inverse, phase[y, x], (moved - lag) * times)
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
    lag: float = 0.0,
    out: F32 | None = None,
) -> F32:
    """Return the image as it would be if nothing moved between its colours.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels, stripes along the rows.
    fit : FittedPhase
        What `fit_phase` found, of this image or of what an earlier turn made of it.
    motion : FieldMotion
        See `measure_motion`.
    model : ChannelModel
        What it was fitted with.
    crosstalk : Crosstalk
        The same.
    lag : float
        rad, what change the model's template has in it; see `FieldMotion.mean_change`.
    out : (H, W, 3) float32, optional
        Where the result goes.

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
    primaries = np.vstack([white, np.linalg.inv(white), motion.times]).astype(np.float32)
    look = (image, fit.phase, fit.brightness, change, surfaces.labels, surfaces.mixing, model.template, model.nodes)
    _hold_still_kernel(surfaces.mixed)(*look, primaries, lag, model.gains.spacing_px, out)
    return out


@kernel
def doubt_motion_kernel(
    change: F32Array2,  # (H, W) rad; NaN where it is not known
    spread: f32,  # of the times of the three primaries
    precision: F32Array2,  # (H, W) 1 / rad^2
    out_misfit: F32Array2,  # (H, W) in units of the precision's variance; added to
):
    for pixel in range(change.shape[0] * change.shape[1]):
        y, x = pixel // change.shape[1], pixel % change.shape[1]
        if not ti.math.isnan(change[y, x]):
            doubt = _DOUBT * spread * change[y, x]
            out_misfit[y, x] = doubted(out_misfit[y, x], doubt, precision[y, x])


def doubt_motion(motion: FieldMotion, precision: F32, out: F32) -> None:
    """Add to the phases' misfit what is unsure of a motion that was undone.

    Parameters
    ----------
    motion : FieldMotion
        See `measure_motion`.
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
    doubt_motion_kernel(change, float(np.std(motion.times)), precision, out)
