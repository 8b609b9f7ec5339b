"""What a frame's channels look like where nothing is wrong, by what is known of the rig's light.

The pattern's codes 1 - m + m cos(phi), whose modulation m is the code's, go through the projector's response f and the
crosstalk M:

    I_j(phi) = sum_k M_jk f_k(1 - m(phi - l_k) + m(phi - l_k) cos(phi + p_k - l_k)),

l_k the lag of primary k by the projector's lateral colour. A diagnosis that looks at this light as it looks at the
frame's finds in it the response's harmonics, and what the code does to contrasts and phases of a few cycles; neither is
a fault.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from pipeline.calibration.model import Calibration
from pipeline.models import FloatArray
from pipeline.pattern.contrast_code import CYCLES, modulation_at
from pipeline.pattern.fringes import CHANNEL_PHASES
from pipeline.settings import DecodeSettings

# Samples a cycle: between them the light's twelfth harmonic is off by 0.2 % of its own, which is little to begin with.
_SAMPLES = 128
#: A response that changes nothing.
LINEAR = np.array([[0.0, 1.0]] * 3)


@dataclass(frozen=True, eq=False)
class KnownLight:
    """What settings and calibration tell of the light, which decoding undoes.

    Attributes
    ----------
    crosstalk_matrix : (3, 3) or None
        None: nothing is undone.
    responses : tuple of (3, N)
        Light of the projector's codes, 0..1; any of them may be the one that the pattern's codes go through.
    lag_rad : (3,) or None
        By how much the projector's lateral colour delays R, G and B.
    code : {"contrast"} or None
        The pattern's.
    """

    crosstalk_matrix: FloatArray | None = None
    responses: tuple[FloatArray, ...] = (LINEAR,)
    lag_rad: FloatArray | None = None
    code: Literal["contrast"] | None = None

    @classmethod
    def of(cls, settings: DecodeSettings, calibration: Calibration) -> "KnownLight":
        """Return what settings and calibration tell; the settings overrule."""
        pattern = calibration.pattern
        compensated = None if pattern is None else pattern.compensated
        responses = [LINEAR]
        if calibration.response is not None and compensated is not True:
            # Where nobody has said whether it is undone in the pattern, either may be.
            responses = [calibration.response, *([LINEAR] if compensated is None else [])]
        given = settings.crosstalk_matrix
        return cls(
            calibration.crosstalk_matrix if given is None else given,
            tuple(responses),
            calibration.projector_lag_rad(),
            settings.code if pattern is None else pattern.code,
        )

    @property
    def matrix(self) -> FloatArray:
        """The crosstalk, the sum of each row one: balanced channels are grey whatever the rows' sums."""
        matrix = np.eye(3) if self.crosstalk_matrix is None else np.asarray(self.crosstalk_matrix, np.float64)
        return np.asarray(matrix / matrix.sum(axis=1, keepdims=True))


class ExpectedLight:
    """Light of the channels by phase, for each of the responses that the codes may have gone through.

    Parameters
    ----------
    known : KnownLight
        Of the rig.
    coded : bool
        Whether the modulation follows the code: where orders are absolute.
    """

    def __init__(self, known: KnownLight, *, coded: bool) -> None:
        self._coded = coded
        cycles = np.arange((CYCLES if coded else 1) * _SAMPLES) / _SAMPLES
        lag = np.zeros(3) if known.lag_rad is None else known.lag_rad
        place = cycles[:, None] - lag / (2 * np.pi)
        modulation = modulation_at(place) if coded else 0.5
        codes = 1 - modulation + modulation * np.cos(2 * np.pi * place + np.array(CHANNEL_PHASES))
        self._cycles = cycles
        self._light = []
        for response in known.responses:
            primaries = [np.interp(codes[:, k], np.linspace(0, 1, len(row)), row) for k, row in enumerate(response)]
            self._light.append(known.matrix @ np.array(primaries))

    def at(self, phase: FloatArray) -> npt.NDArray[np.float64]:
        """Return the light, (N, 3, responses), at unwrapped phases (N,), rad; absolute ones where there is a code."""
        cycles = phase / (2 * np.pi)
        period = None if self._coded else 1.0
        channels = [[np.interp(cycles, self._cycles, row, period=period) for row in light] for light in self._light]
        return np.asarray(channels).transpose(2, 1, 0)
