"""Undo motion between the colours of a frame, where the projector shows them one after another.

A surface that moves while red, green and blue follow each other is seen at three phases: primary j's is off by v tau_j,
with v the phase's change from frame to frame and tau_j the field's time beside the middle one's, in frames. The fit
turns that into an error that changes twice a cycle. To first order the fit's phase is off by

    v (E . M_tau') / (E . D),    M_tau' = K diag(tau) p'(phi),

with K p what the channels see of the projector's light, and E and D of `phase_fit.py`. With p = M^-1 t that is
K diag(tau) p' = T A M diag(tau) M^-1 t', all of which is known. v is the phase's change since the frame before,
averaged over about a cycle, over which the error of either frame cancels. A template that is read off the frame itself
has the mean of that motion in it already, as a lag of its channels.
"""

from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array2, F32Array3, U8Array2, f32, ti
from tikernels.arrays import F32, LevelsImage
from tikernels.phase.balance_window import SIGMA_ACROSS, SIGMA_ALONG
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.channel_template import cycle_and_slope, load_harmonics
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_fit import estimator_of, model_at, node_model
from tikernels.phase.phase_vector import color_at, matrix_of
from tikernels.phase.surfaces import surface_at, surface_matrix
from tikernels.phase.wrapped_phase import LEAST_NO_PHASE, has_phase
from tikernels.raw.linearization import LEVEL_TYPES

# The change is averaged on a coarser grid, px.
_GRID_PX = 2
# It is known where this share of the window has a phase in both frames, where these agree as well as this, as the
# length of the mean unit vector, and where it is less than a third of a cycle.
_FILLED, _AGREEMENT, _FASTEST = 0.1, 0.8, 2.0 * np.pi / 3
# What is undone is right to this fraction: surfaces speed up and turn.
_DOUBT = 0.2


class FieldMotion(NamedTuple):
    """What moved between a frame's colours."""

    change: npt.NDArray[np.float32]
    """(H, W) rad, what the phase has changed by since the frame before; NaN where it is not known."""
    times: npt.NDArray[np.float64]
    """(3,) when red, green and blue are shown, beside the middle one, in times from frame to frame."""
    too_fast: float
    """Share of the pixels seen in both frames whose change is not told by them, because it is too fast."""

    def beyond_mean(self, modulation: F32) -> "FieldMotion":
        """Return what is left where a template that was read off this very frame has taken the mean motion in.

        Parameters
        ----------
        modulation : (H, W) float32
            Levels; the template's samples count by its square.
        """
        weight = runtime.to_host(modulation) ** 2 * np.isfinite(self.change)
        mean = (np.nan_to_num(self.change) * weight).sum(dtype=np.float64) / max(weight.sum(dtype=np.float64), 1e-9)
        return self._replace(change=self.change - np.float32(mean))

    def offsets(self, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp]) -> npt.NDArray[np.float64]:
        """Return by how much the phases of red, green and blue are ahead at some pixels, (..., 3) rad."""
        return np.asarray(np.nan_to_num(self.change[rows, columns])[..., None] * self.times, np.float64)


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
    told = (np.abs(mean) > _AGREEMENT * share) & (np.abs(change) < _FASTEST)
    filled = share > _FILLED
    change = np.where(told & filled, change, np.nan).astype(np.float32)
    everywhere = cv2.resize(change, now.shape[::-1], interpolation=cv2.INTER_NEAREST)
    seen = max(float(share[filled].sum()), 1e-6)
    times = np.asarray(field_times, np.float64) - np.sort(field_times)[1]
    return FieldMotion(np.asarray(everywhere, np.float32), times, float(share[filled & ~told].sum()) / seen)


@cache
def _undo_motion_kernel(mixed: bool) -> Any:
    @ti.kernel
    def undo_motion_kernel(
        image: AnyArray3,  # (H, W, 3) levels
        change: F32Array2,  # (H, W) rad; NaN where it is not known
        labels: U8Array2,  # (H, W) see `Surfaces`
        mixing: F32Array3,  # (N, 3, 3)
        besides: F32Array2,  # (N, 3) levels
        template: F32Array2,  # (3, terms)
        nodes: F32Array3,  # (Hg, Wg, 6) A and B
        times: F32Array2,  # (3, 3) M diag(tau) M^-1
        spacing: f32,  # px between two nodes
        read_noise: f32,  # levels
        noise_gain: f32,  # levels
        contrast_doubt: f32,
        phase: F32Array2,  # (H, W) rad, to be corrected
        precision: F32Array2,  # (H, W) 1 / rad^2, to be lessened
    ):
        for pixel in range(phase.shape[0] * phase.shape[1]):
            y, x = pixel // phase.shape[1], pixel % phase.shape[1]
            moved = change[y, x]
            if has_phase(phase[y, x]) and not ti.math.isnan(moved):
                harmonics, delays = load_harmonics(template), matrix_of(times)
                v = ti.min(ti.max((y + 0.5) / spacing - 0.5, 0.0), ti.cast(nodes.shape[0] - 1, ti.f32))
                u = ti.min(ti.max((x + 0.5) / spacing - 0.5, 0.0), ti.cast(nodes.shape[1] - 1, ti.f32))
                j = ti.cast(u, ti.i32)
                color, ambient = node_model(nodes, v, j)
                right_color, right_ambient = node_model(nodes, v, j + 1)
                color += (u - j) * (right_color - color)
                ambient += (u - j) * (right_ambient - ambient)
                model, slope, swing, rest = model_at(
                    phase[y, x], color, ambient, harmonics, mixing, besides, labels, y, x, mixed
                )
                _cycle, of_template = cycle_and_slope(harmonics, phase[y, x])
                motion = color * (delays @ of_template)
                if ti.static(mixed):
                    motion = surface_matrix(mixing, surface_at(labels, y, x)) @ motion
                seen = color_at(image, y, x)
                weight = 1.0 / ti.sqrt(read_noise * read_noise + noise_gain * ti.max(seen, 0.0))
                light = weight * (seen - rest)
                estimator, of_phase, _variance, _brightness = estimator_of(
                    light, weight * model, weight * slope, weight * swing, contrast_doubt
                )
                off = moved * estimator.dot(weight * motion) / ti.max(estimator.dot(of_phase), 1e-12)
                phase[y, x] -= off
                doubt = _DOUBT * off
                precision[y, x] = precision[y, x] / (1.0 + doubt * doubt * precision[y, x])

    return undo_motion_kernel


def undo_field_motion(
    image: LevelsImage,
    motion: FieldMotion,
    model: ChannelModel,
    crosstalk: Crosstalk,
    levels: FrameLevels,
    contrast_doubt: float,
    out: tuple[F32, F32],
) -> None:
    """Correct phases for the motion between a frame's colours, and lessen their precision by what that is unsure of.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels, stripes along the rows.
    motion : FieldMotion
        See `measure_motion`.
    model, crosstalk, levels, contrast_doubt
        What `fit_phase` was given.
    out : two (H, W) float32
        The phase, rad, and its precision, 1 / rad^2, as `fit_phase` found them; they are changed.

    Raises
    ------
    ShapeError
        A shape or dtype is another one.
    """
    shape = (model.gains.height, model.gains.width)
    image = checks.read_array("image", image, (*shape, 3), *LEVEL_TYPES)
    change = checks.read_array("change", motion.change, shape, np.float32)
    matrix = crosstalk.matrix.astype(np.float64)
    times = (matrix @ np.diag(motion.times) @ np.linalg.inv(matrix)).astype(np.float32)
    surfaces = crosstalk.surfaces
    _undo_motion_kernel(surfaces.mixed)(
        image,
        change,
        surfaces.labels,
        surfaces.mixing,
        surfaces.ambient,
        model.template,
        model.nodes,
        times,
        model.gains.spacing_px,
        levels.read_noise,
        levels.noise_gain,
        contrast_doubt,
        *out,
    )
