"""Focus of projector and camera, as figures that grow while a lens is turned the right way."""

from collections.abc import Callable
from math import pi

import numpy as np
import numpy.typing as npt

from pipeline.acquisition.rig_faults import SURE_S, RigProbe, rms, shares
from pipeline.models import FloatArray

# Shifts of a fringe, which separate its first harmonic from the second; and the period of coarse ones, in periods: blur
# that leaves a tenth of the fine ones leaves 0.97 of them.
_SHIFTS, _COARSE = 4, 8


class FocusMeter:
    """Measures the contrast of fringes, which projector and camera lose together, and the sharpness of the scene.

    Parameters
    ----------
    probe : RigProbe
        Projector and camera; `look` was called.
    to_light : callable
        The inverse of the camera's tone curve.
    code : float
        Of white.
    period_px : float
        The pattern's, of projector px.
    axis : {0, 1}
        Along which the phase grows: 0 is down the picture's rows.
    """

    def __init__(
        self, probe: RigProbe, to_light: Callable[[FloatArray], FloatArray], code: float, period_px: float, axis: int
    ) -> None:
        self._probe, self._to_light, self._code = probe, to_light, code
        self._period_px, self._axis = period_px, axis
        self._coarse: FloatArray | None = None

    def contrast(self, settle_s: float = SURE_S) -> FloatArray:
        """Return the contrast of fringes of the working period, (3,) of R, G and B, compared with coarse ones.

        It is 1 where nothing is blurred, and more where the camera sharpens. Coarse fringes are seen at the first call.
        """
        if self._coarse is None:
            self._coarse = self._amplitude(_COARSE, SURE_S)
        return self._amplitude(1, settle_s) / np.maximum(self._coarse, 1e-6)

    def scene_sharpness(self, settle_s: float = SURE_S) -> float:
        """Return how much of the surface's own pattern the camera resolves under plain white, of no fixed scale.

        The projector has no part in it. Of two frames' steps from pixel to pixel only those are counted that are in
        both, so noise is not.
        """
        self._probe.show(self._probe.field(self._code))
        self._probe.studio.sleep(settle_s)
        first, second = (shares(frame).mean(axis=-1) for frame in self._probe.studio.take()[:2])
        both = [np.diff(first, axis=axis) * np.diff(second, axis=axis) for axis in (0, 1)]
        return float(np.sqrt(max(0.0, sum(each.mean() for each in both))) / max(rms(first), 1e-6))

    def _amplitude(self, times: int, settle_s: float) -> FloatArray:
        """Return the mean amplitude, (3,), of fringes of some times the working period."""
        width, height = self._probe.studio.projector_px
        along = np.arange(height)[:, None, None] if self._axis == 0 else np.arange(width)[None, :, None]
        turns = 2 * pi * along / (times * self._period_px)
        total: npt.NDArray[np.complex128] = np.zeros((1, 1, 3), np.complex128)
        for n in range(_SHIFTS):
            shift = 2 * pi * n / _SHIFTS
            self._probe.show(self._code * (0.5 + 0.5 * np.cos(turns + shift)) * np.ones((height, width, 3)))
            self._probe.studio.sleep(settle_s)
            frames = [self._to_light(shares(frame)) for frame in self._probe.studio.take()]
            total = total + np.exp(-1j * shift) * np.mean(frames, axis=0)
        return np.asarray(np.abs(total)[self._probe.lit].mean(axis=0))
