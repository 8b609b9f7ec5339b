"""Sharpness of the fringe from place to place, measured in the frame: the projector's depth of focus.

A blur of the projector multiplies harmonic n of its light by q^(n^2). The frame's template (`channel_template.py`) has
the mean of it; where q is exp(x) times that, harmonic n is exp(n^2 x) times the template's. Of that the nodes' A and B
take the first harmonic over, so that harmonics from the second on are left with exp((n^2 - 1) x).

Across brightness and phase, along the unit vector m of t x t', only a wrong model leaves light over. Over the samples
of a tile of the frame, of balanced light c = (C - B) / A and brightness s,

    x = sum (c.m) (s g.m) / sum ((s g.m)^2 + (0.03 s)^2),    g = sum over n of (n^2 - 1) t_n.

The second term keeps x at zero where the light has no harmonics, as of a compensated pattern: a model that is wrong by
0.3 % would make an x of 0.1 then. A and B, fitted with the template as it was, have taken half of x up: the step is
twice as long.

By chance, and by a code that changes the contrast from cycle to cycle, x differs by d from tile to tile where the focus
does not. Tiles that differ by r, RMS, keep 1 - (d / r)^2 of it, and nothing below d (W. James and C. Stein, Estimation
with quadratic loss, Fourth Berkeley Symposium 1, 1961).

What equalises the arctangent is the bend by the second harmonic relative to the first, exp(3 x) times the frame's. That
the mean over the frame stays as it was measured fixes the mean of x.
"""

from enum import IntEnum

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import checks, runtime
from tikernels._taichi import F32Array1, F32Array2, F32Array3, Static, f32, i32, ti, vec3
from tikernels.arrays import F32
from tikernels.lanes import LANES, float_lanes
from tikernels.launching import constant, kernel
from tikernels.phase.channel_template import HARMONICS, load_harmonics, sharpened_cycle_and_slope, sharpening_of
from tikernels.phase.color_balance import channels_at, sample_at
from tikernels.phase.equalization import equalized
from tikernels.phase.phase_vector import TINY, cosine_and_sine
from tikernels.phase.wrapped_phase import NO_PHASE, has_phase
from tikernels.strips import SPREAD, color_of, lanes_of_colors, set_color, strip_at, strip_count

#: Tiles of a frame both ways, at most.
TILES = 6
# Cycles that each wants, and how far they are averaged with their neighbours, in tiles.
_CYCLES, _AROUND = 2, 1.0
# Standard error of the model, as a fraction of a sample's light: it keeps x at zero where there are no harmonics.
_PRIOR = 0.03
# By how much further a step goes than the samples show.
_STEP = 2.0


class _Sum(IntEnum):
    """Columns of the evidence of a block's samples."""

    PRODUCT = 0  # the two sums of x
    SQUARE = 1
    COUNT = 2  # of the samples


sharpness_sums = ti.types.matrix(len(_Sum), LANES, ti.f32)


@ti.func
def equalized_at(bare: f32, correction: F32Array1, bend: f32) -> f32:
    """Return a bare phase, equalised where the fringe bends it by this factor more than on average, exp(3 x); rad."""
    return bare + bend * (equalized(bare, correction) - bare)


@ti.func
def sharpening(harmonics: Static, phase: f32, factors: vec3) -> vec3:
    """Return the derivative of the three channels by the sharpness, g, given `sharpening_of` what it is."""
    cosine, sine = cosine_and_sine(phase)
    result = vec3(0.0)
    real, imaginary = cosine, sine
    for n in ti.static(range(2, HARMONICS + 1)):
        real, imaginary = real * cosine - imaginary * sine, real * sine + imaginary * cosine
        for channel in ti.static(range(3)):
            wave = harmonics[channel, n - 1] * real + harmonics[channel, HARMONICS + n - 1] * imaginary
            result[channel] += ti.static(n * n - 1) * factors[n - 2] * wave
    return result


@kernel
def sum_sharpness_kernel(
    samples: F32Array3,  # (H, Wb, 3) the channels that the nodes belong to, levels
    phases: F32Array2,  # (H, Wb) rad, bare; NO_PHASE where there is none
    correction: F32Array1,  # (bins + 1,) rad
    template: F32Array2,  # (3, terms)
    nodes: F32Array3,  # (Hg, Wg, 6) A and B
    sharpness: F32Array2,  # (Hg, Wg) as far as it is known
    rows: i32,  # of a block
    out_sums: F32Array3,  # (Hb, Wb, 3)
):
    """Sum up, block by block, what the sharpness explains of what brightness and phase leave over."""
    # Half of the blocks are enough, as one colour of a chessboard.
    for t in range(SPREAD * out_sums.shape[0] * strip_count(out_sums.shape[1], 2 * LANES)):
        if t % SPREAD > 0:
            continue
        i, start, total = strip_at(t // SPREAD, out_sums.shape[1], 2 * LANES)
        first, count = start + i % 2, (total + 1 - i % 2) // 2
        node, harmonics = ti.min(i // 2, nodes.shape[0] - 1), load_harmonics(template)
        seen, colors, ambients = lanes_of_colors(0.0), lanes_of_colors(1.0), lanes_of_colors(0.0)
        phase, sharper = float_lanes(NO_PHASE), lanes_of_colors(1.0)
        sums = sharpness_sums(0.0)
        for k in range(count):
            j = first + 2 * k
            set_color(colors, k, ti.max(channels_at(nodes, node, j, 0), TINY))
            set_color(ambients, k, channels_at(nodes, node, j, 3))
            set_color(sharper, k, sharpening_of(sharpness[node, j]))
        for y in range(i * rows, ti.min((i + 1) * rows, samples.shape[0])):
            for k in range(count):
                set_color(seen, k, sample_at(samples, y, first + 2 * k))
                phase[k] = NO_PHASE
                if has_phase(phases[y, first + 2 * k]):
                    phase[k] = equalized_at(phases[y, first + 2 * k], correction, sharper[0, k])
            for k in range(LANES):
                counts = ti.select(has_phase(phase[k]), 1.0, 0.0)
                factors = color_of(sharper, k)
                cycle, slope = sharpened_cycle_and_slope(harmonics, counts * phase[k], factors)
                light = (color_of(seen, k) - color_of(ambients, k)) / color_of(colors, k)
                brightness = light.dot(cycle) / cycle.dot(cycle)
                across = cycle.cross(slope).normalized(TINY)
                effect = brightness * sharpening(harmonics, counts * phase[k], factors).dot(across)
                left = light.dot(across)
                least = _PRIOR * brightness
                sums[_Sum.PRODUCT, k] += counts * left * effect
                sums[_Sum.SQUARE, k] += counts * (effect * effect + least * least)
                sums[_Sum.COUNT, k] += counts
        for j in range(start, start + total):
            for n in ti.static(range(len(_Sum))):
                out_sums[i, j, n] = 0.0
        for k in range(count):
            for n in ti.static(range(len(_Sum))):
                out_sums[i, first + 2 * k, n] = sums[n, k]


class FringeSharpness:
    """The sharpness around every node of a frame, and the buffer to measure it.

    Parameters
    ----------
    blocks, grid : (int, int)
        Numbers of blocks and nodes; see `BalanceWindow`.
    cycles : (float, float)
        Height and width of the frame, in cycles.
    """

    def __init__(self, blocks: tuple[int, int], grid: tuple[int, int], cycles: tuple[float, float]) -> None:
        high, wide = (int(np.clip(number / _CYCLES, 1, TILES)) for number in cycles)
        self._tiles = (wide, high)
        self._sums = runtime.empty((*blocks, len(_Sum)), np.float32)
        #: (Hg, Wg) x.
        self.values = constant(np.zeros(grid, np.float32))

    def forget(self) -> None:
        """Take the fringe to be as sharp everywhere."""
        self.values = constant(np.zeros_like(self.values))

    def refine(
        self, samples: F32, phases: F32, correction: F32, template: F32, nodes: F32, rows: int, doubt: float
    ) -> bool:
        """Take a step by the samples' evidence; return whether the rest of the model must be fitted again.

        Parameters
        ----------
        samples : (H, Wb, 3) float32
            Levels of the channels that the nodes belong to.
        phases : (H, Wb) float32
            rad, bare; NO_PHASE where there is none.
        correction : (bins + 1,) float32
            rad to add to them; see `equalization.correction_table`.
        template : (3, terms) float32
            One cycle of each channel.
        nodes : (Hg, Wg, 6) float32
            A and B of the channels, levels.
        rows : int
            Of a block.
        doubt : float
            By how much x differs from tile to tile where the focus does not, RMS.

        Raises
        ------
        ShapeError
            A shape or dtype is another one.
        """
        samples = checks.read_array("samples", samples, (None, self._sums.shape[1], 3), np.float32)
        phases = checks.read_array("phases", phases, tuple(samples.shape[:2]), np.float32)
        nodes = checks.read_array("nodes", nodes, (*self.values.shape, 6), np.float32)
        sum_sharpness_kernel(samples, phases, correction, template, nodes, self.values, rows, self._sums)
        sums, size = runtime.to_host(self._sums), self.values.shape[::-1]  # synchronises
        counts = cv2.resize(np.ascontiguousarray(sums[..., _Sum.COUNT]), size, interpolation=cv2.INTER_AREA)
        if not counts.any():
            return False

        def spread(values: npt.NDArray[np.float32]) -> float:
            return float(np.sqrt((counts * values**2).sum() / counts.sum()))

        step = cv2.resize(_STEP * self._tiled(sums), size, interpolation=cv2.INTER_LINEAR)
        values = self.values + step
        values *= max(0.0, 1 - (doubt / max(spread(values), TINY)) ** 2)
        values -= np.float32(np.log((counts * np.exp(3 * values)).sum() / counts.sum()) / 3)
        self.values = constant(values)
        return spread(step) > doubt

    def _tiled(self, sums: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return x of every tile, given the sums of the blocks."""
        tiles = cv2.resize(sums, self._tiles, interpolation=cv2.INTER_AREA)
        around = cv2.GaussianBlur(tiles, (0, 0), _AROUND, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(around[..., _Sum.PRODUCT] / np.maximum(around[..., _Sum.SQUARE], TINY))
