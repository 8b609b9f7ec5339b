"""How wrong the channels' model is around a place: the variance that it leaves in the phase, whatever the noise.

A pixel's three channels have two unknowns, brightness and phase; what stands across both (M x D in `phase_fit.py`) has
the noise's variance, one, where the model is right. A surface whose colour acts otherwise than the model says, a
highlight, or light from another surface leave more there, and a model that is wrong across the phase is as wrong along
it. So over the balance window

    variance = mean of (misfit^2 - 1) / precision,    at least 0,

is what the phase may be off by: the usual scaling of a fit's variance by its chi square, place by place. What the model
is wrong by in the same way as brightness or phase, it does not see.
"""

from functools import cache
from typing import Any

import numpy as np

from tikernels import checks, runtime
from tikernels._taichi import AnyArray3, F32Array2, F32Array3, U8Array2, f32, i32, ti
from tikernels.arrays import F32, LevelsImage
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.channel_template import load_harmonics
from tikernels.phase.color_balance import Gains
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_fit import fitted_step, model_at, node_model
from tikernels.phase.phase_vector import color_at
from tikernels.phase.wrapped_phase import has_phase
from tikernels.raw.linearization import LEVEL_TYPES

# A single pixel counts for no more than this, rad^2: a highlight is not its neighbourhood's error.
_MAX_VARIANCE = 0.25
# Columns of what is summed up over the window.
_EXCESS, _COUNT = range(2)


class ModelError:
    """Buffers to measure the error of a frame's model, for the grid of `gains`."""

    def __init__(self, gains: Gains) -> None:
        self._window = gains.window
        self._sums = runtime.empty((*gains.window.blocks, 2), np.float32)
        self._half = runtime.empty((*gains.window.grid, 2), np.float32)
        self._smooth = runtime.empty((*gains.window.grid, 2), np.float32)

    def measure(
        self,
        image: LevelsImage,
        phase: F32,
        model: ChannelModel,
        crosstalk: Crosstalk,
        levels: FrameLevels,
        contrast_doubt: float,
    ) -> F32:
        """Measure the variance that the model leaves in the phase.

        Parameters
        ----------
        image : (H, W, 3) uint8, uint16 or float32
            Linear light, levels, stripes along the rows.
        phase : (H, W) float32
            rad, what `fit_phase` found.
        model, crosstalk, levels, contrast_doubt
            What it was given.

        Returns
        -------
        (Hg, Wg) float32
            rad^2, by node; 0 where there is no phase.

        Raises
        ------
        ShapeError
            A shape or dtype is another one.
        """
        shape = (model.gains.height, model.gains.width)
        image = checks.read_array("image", image, (*shape, 3), *LEVEL_TYPES)
        phase = checks.read_array("phase", phase, shape, np.float32)
        noise = (levels.read_noise, levels.noise_gain, contrast_doubt)
        surfaces = crosstalk.surfaces
        light = (
            image,
            phase,
            surfaces.labels,
            surfaces.mixing,
            surfaces.ambient,
            model.template,
            model.nodes,
            self._window.rows,
        )
        _sum_errors_kernel(surfaces.mixed)(*light, *noise, self._sums)
        self._window.smooth(self._sums, self._half, self._smooth)
        out = runtime.empty(self._window.grid, np.float32)
        mean_excess_kernel(self._smooth, out)
        return out


@cache
def _sum_errors_kernel(mixed: bool) -> Any:
    @ti.kernel
    def sum_errors_kernel(
        image: AnyArray3,  # (H, W, 3) levels
        phase: F32Array2,  # (H, W) rad
        labels: U8Array2,  # (H, W) see `Surfaces`
        mixing: F32Array3,  # (N, 3, 3)
        besides: F32Array2,  # (N, 3) levels
        template: F32Array2,  # (3, terms)
        nodes: F32Array3,  # (Hg, Wg, 6) A and B
        rows: i32,
        read_noise: f32,  # levels
        noise_gain: f32,  # levels
        contrast_doubt: f32,
        out_sums: F32Array3,  # (Hb, Wb, 2) see _EXCESS and _COUNT
    ):
        """Sum up what one pixel a row of every block has beyond its noise."""
        for block in range(out_sums.shape[0] * out_sums.shape[1]):
            i, j = block // out_sums.shape[1], block % out_sums.shape[1]
            harmonics = load_harmonics(template)
            excess, count = 0.0, 0.0
            for y in range(i * rows, ti.min((i + 1) * rows, image.shape[0])):
                x = j * 2 * rows + (y & 1) * rows
                if x < image.shape[1] and has_phase(phase[y, ti.min(x, image.shape[1] - 1)]):
                    v = ti.min(ti.max((y + 0.5) / (2 * rows) - 0.5, 0.0), ti.cast(nodes.shape[0] - 1, ti.f32))
                    color, ambient = node_model(nodes, v, j)
                    model, change, swing, rest = model_at(
                        phase[y, x], color, ambient, harmonics, mixing, besides, labels, y, x, mixed
                    )
                    seen = color_at(image, y, x)
                    weight = 1.0 / ti.sqrt(read_noise * read_noise + noise_gain * ti.max(seen, 0.0))
                    _, precision, misfit = fitted_step(
                        weight * (seen - rest), weight * model, weight * change, weight * swing, contrast_doubt
                    )
                    excess += ti.min((misfit - 1.0) / ti.max(precision, 1e-9), _MAX_VARIANCE)
                    count += 1.0
            out_sums[i, j, _EXCESS] = excess
            out_sums[i, j, _COUNT] = count

    return sum_errors_kernel


@ti.kernel
def mean_excess_kernel(
    sums: F32Array3,  # (Hg, Wg, 2) over the window
    out: F32Array2,  # (Hg, Wg) rad^2
):
    for node in range(out.shape[0] * out.shape[1]):
        i, j = node // out.shape[1], node % out.shape[1]
        out[i, j] = ti.max(sums[i, j, _EXCESS] / ti.max(sums[i, j, _COUNT], 1e-6), 0.0)
