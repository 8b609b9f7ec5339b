"""Crosstalk and projector response from ordinary frames, without a board.

Shading and reflectance change slowly over the surface; what repeats with every cycle of the fringe does not come from
the object. So, given a phase that is free of ripple, each balanced camera channel is one periodic function of it,

    C_j / g_j = 1 + sum_n Re(H_jn exp(i n phi)),    H_jn = sum_k M_jk a_kn exp(i n d_k),

with M's rows summing to one, a_kn the harmonics of projector channel k's response (real, as the code is a cosine) over
its mean, d_k the colours' delays. With one response for all and h_j = sum_k M_jk exp(i d_k), real M gives
H_j1 = a_1 h_j,  H_j2 = a_2 conj(h_j),  H_j3 = a_3,  H_j4 = a_4 h_j, and so on.

- The first harmonics determine M up to one complex factor that all h_j share. Its size is the fringe's contrast, its
  angle a turn of the phase: what a circulant M (equal leaks all round) does. The size bends no phase.
- A turn t puts exp(i n t) on H_jn, so arg(H_j1 H_j2) = 3 t for every channel: a response that is not linear fixes the
  turn; a linear one does not, and then the phase is known up to a constant.
- a_2, a_4, a_5 over a_1 are what bends the phase; f(code) = sum_n a_n T_n(2 code - 1), T_n Chebyshev's polynomials.

The phase free of ripple is the arctangent's, equalised, of the samples of the balance (`channel_model.py`). Each is
compared with the mean brightness of a window of whole cycles around it: a pixel's own has the third harmonic and the
crosstalk in it. Equalising and balancing want the crosstalk undone, so all is done twice, the second time with the
matrix that the first has found.
"""

from typing import Annotated

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import CalibrationError
from pipeline.models import ArrayOf, FloatArray, Matrix3, Model
from pipeline.pattern import CHANNEL_PHASES
from tikernels import runtime
from tikernels.arrays import LevelsImage
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.channel_template import HARMONICS
from tikernels.phase.color_balance import Gains, WindowSum
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import correction_table, resolved_harmonics
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_vector import SIGMAS, TINY
from tikernels.phase.projector_response import response_table
from tikernels.phase.wrapped_phase import LEAST_NO_PHASE

_Singles = npt.NDArray[np.float32]
_Complexes = npt.NDArray[np.complex128]

_TURNS = np.exp(1j * np.array(CHANNEL_PHASES))
# Groups of image tiles for the jackknife; rounds of balance.
_GROUPS, _ROUNDS = 8, 2
_ORDERS = np.arange(1, HARMONICS + 1)
# Of the first harmonic, over the cycles in view: what the jackknife does not see (steps, window, shape).
_FLOOR = 0.1
_MIN_CYCLES = 4.0
# Samples of the balance, at least: of each group, one for each number that is fitted.
_MIN_SAMPLES = _GROUPS * (1 + 2 * HARMONICS)
#: Unknown crosstalk turns the phase about grey by this, rad: camera filters leak up to a quarter of the neighbouring
#: primary, to one side more than to the other.
USUAL_TURN = 0.1
#: A turn less sure than this, rad, or a rest beyond it, leaves the phase's constant unknown: it is not only crosstalk
#: and response, then, by which the channels differ.
MAX_CONSTANT = 0.03


class LightEstimate(Model):
    """A rig's light as estimated from a frame; standard deviations come from leaving out groups of tiles in turn.

    Examples
    --------
    >>> decoder = colorphase.Decoder(arch="cpu")
    >>> frame = decoder.decode(colorphase.simulate_frame(colorphase.simulated_rig()).image)
    >>> decoder.state.light
    <LightEstimate: leaks up to 17.0%, ripple 0.22 rad, reliable>
    """

    crosstalk_matrix: Matrix3
    """(3, 3), rows sum to one: of all that fit, the one with the smallest leaks, none negative."""
    crosstalk_sigma: Matrix3
    """(3, 3)."""
    response: Annotated[FloatArray, ArrayOf((256,))]
    """(256,): light of codes 0..1, one for all channels, from 0 to 1."""
    correction: Annotated[FloatArray, ArrayOf((257,))]
    """(257,) rad, to be added to phases -pi..pi decoded with the matrix: the response, and what else surely repeats
    with every cycle (channels that differ, lateral colour, a transfer that was not undone)."""
    constant_sigma: float
    """rad."""
    constant_known: bool
    """False: the response is nearly linear, and the phase is known up to a constant."""
    cycles: float
    """Number of cycles in view."""
    ripple: float
    """RMS, rad: what repeats with every cycle when only the colours are balanced."""
    misfit: float
    """RMS, rad: the part of it that the matrix and one response leave unexplained."""
    reliable: bool
    """True if decoding is better with it."""

    def __repr__(self) -> str:
        leak = (self.crosstalk_matrix - np.diag(np.diag(self.crosstalk_matrix))).max()
        doubt = "reliable" if self.reliable else "not reliable"
        return f"<LightEstimate: leaks up to {leak:.1%}, ripple {self.ripple:.2g} rad, {doubt}>"

    __str__ = __repr__


def _response_curve(harmonics: FloatArray) -> FloatArray:
    """Return the light of 256 codes, rising from 0 to 1."""
    angle = np.arccos(np.linspace(-1, 1, 256))
    light = np.cos(np.outer(angle, np.arange(1, len(harmonics) + 1))) @ harmonics
    light = (np.maximum.accumulate(light) + np.minimum.accumulate(light[::-1])[::-1]) / 2
    return np.asarray((light - light[0]) / (light[-1] - light[0]))


def _correction(waves: _Complexes) -> FloatArray:
    """Return (257,) rad to add to arctangents of the projector's light with these harmonics, (3, HARMONICS)."""
    return response_table(np.concatenate([np.ones((3, 1)), waves / 2], axis=1)).astype(np.float64)


def _deviation(samples: FloatArray) -> FloatArray:
    """Return the standard deviation of samples[0] from the jackknife's samples[1:]."""
    return np.asarray(np.sqrt((_GROUPS - 1) * np.var(samples[1:], axis=0)))


def _channel_harmonics(model: ChannelModel, correction: _Singles) -> _Complexes:
    """Return harmonics over the mean of the balanced channels, (_GROUPS + 1, 3, HARMONICS).

    All samples together, then with each group of tiles left out.
    """
    gains, phases = model.gains, runtime.to_host(model.phases)
    height, columns = phases.shape
    around = runtime.to_host(gains.smooth)[..., [WindowSum.BACKGROUND, WindowSum.SAMPLES]]
    brightness, samples = cv2.split(cv2.resize(around, (columns, len(around) * gains.spacing_px)))
    balanced, has_phase = runtime.to_host(model.balanced), phases < LEAST_NO_PHASE
    mean = brightness[:height] / np.maximum(samples[:height], TINY)
    # Of a window that is emptier, the mean brightness has too much of the fringe in it.
    usable = has_phase & (samples[:height] > 0.5 * gains.window.samples)
    count = np.count_nonzero(usable)
    if count < _MIN_SAMPLES:
        raise CalibrationError(
            f"{count} samples of a surface with fringes: too few to distinguish the rig from the object"
        )
    y, x = np.nonzero(usable)
    phase = phases[usable] + np.interp(phases[usable], np.linspace(-np.pi, np.pi, len(correction)), correction)
    turns = np.outer(phase, _ORDERS)
    basis = np.concatenate([np.ones((count, 1)), np.cos(turns), np.sin(turns)], axis=1)
    basis *= mean[usable][:, None]
    light = balanced[usable].astype(np.float64)
    group = (y // max(1, int(2 * gains.period_px)) + 3 * (x * gains.spacing_px // int(2 * gains.period_px))) % _GROUPS
    parts = [(basis[group == g], light[group == g]) for g in range(_GROUPS)]
    gram, right = (
        np.concatenate([sums.sum(axis=0)[None], sums.sum(axis=0) - sums])
        for sums in (np.stack([b.T @ b for b, _ in parts]), np.stack([b.T @ v for b, v in parts]))
    )
    # Of phases that are the same in every cycle, higher harmonics look like lower ones.
    gram += 1e-6 * np.trace(gram[0]) / len(gram[0]) * np.eye(gram.shape[1])
    fitted = np.linalg.solve(gram, right).transpose(0, 2, 1)
    fitted /= fitted[..., :1]
    return np.asarray(fitted[..., 1 : 1 + HARMONICS] - 1j * fitted[..., 1 + HARMONICS :])


def _turn(H: _Complexes, floor: float) -> tuple[float, float]:
    """Return the turn and its deviation from H (_GROUPS + 1, 3, HARMONICS)."""
    least = np.angle((H[:, :, 0] * _TURNS.conj()).sum(1))  # leaves the least circulant matrix
    size = (np.abs(H[0, :, 0]) ** 2).sum()
    product = (H[:, :, 0] * H[:, :, 1]).sum(1) * np.exp(-3j * least[0]) / size  # a_2 exp(3 i (turn - least)) / a_1
    product = product * (1 if product[0].real >= 0 else -1)  # a turn beyond 30 degrees would take leaks above 30 %
    deviation = np.hypot(_deviation(product.imag), floor) / (3 * abs(product[0]) + TINY)
    trust = USUAL_TURN**2 / (USUAL_TURN**2 + deviation**2)
    return float(least[0] + trust * np.angle(product[0]) / 3), float(deviation)


def smallest_leaks(h: _Complexes) -> FloatArray:
    """Return the matrix of h_j = sum_k M_jk exp(i d_k), rows of sum one, scaled so that no leak is negative."""
    real = (h[:, None] * _TURNS.conj()).real
    return np.asarray((1 - real / min(real[~np.eye(3, dtype=bool)].min(), -TINY)) / 3)


def estimate_light(image: LevelsImage, levels: FrameLevels, period_px: float, cycles: float) -> LightEstimate:
    """Estimate crosstalk and response from a frame.

    Parameters
    ----------
    image : (H, W, 3) uint8, uint16 or float32
        Linear light, levels, stripes along the rows.
    levels : FrameLevels
        Levels above which pixels are bright enough, and have a fringe.
    period_px : float
        Camera px per cycle.
    cycles : float
        Number of cycles in view: few of them determine little, whatever the number of pixels.

    Raises
    ------
    CalibrationError
        Too few pixels show a fringe.
    """
    model = ChannelModel(Gains(int(image.shape[0]), int(image.shape[1]), period_px))
    matrix, floor, ripple = np.eye(3), _FLOOR / max(cycles, 1), 0.0
    for _ in range(_ROUNDS):
        crosstalk = Crosstalk.of(matrix)
        model.gains.measure(image, crosstalk, levels)
        histogram = model.recover(crosstalk, levels)
        correction = correction_table(histogram, resolved_harmonics(period_px))
        ripple = ripple or float(correction.std())  # before any crosstalk is undone
        harmonics = _channel_harmonics(model, correction)
        turn, constant_sigma = _turn(harmonics, floor)
        harmonics = harmonics * np.exp(-1j * turn * _ORDERS)
        matrices = np.stack([smallest_leaks(row[:, 0]) for row in harmonics])
        matrix = matrices[0]
    return _estimate(harmonics, matrices, constant_sigma, cycles, ripple)


def _estimate(
    H: _Complexes, matrices: FloatArray, constant_sigma: float, cycles: float, ripple: float
) -> LightEstimate:
    """Return the channels' harmonics, (_GROUPS + 1, 3, HARMONICS): all together, then with a group left out."""
    floor = _FLOOR / max(cycles, 1)
    # Light of the projector's channels, over its mean first harmonic; one response makes it real in their own phases.
    sent = np.linalg.inv(matrices) @ H
    own = (sent * _TURNS.conj()[:, None] ** _ORDERS).real.mean(axis=1)
    sent, own = sent / own[:, :1, None], own / own[:, :1]
    expected = np.asarray(own[0] * _TURNS[:, None] ** _ORDERS, np.complex128)
    rest = sent[0] - expected
    misfit = float(np.std(_correction(sent[0]) - _correction(expected)))
    # Of the rest, take what is not noise.
    noise = np.hypot(_deviation(sent.real), _deviation(sent.imag)) + floor
    rest *= np.maximum(1 - (SIGMAS * noise / np.maximum(np.abs(rest), TINY)) ** 2, 0)
    matrix = matrices[0]
    return LightEstimate(
        crosstalk_matrix=matrix,
        crosstalk_sigma=np.hypot(_deviation(matrices), floor),
        response=_response_curve(own[0]),
        correction=_correction(expected + rest),
        constant_sigma=min(constant_sigma, np.pi),  # where it is unknown, any turn is as likely
        constant_known=bool(constant_sigma < MAX_CONSTANT and misfit < MAX_CONSTANT),
        cycles=cycles,
        ripple=ripple,
        misfit=misfit,
        reliable=bool(misfit < max(0.5 * ripple, 0.02) and cycles > _MIN_CYCLES),
    )
