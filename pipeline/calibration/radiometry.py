"""The light that the projector makes of each code, and how much of it each camera channel sees.

Full fields of red, green, blue and grey are shown at rising codes on a white target. In linear light, with the ambient
light of the black field taken off, camera channel i sees sum_k M[i, k] f_k(code_k): of one primary alone, a column of
the crosstalk matrix M times that primary's response f_k (section 2.2 of Je, Lee and Park 2004), so that each ramp is a
matrix of rank one. Grey must be the sum of the three, which also determines how the camera encodes light.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.calibration.captures import PictureSequence, full_scale
from pipeline.calibration.model import MAX_CONDITION, Calibration, Uncertainty
from pipeline.errors import CalibrationError
from pipeline.models import CameraState, FloatArray, ImageArray
from pipeline.robust import robust_sigma
from tikernels.raw.linearization import TRANSFERS, Transfer, linear_values

#: Codes of the ramps, 0..255. Eight steps follow a smooth response to two thousandths, and phases to .0006 rad.
RAMP_CODES = (*range(32, 256, 32), 255)
_COLORS = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "grey": (1, 1, 1)}
#: Names of the projector's primaries, and of the camera channels that see most of each.
PRIMARIES = ("red", "green", "blue")
_BLACK = "00-black"
# Pixels count that are at least this part as bright as the brightest: the projector lights them fully.
_LIT_FRACTION = 0.3
# Pixels that count, at least: their mean is then twenty times less noisy than one of them.
_MIN_LIT_PX = 400
# From this part of full scale on a pixel may be saturated: a camera's noise takes some off.
_SATURATED = 0.99
# A greater share of saturated pixels, of those that count, spoils the mean.
_MAX_SATURATED = 0.002
# A ramp's top must be brighter than black by this part of full scale.
_MIN_SIGNAL = 0.04
# Grey may differ by this part of its white from red + green + blue.
_MAX_NOT_ADDITIVE = 0.02
# A named transfer by which grey differs by less is the camera's; only else is a curve fitted.
_ADDITIVE = 0.01
# Knots of that curve, denser where it is dark.
_KNOTS = 12


@dataclass(frozen=True)
class Radiometry:
    """Response, crosstalk and transfer measured from the ramps."""

    crosstalk_matrix: FloatArray  # (3, 3) camera = matrix @ projector, of full scale
    crosstalk_sigma: FloatArray  # (3, 3) standard deviations
    response: FloatArray  # (3, 256) light of each projector code, 0..1
    response_sigma: FloatArray  # (3, 256)
    transfer: Transfer  # the camera's: a name, or the linear light of 256 levels
    additivity: float  # largest difference of grey from red + green + blue, part of white
    ambient: FloatArray  # (3,) light of the black field, of full scale
    noise: FloatArray  # (3,) standard deviation of a pixel's light in the brightest capture, of full scale
    ramps: FloatArray  # (4, codes + 1, 3) mean linear light of red, green, blue, grey; black first, taken off

    def add_to(self, calibration: Calibration | None, camera: CameraState | None = None) -> Calibration:
        """Return a calibration that holds this light, with what else was known of the rig."""
        known = {} if calibration is None else {name: getattr(calibration, name) for name in Calibration.model_fields}
        old = (known.get("uncertainty") or Uncertainty()).model_dump()
        uncertainty = {**old, "crosstalk_matrix": self.crosstalk_sigma, "response": self.response_sigma}
        before = (camera or known.get("capture") or CameraState()).model_dump()
        return Calibration(
            **{
                **known,
                "crosstalk_matrix": self.crosstalk_matrix,
                "response": self.response,
                "uncertainty": Uncertainty(**uncertainty),
                "capture": CameraState(**{**before, "transfer": self.transfer}),
            }
        )


def radiometry_sequence(size_px: tuple[int, int]) -> PictureSequence:
    """Return the full fields to project: black, then red, green, blue and grey at rising codes."""
    names = [_name(color, code) for color in _COLORS for code in RAMP_CODES]
    return PictureSequence(kind="radiometry", size_px=size_px, names=(_BLACK, *names))


def radiometry_codes(name: str) -> FloatArray:
    """Return the (3,) projector codes, 0..1, of a full field of the sequence."""
    if name == _BLACK:
        return np.zeros(3)
    _, color, code = name.split("-")
    return np.array(_COLORS[color], np.float64) * int(code) / 255


def measure_radiometry(
    captures: Mapping[str, ImageArray], transfer: str | None = None, white_level: float | None = None
) -> Radiometry:
    """Measure the projector's response, the crosstalk and the camera's transfer.

    Parameters
    ----------
    captures : mapping from name to (H, W, 3) uint8, uint16 or float32
        The captures of `radiometry_sequence`, of a neutral white target that need not be lit evenly.
    transfer : {"linear", "srgb", "bt709"}, optional
        Encoding of the camera's light; None: measured.
    white_level : float, optional
        Full scale; None: the type's.

    Returns
    -------
    Radiometry
        With standard deviations from how far the ramps are from the model.

    Raises
    ------
    CalibrationError
        Captures are saturated, too dark, in the wrong order, or not additive.
    """
    black, white = captures[_BLACK], captures[_name("grey", 255)]
    full = full_scale(white, white_level)
    gain = (white.astype(np.float64) - black).mean(axis=-1)
    lit = gain > _LIT_FRACTION * np.percentile(gain, 99)
    if np.percentile(gain, 99) < _MIN_SIGNAL * full or np.count_nonzero(lit) < _MIN_LIT_PX:
        raise CalibrationError(
            f"{_name('grey', 255)} is hardly brighter than {_BLACK}: expose longer, and light the target (or give the "
            "white level, where 16-bit files hold fewer bits)"
        )
    # Pixels sorted into levels: a histogram a capture and channel, from which every transfer's mean light follows.
    histograms = {name: _histograms(name, captures[name], lit, full) for name in [_BLACK, *_all_names()]}
    ramps, chosen = _linear_ramps(histograms, transfer)
    additivity = _not_additive(ramps)
    if additivity > _MAX_NOT_ADDITIVE:
        raise CalibrationError(
            f"grey differs from red + green + blue by {additivity:.1%} of white: switch off the projector's colour "
            "mode, white segment and dynamic iris; if none is on, the camera's transfer is not the one named"
        )
    factors = _factorise(ramps)
    if np.linalg.cond(factors[0]) > MAX_CONDITION:
        raise CalibrationError(
            "the camera hardly distinguishes the projector's colours: switch off its colour effects, and the "
            "projector's colour mode"
        )
    ambient = np.array([histograms[_BLACK][i] @ _light_of_levels(chosen) for i in range(3)])
    noise = _pixel_noise(linear_values(np.clip(white / full, 0, 1), chosen), lit)
    return Radiometry(*factors, transfer=chosen, additivity=additivity, ambient=ambient, noise=noise, ramps=ramps)


def _pixel_noise(white: FloatArray, lit: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the noise of a capture's channels, (3,), by what neighbours differ, which shading hardly changes."""
    both = lit[:, 1:] & lit[:, :-1]
    steps = np.diff(white, axis=1)[both]
    return np.asarray([robust_sigma(steps[:, i]) / np.sqrt(2) for i in range(3)], np.float64)


def _name(color: str, code: int) -> str:
    order = list(_COLORS).index(color) * len(RAMP_CODES) + RAMP_CODES.index(code) + 1
    return f"{order:02d}-{color}-{code:03d}"


def _all_names() -> list[str]:
    return [_name(color, code) for color in _COLORS for code in RAMP_CODES]


# Levels that captures are sorted into: sixteen to each of 8 bits, so that those stay exact.
_LEVELS = 16 * 255 + 1


def _light_of_levels(transfer: Transfer) -> FloatArray:
    """Return the linear light of each of the histogram's levels."""
    return linear_values(np.arange(_LEVELS) / (_LEVELS - 1), transfer)


def _histograms(name: str, image: ImageArray, lit: npt.NDArray[np.bool_], full: float) -> FloatArray:
    """Return how the lit pixels' levels are distributed, (3, _LEVELS), each row's sum one."""
    values = image[lit].astype(np.float64) / full
    saturated = (values >= _SATURATED).mean(axis=0).max()
    if saturated > _MAX_SATURATED:
        raise CalibrationError(f"{name} has {saturated:.1%} of its lit pixels at full scale: expose shorter")
    levels = np.clip(np.rint(values * (_LEVELS - 1)), 0, _LEVELS - 1).astype(int)
    counts = np.stack([np.bincount(levels[:, i], minlength=_LEVELS) for i in range(3)])
    return counts / len(values)


def _linear_ramps(histograms: dict[str, FloatArray], transfer: str | None) -> tuple[FloatArray, Transfer]:
    """Return the ramps in linear light, and the transfer that was undone: the named one, or the most additive one."""

    def ramps_with(light: FloatArray) -> FloatArray:
        black = histograms[_BLACK] @ light
        rising = [[histograms[_name(color, code)] @ light - black for code in RAMP_CODES] for color in _COLORS]
        return np.concatenate([np.zeros((4, 1, 3)), np.array(rising)], axis=1)

    if transfer is not None:
        ramps = ramps_with(_light_of_levels(transfer))
        _check_order(ramps)
        return ramps, transfer
    by_name = {name: ramps_with(_light_of_levels(name)) for name in TRANSFERS}
    _check_order(by_name["linear"])
    best = min(TRANSFERS, key=lambda name: _not_additive(by_name[name]))
    if _not_additive(by_name[best]) <= _ADDITIVE:
        return by_name[best], best
    curve = _additive_curve(histograms)
    ramps = ramps_with(_light_of_levels(curve))
    if _not_additive(ramps) < 0.5 * _not_additive(by_name[best]):
        return ramps, curve
    return by_name[best], best


def _check_order(ramps: FloatArray) -> None:
    """Refuse captures that were mixed up: every ramp rises, and its own camera channel sees it."""
    for k, color in enumerate(_COLORS):
        ramp = ramps[k].sum(axis=-1)
        top = ramp.max()
        if k < 3 and ramps[k, -1].max() < _MIN_SIGNAL:
            raise CalibrationError(f"{_name(color, 255)} is hardly brighter than {_BLACK}: expose longer")
        fall = np.diff(ramp)
        if fall.min() < -0.02 * top:
            at = int(np.argmin(fall))
            raise CalibrationError(
                f"{_name(color, RAMP_CODES[at])} is darker than the capture before it: keep the order of the sequence, "
                "and automatic exposure off"
            )
    shares = ramps[:3, -1] / ramps[:3, -1].sum(axis=0)  # [primary, channel]
    for k, color in enumerate(PRIMARIES):
        if np.argmax(shares[:, k]) != k:
            most = PRIMARIES[int(np.argmax(shares[:, k]))]
            raise CalibrationError(
                f"the camera's {color} channel sees {most} light more than {color}: the captures are in the wrong "
                "order, or the pictures are BGR"
            )


def _not_additive(ramps: FloatArray) -> float:
    """Return the largest difference between grey and the sum of the primaries, as a part of white."""
    return float((np.abs(ramps[3] - ramps[:3].sum(axis=0)) / ramps[3, -1]).max())


def _additive_curve(histograms: dict[str, FloatArray]) -> FloatArray:
    """Return the linear light of 256 levels for which grey is the sum of the primaries, as nearly as may be.

    The curve is piecewise linear between knots, so a capture's mean light is linear in the knots' values, and
    additivity one homogeneous equation per code and channel; a little smoothness settles what no level determines.
    """
    knots = np.linspace(0, 1, _KNOTS) ** 1.5
    # Each level's weights on the knots.
    at = np.interp(np.arange(_LEVELS) / (_LEVELS - 1), knots, np.arange(_KNOTS))
    low = np.minimum(at.astype(int), _KNOTS - 2)
    basis = np.zeros((_LEVELS, _KNOTS))
    basis[np.arange(_LEVELS), low] = 1 - (at - low)
    basis[np.arange(_LEVELS), low + 1] = at - low
    means = {name: counts @ basis for name, counts in histograms.items()}  # (3, knots)
    rows = [
        means[_name("grey", code)] + 2 * means[_BLACK] - sum(means[_name(color, code)] for color in PRIMARIES)
        for code in RAMP_CODES
    ]
    slopes = np.diff(np.eye(_KNOTS), axis=0) / np.diff(knots)[:, None]
    bends = 1e-3 * np.diff(slopes, axis=0)
    system = np.concatenate([*rows, bends])
    # The curve begins at 0 and ends at 1.
    middle, *_ = np.linalg.lstsq(system[:, 1:-1], -system[:, -1], rcond=None)
    curve = np.interp(np.arange(256) / 255, knots, np.concatenate([[0.0], middle, [1.0]]))
    return np.clip(np.maximum.accumulate(curve), 0, 1)


def _factorise(ramps: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Split each primary's ramp into a column of the crosstalk matrix and a response, each with its deviations."""
    codes = np.array([0, *RAMP_CODES]) / 255
    # What grey differs from the sum by is no noise, but shows how far the model can be trusted.
    misfit = float(np.sqrt(((ramps[3] - ramps[:3].sum(axis=0)) ** 2).mean()))
    matrix, matrix_sigma = np.zeros((3, 3)), np.zeros((3, 3))
    response, response_sigma = np.zeros((3, 256)), np.zeros((3, 256))
    for k in range(3):
        left, size, right = np.linalg.svd(ramps[k].T)
        column, curve = left[:, 0] * size[0], right[0]
        residual = ramps[k].T - np.outer(column, curve)
        sigma = float(np.hypot(np.sqrt((residual**2).sum() / (2 * (len(codes) - 2))), misfit))
        top = curve[-1]
        matrix[:, k] = column * top
        # The top capture alone sets the column's length, all captures its direction: this is the top one's deviation.
        matrix_sigma[:, k] = sigma
        knots = np.clip(np.maximum.accumulate(curve / top), 0, 1)
        knots[0], knots[-1] = 0.0, 1.0
        response[k] = _between(codes, knots)
        response[k, [0, -1]] = 0, 1
        response_sigma[k] = sigma / np.linalg.norm(matrix[:, k])
        response_sigma[k, [0, -1]] = 0.0
    return matrix, matrix_sigma, response, response_sigma


def _between(codes: FloatArray, light: FloatArray) -> FloatArray:
    """Return the light of 256 codes, interpolated in the power of it that is nearly straight."""
    middle = len(codes) // 2
    gamma = float(np.clip(np.log(max(light[middle], 1e-6)) / np.log(codes[middle]), 1, 3))
    straight = monotone_curve(codes, light ** (1 / gamma), np.arange(256) / 255)
    return np.asarray(np.clip(straight, 0, 1) ** gamma)


def monotone_curve(x: FloatArray, y: FloatArray, at: FloatArray) -> FloatArray:
    """Interpolate rising values without overshoot (F. N. Fritsch and J. Butland 1984, doi:10.1137/0905021)."""
    step, slope = np.diff(x), np.diff(y) / np.diff(x)
    inner = np.zeros(len(x))
    w1, w2 = 2 * step[1:] + step[:-1], step[1:] + 2 * step[:-1]
    rising = (slope[1:] > 0) & (slope[:-1] > 0)
    with np.errstate(divide="ignore"):
        inner[1:-1] = np.where(rising, (w1 + w2) / (w1 / slope[:-1] + w2 / slope[1:]), 0.0)
    # At the ends the parabola through three points, within the monotone range.
    inner[0] = np.clip(((2 * step[0] + step[1]) * slope[0] - step[0] * slope[1]) / (step[0] + step[1]), 0, 3 * slope[0])
    inner[-1] = np.clip(
        ((2 * step[-1] + step[-2]) * slope[-1] - step[-1] * slope[-2]) / (step[-1] + step[-2]), 0, 3 * slope[-1]
    )
    i = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    t = (at - x[i]) / step[i]
    rise, start, end = y[i + 1] - y[i], inner[i] * step[i], inner[i + 1] * step[i]
    return np.asarray(y[i] + t * (start + t * (3 * rise - 2 * start - end + t * (start + end - 2 * rise))))
