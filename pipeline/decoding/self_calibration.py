"""Crosstalk and projector response from ordinary frames, without a board.

Shading and reflectance change slowly over the surface; what repeats with every cycle of the fringe does not come from
the object. So, given a phase that is free of ripple, each balanced camera channel is one periodic function of it,

    C_j / g_j = 1 + sum_n Re(H_jn exp(i n phi)),    H_jn = sum_k M_jk a_kn exp(i n d_k),

with M's rows summing to one, a_kn the harmonics of projector channel k's response (real, as the code is a cosine) over
its mean, d_k the colours' delays. With one response for all and h_j = sum_k M_jk exp(i d_k), real M gives
H_j1 = a_1 h_j,  H_j2 = a_2 conj(h_j),  H_j3 = a_3,  H_j4 = a_4 h_j, and so on.

- The first harmonics say M up to one complex factor that all h_j share. Its size is the fringe's contrast, its
  angle a turn of the phase: what a circulant M (equal leaks all round) does. The size bends no phase.
- A turn t puts exp(i n t) on H_jn, so arg(H_j1 H_j2) = 3 t for every channel: a response that is not linear fixes the
  turn; a linear one does not, and then the phase is known up to a constant.
- a_2, a_4, a_5 over a_1 are what bends the phase; f(code) = sum_n a_n T_n(2 code - 1), T_n Chebyshev's polynomials.

The phase free of ripple: ripple is a function of the phase, the object's own part is smooth. The phase and the
functions cos, sin(k phi) all lose their smooth part to the same local average, and what is left of the one is fitted
with what is left of the others (P. M. Robinson's partially linear model, 1988). Phases need not be evenly spread, and
few cycles do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import CalibrationError
from pipeline.models import FloatArray, ImageArray
from pipeline.pattern import CHANNEL_PHASES

_Singles = npt.NDArray[np.float32]
_Complexes = npt.NDArray[np.complex128]

_DELAYS = np.array(CHANNEL_PHASES)
_TURNS = np.exp(1j * _DELAYS)
# Harmonics of the phase's ripple, and of the response; groups of image tiles for the jackknife; rounds of balance.
_RIPPLES, _HARMONICS, _GROUPS, _ROUNDS = 6, 5, 8, 3
# Of the local average, in cycles: short of one, so that it follows the surface.
_SIGMA_CYCLES = 0.6
# Of the first harmonic, over the cycles in view: what the jackknife does not see (steps, window, shape).
_FLOOR = 0.1
_TRUE = np.linspace(-np.pi, np.pi, 720, endpoint=False)
_MIN_PIXELS, _MIN_CYCLES = 300, 4.0
_SAMPLES = 50000
# What is usual: a turn of the phase, rad, and how far a_3, a_4, a_5 over a_1 deviate from a power law's.
_TURN_PRIOR, _RESPONSE_PRIOR = 0.1, 0.03
# A turn less sure than this, rad, or a rest beyond it, leaves the phase's constant unknown.
_MAX_CONSTANT = 0.03
# Of an estimate's arrays; all else are numbers.
_SHAPES = {"crosstalk_matrix": (3, 3), "crosstalk_sigma": (3, 3), "response": (256,), "correction": (257,)}
# No rig leaks more than this of a colour.
_MAX_LEAK = 0.4


@dataclass(frozen=True)
class LightEstimate:
    """What frames say about their rig's light; standard deviations come from leaving out groups of tiles in turn."""

    crosstalk_matrix: FloatArray
    """(3, 3), rows sum to one: of all that fit, the one with the smallest leaks, none negative."""
    crosstalk_sigma: FloatArray
    """(3, 3)."""
    response: FloatArray
    """(256,): light of codes 0..1, one for all channels, from 0 to 1."""
    correction: _Singles
    """(257,) rad, to be added to phases -pi..pi decoded with the matrix: the response, and what else surely repeats
    with every cycle (channels that differ, lateral colour, a transfer that was not undone)."""
    constant_sigma: float
    """rad."""
    constant_known: bool
    """False: the response is nearly linear, and the phase is known up to a constant."""
    cycles: float
    """How many are in view."""
    ripple: float
    """RMS, rad: what repeats with every cycle when only the colours are balanced."""
    misfit: float
    """RMS, rad: the part of it that the matrix and one response leave unexplained."""
    reliable: bool
    """Whether decoding is better off with it."""

    def as_json(self) -> dict[str, Any]:
        """Return what `from_json` reads, every digit of it; what is not finite becomes null."""
        json: dict[str, Any] = {}
        for name, value in vars(self).items():
            plain = np.asarray(value, object)
            plain[~np.isfinite(np.asarray(value))] = None
            json[name] = plain.tolist()
        return json

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "LightEstimate":
        """Return what `as_json` wrote; null becomes NaN.

        Raises
        ------
        ValueError
            It is something else.
        """
        kinds: dict[str, Any] = {"correction": np.float32, "constant_known": np.bool_, "reliable": np.bool_}
        try:
            arrays = {name: np.array(value, kinds.get(name, np.float64)) for name, value in values.items()}
            fields: dict[str, Any] = {name: array if array.ndim else array.item() for name, array in arrays.items()}
            estimate = cls(**fields)
        except (TypeError, AttributeError, OverflowError) as error:
            raise ValueError(str(error)) from None
        if any(np.shape(value) != _SHAPES.get(name, ()) for name, value in vars(estimate).items()):
            raise ValueError("its arrays have other shapes")
        return estimate


def _wrap(phase: Any) -> Any:
    return phase - 2 * np.pi * np.round(phase / (2 * np.pi))


def _shift(harmonics: FloatArray, phase: FloatArray) -> FloatArray:
    """Return how far the arctangent is off for light with these response harmonics, (N,)."""
    n = np.arange(1, np.shape(harmonics)[-1] + 1)
    light = (np.cos(n * (phase[:, None, None] + _DELAYS[:, None])) * harmonics).sum(-1)
    return np.asarray(np.angle(light @ _TURNS.conj() * np.exp(-1j * phase)))


def _undo(shift: FloatArray, seen: FloatArray) -> FloatArray:
    """Return what to add to seen phases, given the shift of a whole turn of true ones from -pi on."""
    true = np.linspace(-np.pi, np.pi, len(shift), endpoint=False)
    steps = np.concatenate([true - 2 * np.pi, true, true + 2 * np.pi]) + np.tile(shift, 3)
    return np.asarray(-np.interp(_wrap(seen), steps, np.tile(shift, 3)))


def _response_curve(harmonics: FloatArray) -> FloatArray:
    """Return the light of 256 codes, rising from 0 to 1."""
    angle = np.arccos(np.linspace(-1, 1, 256))
    light = np.cos(np.outer(angle, np.arange(1, len(harmonics) + 1))) @ harmonics
    light = (np.maximum.accumulate(light) + np.minimum.accumulate(light[::-1])[::-1]) / 2
    return np.asarray((light - light[0]) / (light[-1] - light[0]))


def _waves(phase: _Singles, count: int) -> _Singles:
    """Return cos and then sin of the phase and its multiples, (H, W, 2 count)."""
    turn = np.exp(1j * phase.astype(np.complex64))
    waves = np.empty((*phase.shape, 2 * count), np.float32)
    power = turn
    for n in range(count):
        waves[..., n], waves[..., count + n] = power.real, power.imag
        power = power * turn
    return waves


def _series(phase: _Singles, coefficients: _Singles) -> _Singles:
    """Return `_waves` times coefficients without making the waves, by Horner's rule."""
    turn = np.exp(1j * phase.astype(np.complex64))
    count = len(coefficients) // 2
    total = np.zeros_like(turn)
    for c, s in zip(coefficients[:count][::-1], coefficients[count:][::-1], strict=True):
        total = (total + np.complex64(c - 1j * s)) * turn
    return np.asarray(total.real)


def _median_change(phase: _Singles, axis: int) -> float:
    """Return by how much neighbours along an axis differ; 0 where no two neighbours have a phase."""
    changes = np.abs(np.diff(phase, axis=axis))
    changes = changes[np.isfinite(changes)]
    return float(np.median(changes)) if changes.size else 0.0


class _Frame:
    """Samples of one frame, and local averages over them."""

    def __init__(
        self, image: ImageArray, white_level: float, phase: _Singles, mask: npt.NDArray[np.bool_], period_px: float
    ) -> None:
        valid = mask.astype(bool) & np.isfinite(phase)
        change = [_median_change(np.where(valid, phase, np.nan), axis) for axis in (0, 1)]
        # Skip pixels, mostly along the stripes: averaging them would dampen the harmonics. More samples than
        # _SAMPLES only cost time.
        across = max(1, int(period_px / 16))
        along = max(1, int(period_px / 4), min(int(period_px / 2), mask.size // (across * _SAMPLES)))
        steps = [across if c == max(change) else along for c in change]
        kept = np.s_[:: steps[0], :: steps[1]]
        self.light = image[kept].astype(np.float32) / np.float32(white_level)
        self.mask = valid[kept] & (self.light.max(-1) < 0.995)
        self.guide = np.where(self.mask, phase[kept], 0).astype(np.float32)
        self.tile = [max(1, int(2 * period_px / s)) for s in steps]
        self.sigma = [_SIGMA_CYCLES * period_px / s for s in steps]
        self.weight = np.ones(self.mask.shape, np.float32)
        # Where the phase leaves its neighbourhood's surface, a step is near or the order is wrong.
        for limit in (2.0, 1.0):
            self.keep(np.abs(self.high_pass(self.guide)) < limit)

    def keep(self, good: npt.NDArray[np.bool_]) -> None:
        """Drop samples, and those that are left alone."""
        # Pixels in a mostly empty window have no neighbourhood to speak of.
        self.mask = self.mask & good
        self.mask &= self.blur(np.ones(self.mask.shape, np.float32)) > 0.25
        self.weight = np.maximum(self.blur(np.ones(self.mask.shape, np.float32)), 1e-6)

    def blur(self, values: _Singles) -> _Singles:
        """Return the local sums over the samples that are kept."""
        mask = self.mask if values.ndim == 2 else self.mask[..., None]
        kept = np.where(mask, values, np.float32(0))
        border = cv2.BORDER_CONSTANT
        return np.asarray(cv2.GaussianBlur(kept, (0, 0), self.sigma[1], sigmaY=self.sigma[0], borderType=border))

    def high_pass(self, values: _Singles) -> _Singles:
        """Take off what is smooth, thrice, so that planes and curved surfaces go, too."""
        weight = self.weight if values.ndim == 2 else self.weight[..., None]
        for _ in range(3):
            values = np.asarray(values - self.blur(values) / weight, np.float32)
        return values

    def balance(self, model: _Singles) -> _Singles:
        """Divide each channel by its shading and reflectance, given what one cycle looks like."""
        gains = np.ones_like(self.light)
        for _ in range(2):
            gains *= self.blur(self.light) / np.maximum(self.blur(model * gains), 1e-9)
        return np.asarray(self.light / np.maximum(gains, 1e-6), np.float32)


class _LeastSquares:
    """Normal equations, kept apart for groups of image tiles: a jackknife costs nothing more."""

    def __init__(self) -> None:
        self.gram: Any = 0
        self.right: Any = 0

    def add(self, frame: _Frame, basis: _Singles, values: _Singles) -> None:
        """Add a frame's samples."""
        y, x = np.nonzero(frame.mask)
        group = (y // frame.tile[0] + 3 * (x // frame.tile[1])) % _GROUPS
        groups = [(basis[y[own], x[own]].astype(np.float64), values[y[own], x[own]].astype(np.float64))
                 for own in (group == g for g in range(_GROUPS))]  # fmt: skip
        self.gram = self.gram + np.stack([b.T @ b for b, _ in groups])
        self.right = self.right + np.stack([b.T @ v for b, v in groups])

    def solve(self) -> FloatArray:
        """Return (_GROUPS + 1, columns, right sides): all together, then with each group left out."""
        gram, right = (np.concatenate([s.sum(0)[None], s.sum(0) - s]) for s in (self.gram, self.right))
        return np.linalg.solve(gram + 1e-6 * np.trace(gram[0]) / len(gram[0]) * np.eye(gram.shape[1]), right)


def _deviation(samples: FloatArray) -> FloatArray:
    """Return the standard deviation of samples[0] from the jackknife's samples[1:]."""
    return np.asarray(np.sqrt((_GROUPS - 1) * np.var(samples[1:], axis=0)))


def _smooth_phase(frame: _Frame, raw: _Singles, ripple: _Singles) -> tuple[_Singles, _Singles]:
    """Return the phase free of ripple; and smoothed, which frees it of the noise that the channels share with it."""
    phase = raw
    for _ in range(4):
        phase = raw - _series(phase, ripple)
    return phase, phase - frame.high_pass(phase)


def _fit_ripple(frames: list[_Frame], raws: list[_Singles], phases: list[_Singles], trim: bool) -> _Singles:
    """Fit the phase's ripple as a function of the phase; return its coefficients, (2 _RIPPLES,)."""
    ripple = np.zeros(2 * _RIPPLES, np.float32)
    for _ in range(2):
        sums = _LeastSquares()
        for frame, raw, phase in zip(frames, raws, phases, strict=True):
            rest = frame.high_pass(np.concatenate([raw[..., None], _waves(phase, _RIPPLES)], -1))
            left = np.abs(rest[..., 0] - rest[..., 1:] @ ripple)
            if trim and ripple.any():
                frame.keep(left < 6 * np.median(left[frame.mask]))
            sums.add(frame, rest[..., 1:], rest[..., :1])
        ripple = sums.solve()[0, :, 0].astype(np.float32)
        phases = [_smooth_phase(frame, raw, ripple)[0] for frame, raw in zip(frames, raws, strict=True)]
    return ripple


def _turn(H: _Complexes, floor: float) -> tuple[float, float]:
    """Return the turn and its deviation from H (_GROUPS + 1, 3, _HARMONICS)."""
    least = np.angle((H[:, :, 0] * _TURNS.conj()).sum(1))  # leaves the least circulant matrix
    size = (np.abs(H[0, :, 0]) ** 2).sum()
    product = (H[:, :, 0] * H[:, :, 1]).sum(1) * np.exp(-3j * least[0]) / size  # a_2 exp(3 i (turn - least)) / a_1
    product = product * (1 if product[0].real >= 0 else -1)  # a turn beyond 30 degrees would take leaks above 30 %
    deviation = np.hypot(_deviation(product.imag), floor) / (3 * abs(product[0]) + 1e-9)
    trust = _TURN_PRIOR**2 / (_TURN_PRIOR**2 + deviation**2)
    return float(least[0] + trust * np.angle(product[0]) / 3), float(deviation)


def _matrix(h: _Complexes) -> FloatArray:
    """Return the matrix of h_j = sum_k M_jk exp(i d_k), rows of sum one, scaled so that no leak is negative."""
    real = (h[:, None] * _TURNS.conj()).real
    return np.asarray(1 / 3 - real / (3 * min(real[~np.eye(3, dtype=bool)].min(), -1e-6)))


def _ratios(h: _Complexes, H: _Complexes) -> FloatArray:
    """Return the response's harmonics over the first, from H without its turn."""
    patterns = {1: h, 2: h.conj(), 0: np.full(3, np.sqrt((np.abs(h) ** 2).mean()))}
    expected = np.stack([patterns[n % 3] for n in range(1, _HARMONICS + 1)], axis=-1)
    return np.asarray((H * expected.conj()).real.sum(0) / (np.abs(h) ** 2).sum())


def _rest(H: _Complexes, matrix: FloatArray, shift: FloatArray) -> _Complexes:
    """Return the harmonics (_RIPPLES,) of the phase's shift that H has beyond this one, its mean left out."""
    light = (np.exp(1j * np.outer(_TRUE, np.arange(1, _HARMONICS + 1))) @ H.T).real
    chroma = light @ np.linalg.inv(matrix).T @ _TURNS.conj()
    left = _wrap(np.angle(chroma * np.exp(-1j * _TRUE)) - shift)
    return np.asarray(2 / len(_TRUE) * np.exp(-1j * np.outer(np.arange(1, _RIPPLES + 1), _TRUE)) @ left)


def _regularise(ratios: FloatArray, deviation: FloatArray) -> FloatArray:
    """Pull harmonics from the third on to those of the power law that has this second one, where they are unsure."""
    second = np.clip(ratios[1], -0.4, 0.45)
    gamma = (1 + 2 * second) / (1 - second)
    law = np.cumprod([1.0] + [(gamma - n) / (gamma + n + 1) for n in range(1, _HARMONICS)])
    law[1] = ratios[1]
    trust = _RESPONSE_PRIOR**2 / (_RESPONSE_PRIOR**2 + deviation**2)
    return law + trust * (ratios - law)


def estimate_light(
    images: Sequence[ImageArray],
    white_level: float,
    unwrapped_phases: Sequence[_Singles],
    masks: Sequence[npt.NDArray[np.bool_]],
    period_px: float,
) -> LightEstimate:
    """Estimate crosstalk and response from one frame or several of one rig.

    Parameters
    ----------
    images : sequence of (H, W, 3)
        Linear light, in levels.
    white_level : float
        Full scale.
    unwrapped_phases : sequence of (H, W) float32
        rad; decoded without crosstalk matrix and equalisation, or with: only their whole cycles matter.
    masks : sequence of (H, W) bool
        Pixels with fringes.
    period_px : float
        Camera px a cycle.

    Raises
    ------
    CalibrationError
        Too few pixels.
    """
    if not any(np.count_nonzero(mask) >= _MIN_PIXELS for mask in masks):
        raise CalibrationError("hardly a pixel shows fringes: nothing tells the rig from the object")
    frames = [_Frame(i, white_level, p, m, period_px) for i, p, m in zip(images, unwrapped_phases, masks, strict=True)]
    pixels = sum(int(frame.mask.sum()) for frame in frames)
    if pixels < _MIN_PIXELS:
        raise CalibrationError(
            f"{pixels} pixels of smooth surface with fringes: too few to tell the rig from the object"
        )
    cycles = max(np.ptp(np.quantile(frame.guide[frame.mask], (0.01, 0.99))) for frame in frames if frame.mask.any())
    cycles = float(cycles / (2 * np.pi))
    floor = _FLOOR / max(cycles, 1)
    matrix, model, before = np.eye(3), np.zeros((2 * _HARMONICS, 3), np.float32), 0.0
    phases = [frame.guide for frame in frames]
    for round_ in range(_ROUNDS):
        # Balance, undo the crosstalk as estimated in the round before, and take the ripple out of the phase.
        weights = (np.linalg.inv(matrix).T @ _TURNS.conj()).astype(np.complex64)
        shapes = [1 + _waves(phase, _HARMONICS) @ model for phase in phases]
        balanced = [frame.balance(shape) for frame, shape in zip(frames, shapes, strict=True)]
        raws = [
            frame.guide + _wrap(np.angle(light @ weights) - frame.guide)
            for frame, light in zip(frames, balanced, strict=True)
        ]
        ripple = _fit_ripple(frames, raws, phases if round_ else raws, trim=round_ == 1)
        before = before or float(np.sqrt((ripple**2).sum() / 2))
        # Each channel as a function of that phase.
        sums = _LeastSquares()
        phases = [_smooth_phase(frame, raw, ripple)[1] for frame, raw in zip(frames, raws, strict=True)]
        for frame, phase, light in zip(frames, phases, balanced, strict=True):
            waves = _waves(phase, _HARMONICS)
            sums.add(frame, np.concatenate([np.ones_like(waves[..., :1]), waves], axis=-1), light)
        solved = sums.solve().transpose(0, 2, 1)  # (_GROUPS + 1, 3, 1 + 2 _HARMONICS)
        solved = solved[..., 1:] / solved[..., :1]
        H = solved[..., :_HARMONICS] - 1j * solved[..., _HARMONICS:]
        model = solved[0].T.astype(np.float32)
        turn, constant_sigma = _turn(H, floor)
        H = H * np.exp(-1j * turn * np.arange(1, _HARMONICS + 1))
        matrices = np.stack([_matrix(row[:, 0]) for row in H])
        matrix = matrices[0]
    return _estimate(H, matrices, constant_sigma, cycles, before)


def _estimate(
    H: _Complexes, matrices: FloatArray, constant_sigma: float, cycles: float, ripple: float
) -> LightEstimate:
    """Return what the channels' harmonics say, (_GROUPS + 1, 3, _HARMONICS): all together, then a group left out."""
    matrix, floor = matrices[0], _FLOOR / max(cycles, 1)
    ratios = np.stack([_ratios(row[:, 0], row) for row in H])
    harmonics = _regularise(ratios[0], np.hypot(_deviation(ratios), floor * (np.arange(_HARMONICS) > 0)))
    shift = _shift(harmonics, _TRUE)
    rests = np.stack([_rest(row, m, shift) for row, m in zip(H, matrices, strict=True)])
    misfit = float(np.sqrt((np.abs(rests[0]) ** 2).sum() / 2))
    # Of the rest, take what stands three deviations out.
    noise = np.hypot(_deviation(rests.real), _deviation(rests.imag)) + floor
    rest = rests[0] * np.maximum(1 - (3 * noise / np.maximum(np.abs(rests[0]), 1e-9)) ** 2, 0)
    shift += (np.exp(1j * np.outer(_TRUE, np.arange(1, _RIPPLES + 1))) @ rest).real
    leaks = matrix[~np.eye(3, dtype=bool)]
    return LightEstimate(
        crosstalk_matrix=matrix,
        crosstalk_sigma=np.hypot(_deviation(matrices), floor),
        response=_response_curve(harmonics),
        correction=_undo(shift, np.linspace(-np.pi, np.pi, 257)).astype(np.float32),
        constant_sigma=constant_sigma,
        constant_known=bool(constant_sigma < _MAX_CONSTANT and misfit < _MAX_CONSTANT),
        cycles=cycles,
        ripple=ripple,
        misfit=misfit,
        reliable=bool(misfit < max(0.5 * ripple, 0.02) and cycles > _MIN_CYCLES and leaks.max() < _MAX_LEAK),
    )
