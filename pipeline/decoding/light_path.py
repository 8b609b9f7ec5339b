"""The way of the light from the pattern's codes to the camera's levels, as far as settings and calibration tell it."""

import warnings

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.causes import Cause, Key
from pipeline.contrast_code import ContrastCode
from pipeline.decoding.self_calibration import USUAL_TURN, LightEstimate
from pipeline.decoding.surface_finding import SurfaceFinder
from pipeline.errors import DecodeWarning, SettingsError
from pipeline.models import CameraState, FloatArray
from pipeline.settings import DecodeSettings
from tikernels.phase.channel_template import flat_template
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import measure_correction, resolved_harmonics
from tikernels.phase.projector_response import ResponsePrior
from tikernels.phase.surfaces import Surfaces
from tikernels.raw.linearization import Transfer

# How far a pixel's contrast may be from what its neighbourhood shows: it hardly changes within a surface, but a code
# changes it from cycle to cycle, and a fit to a constant one would bend the phase by 0.02 rad.
_PLAIN_DOUBT, _CODED_DOUBT = 0.02, 0.08
_LINEAR = np.array([[0.0, 1.0]] * 3)


class LightPath:
    """What decoding undoes of it.

    Attributes
    ----------
    transfer : Transfer
        How the camera encodes light.
    camera_shift_px : (3, 2) float64 or None
        The camera's lateral colour.
    crosstalk : Crosstalk
        The crosstalk, where the surface's colour acts, and the projector's lateral colour.
    code : ContrastCode or None
        The pattern's code; while it is unknown, "contrast".
    code_unknown : bool
        Whether neither settings nor calibration state one, so that a frame is to show whether there is one.
    constant_known : bool
        Whether the constant of all phases is known.
    constant_sigma : float
        Standard deviation of that constant as far as settings, calibration or a frame's light tell it, rad.
    unknown : bool
        Whether nothing is known of the light, so that a frame is to tell it.
    white : (3,) float64 or None
        What the camera's channels see of a white surface under full light, up to a factor; None: not known.
    """

    def __init__(self, settings: DecodeSettings, calibration: Calibration | None) -> None:
        self.transfer: Transfer = settings.transfer or "linear"
        self.camera_shift_px: FloatArray | None = None
        self._lag: FloatArray | None = None
        self._bands = settings.reflectance_bands
        self._equalize = settings.equalize
        self._wavelengths_nm: FloatArray | None = None
        responses: list[FloatArray] = []  # that the pattern's codes may go through
        compensated: bool | None = None
        # What a frame has told of the light, and one cycle of each channel by that.
        self._learned: LightEstimate | None = None
        self._learned_cycle: npt.NDArray[np.float32] = flat_template()
        matrix, code = settings.crosstalk_matrix, _code(settings, calibration)
        if calibration is not None:
            if calibration.pattern is not None:
                if calibration.pattern.stripes != settings.stripes:
                    raise SettingsError(
                        f"settings say {settings.stripes} stripes but the calibration's pattern has "
                        f"{calibration.pattern.stripes} ones: set stripes to {calibration.pattern.stripes!r}"
                    )
                compensated = calibration.pattern.compensated
            self.transfer = _transfer(settings, calibration)
            matrix = calibration.crosstalk_matrix if matrix is None else matrix
            self._wavelengths_nm = calibration.wavelengths_nm
            if calibration.response is not None and compensated is not True:
                responses.append(calibration.response)
            if compensated is True or (compensated is None and responses):
                responses.append(_LINEAR)
            if calibration.color_shift_px is not None:
                self.camera_shift_px = calibration.color_shift_px.camera
                self._lag = calibration.projector_lag_rad()
        # Without any word of the light the first frame with fringes tells it; not, though, how bright the camera's
        # channels are to each other, which matters where the crosstalk is undone before the balance.
        self.unknown = matrix is None and self._bands != "narrow"
        self.constant_known = matrix is not None
        self.constant_sigma = 0.0 if self.constant_known else USUAL_TURN
        self.white: FloatArray | None = None if matrix is None else matrix.sum(axis=1)
        self._matrix, self._responses = matrix, responses
        self.use_code(code or (None if settings.code == "none" else ContrastCode.named("contrast")))
        self.code_unknown = code is None and settings.code is None

    def use_code(self, code: ContrastCode | None) -> None:
        """Take the pattern's code; what was learnt of the light stays."""
        self.code, self.code_unknown = code, False
        contrast = 1.0 if code is None else code.usual
        self._priors = [ResponsePrior(response, self._lag, contrast) for response in self._responses]
        light = self._priors[0].light if len(self._priors) == 1 else np.ones(3)
        self._use(np.eye(3) if self._matrix is None else self._matrix @ np.diag(light))
        if self._learned is not None:
            self.learn(self._learned)

    def learn(self, light: LightEstimate | None) -> None:
        """Take what a frame told, if it is better than nothing; None: it told nothing. No other one is asked."""
        self.unknown = False
        if light is None or not light.reliable:
            return
        self._learned = light
        self._use(light.crosstalk_matrix)
        response = ResponsePrior(np.broadcast_to(light.response, (3, len(light.response))), None)
        self._learned_cycle = response.template(self.crosstalk.matrix, 0.0)
        self.constant_known = light.constant_known
        self.constant_sigma = light.constant_sigma if light.constant_known else USUAL_TURN

    def cycle(
        self, histogram: npt.NDArray[np.int64], period_px: float
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return what undoes the projector's response, and what one cycle of each channel then looks like.

        What is known of the response is a prior: the fringe is blurred after it, and the frame has the last word, as
        far as its phases tell.

        Parameters
        ----------
        histogram : (tiles, bins)
            How often each phase is seen; see `ChannelModel.recover`.
        period_px : float
            Camera px a cycle.

        Returns
        -------
        (bins + 1,) float32
            rad to add to the arctangent, over the cycle.
        (3, terms) float32
            One cycle of each balanced channel as far as it is known; see `ChannelModel.fit`.
        """
        if self._learned is not None:
            return self._learned.correction.astype(np.float32), self._learned_cycle
        measured = measure_correction(histogram, resolved_harmonics(period_px))
        fits = [prior.fit(measured, period_px) for prior in self._priors]
        if not self._equalize:
            measured = measure_correction(histogram, 0)  # of what the phases tell, nothing is used
        if not fits:
            return measured.table(measured.beyond(0.0)), flat_template()
        likeliest = int(np.argmin([misfit for _, misfit in fits]))
        # Without the frame's word the response is taken as it is.
        prior, blur = self._priors[likeliest], fits[likeliest][0] if self._equalize else 0.0
        return measured.table(prior.corrected(measured, blur)), prior.template(self.crosstalk.matrix, blur)

    @property
    def light_known(self) -> bool:
        """Whether what the projector sends over a cycle is known, so that `cycle` tells what channels look like."""
        return self._learned is not None or bool(self._priors)

    @property
    def contrast_doubt(self) -> float:
        """Standard deviation of a pixel's contrast about its neighbourhood's under this pattern, as a fraction."""
        return _PLAIN_DOUBT if self.code is None else _CODED_DOUBT

    def _use(self, matrix: FloatArray) -> None:
        self.surfaces = None
        # Surfaces are fitted to the frame's contrast, not to the neighbourhood's: the code's whole spread is in doubt.
        coded = 0.0 if self.code is None else float(self.code.contrasts.std() / self.code.usual)
        if self._bands is None and self._learned is not None:
            self.surfaces = SurfaceFinder(None, coded, self._wavelengths_nm)
        elif self._bands is None and self.constant_known:
            self.surfaces = SurfaceFinder(matrix.sum(axis=1), coded, self._wavelengths_nm)
        if self._bands == "narrow":
            self.crosstalk = Crosstalk.of(np.eye(3), lag=self._lag, surfaces=Surfaces.of(matrix))
        else:
            self.crosstalk = Crosstalk.of(matrix, lag=self._lag)


def _code(settings: DecodeSettings, calibration: Calibration | None) -> ContrastCode | None:
    """Return the code that settings or calibration state; None: they state none."""
    pattern = None if calibration is None else calibration.pattern
    name = settings.code or (None if pattern is None else pattern.code)
    if name is None or name == "none":
        return None
    if name == "contrast":
        return ContrastCode.named(name)
    if pattern is None or pattern.code != name or calibration is None or not calibration.has_geometry:
        raise SettingsError(
            'the code "contrast2" is read by a geometry whose pattern states it: give that calibration, or set code = '
            '"none"'
        )
    return ContrastCode.of(pattern)


def _transfer(settings: DecodeSettings, calibration: Calibration) -> Transfer:
    """Return how the camera encodes light, and warn where it stands otherwise than at calibration."""
    before, now = calibration.capture or CameraState(), settings.capture or CameraState()
    chosen: Transfer = settings.transfer or "linear"
    if before.transfer is not None and settings.transfer is None:
        chosen = before.transfer
    names: tuple[Key, ...] = ("exposure_s", "gain", "white_balance")
    differ = [
        (name, getattr(before, name), getattr(now, name))
        for name in names
        if getattr(before, name) is not None and getattr(now, name) is not None
        if not np.allclose(getattr(before, name), getattr(now, name), rtol=1e-3)
    ]
    said = [
        Cause(name, f"{name} is {now} but was {was} at calibration: set the camera as it was, or calibrate again")
        for name, was, now in differ
    ]
    if before.transfer is not None and not np.array_equal(chosen, before.transfer):
        measured = before.transfer if isinstance(before.transfer, str) else "its own curve"
        words = f"the settings say that transfer is {settings.transfer} and the calibration has measured {measured}"
        said.append(Cause("transfer", f"{words}: omit it in the settings"))
    for message in said:
        warnings.warn(message, DecodeWarning, stacklevel=4)
    return chosen
