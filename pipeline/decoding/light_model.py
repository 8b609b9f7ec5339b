"""The model of a rig's light: priors from settings, calibration and an earlier frame, and the fit to one frame.

The light goes from the pattern's codes through the projector's response, the crosstalk and the surface's colour to the
camera's levels. What is known of each is a prior, and the frame has the last word.
"""

import warnings
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.causes import Cause, Key
from pipeline.contrast_code import ContrastCode
from pipeline.decoding.first_look import FirstLook
from pipeline.decoding.self_calibration import USUAL_TURN, LightEstimate
from pipeline.decoding.surface_search import (
    FoundSurfaces,
    NoModelFits,
    OnlyColor,
    SurfacePrior,
    find_surfaces,
)
from pipeline.errors import DecodeWarning, SettingsError
from pipeline.models import CameraState
from pipeline.settings import DecodeSettings
from tikernels.arrays import LevelsImage
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.channel_template import channel_harmonics, flat_template
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import measure_correction, resolved_harmonics
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_vector import channel_delays
from tikernels.phase.projector_response import ResponsePrior
from tikernels.phase.surface_matrix import BETWEEN, LightDoubt, band_weights
from tikernels.phase.surfaces import Surfaces
from tikernels.raw.linearization import Transfer

# How far a pixel's contrast may be from what its neighbourhood shows: it hardly changes within a surface, but a code
# changes it from cycle to cycle, and a fit to a constant one would bend the phase by 0.02 rad. So well the light's
# contrast is known, too, apart from what blur takes: one that is 0.08 off changes the fitted ambient light by a third.
_PLAIN_DOUBT, _CODED_DOUBT = 0.02, 0.08
# Standard error of an entry of a surface's matrix, as a share of its row: calibrated, and estimated from the frame; and
# the least leak of real filters, where the estimate is the crosstalk with the smallest leaks that fit.
_LEAK, _UNKNOWN_LEAK, _USUAL_LEAK = 0.004, 0.01, 0.03
# So may a harmonic of the light: where the response is known, but for contrast and blur, and where it is not.
_KNOWN_HARMONIC, _SEEN_HARMONIC = 0.0005, 0.02

_Singles = npt.NDArray[np.float32]


class FittedLight(NamedTuple):
    """The light of one frame; the channels' model is in the `ChannelModel` that was fitted."""

    crosstalk: Crosstalk
    """With the surfaces that were found."""
    correction: _Singles
    """(bins + 1,) rad to add to the arctangent, over the cycle."""
    surfaces: FoundSurfaces | OnlyColor | None
    """Surfaces whose colours change the crosstalk; None: the balance alone undoes what they do."""
    odd: NoModelFits | None
    """Surfaces that no matrix explains."""
    mismatch: float
    """Distance of the channels' fundamentals from the crosstalk's prediction, as a fraction."""
    constant_sigma: float
    """Standard deviation of the constant of all phases, rad."""


class LightModel:
    """The priors of a rig's light, with which the light of each frame is fitted.

    Attributes
    ----------
    transfer : Transfer
        The camera's encoding of light.
    camera_shift_px : (3, 2) float64 or None
        The camera's lateral colour.
    crosstalk : Crosstalk
        The crosstalk, where the surface's colour acts, and the projector's lateral colour.
    code : ContrastCode or None
        The pattern's code; while it is unknown, "contrast".
    code_unknown : bool
        True if neither settings nor calibration state one, so that a frame has to show whether there is one.
    constant_known : bool
        True if the constant of all phases is known.
    unknown : bool
        True if nothing is known of the light, so that it is estimated from the first frame with fringes.
    white : (3,) float64 or None
        Response of the camera's channels to a white surface under full light, up to a factor; None: unknown.
    """

    def __init__(self, settings: DecodeSettings, calibration: Calibration | None) -> None:
        known = calibration or Calibration(crosstalk_matrix=None)
        if known.pattern is not None and known.pattern.stripes != settings.stripes:
            raise SettingsError(
                f"settings say {settings.stripes} stripes but the calibration's pattern has "
                f"{known.pattern.stripes} ones: set stripes to {known.pattern.stripes!r}"
            )
        self.transfer = _transfer(settings, known)
        self.camera_shift_px = None if known.color_shift_px is None else known.color_shift_px.camera
        self._lag = known.projector_lag_rad()
        self._spectral = settings.reflectance_bands
        self._equalize = settings.equalize
        self._bands = BETWEEN if known.wavelengths_nm is None else band_weights(known.wavelengths_nm)
        self._matrix = known.crosstalk_matrix if settings.crosstalk_matrix is None else settings.crosstalk_matrix
        self._responses = known.responses()
        # The light as estimated from a frame, and one cycle of each channel by that.
        self._learned: LightEstimate | None = None
        self._learned_cycle: _Singles = flat_template()
        # Where nothing states the light, the first frame with fringes shows it, but not the relative brightness of the
        # camera's channels, which matters where the crosstalk is undone before the balance.
        self.unknown = self._matrix is None and self._spectral != "narrow"
        self.constant_known = self._matrix is not None
        self.constant_sigma = 0.0 if self.constant_known else USUAL_TURN
        self.white = None if self._matrix is None else self._matrix.sum(axis=1)
        code = _code(settings, calibration)
        self.use_code(code or (None if settings.code == "none" else ContrastCode.named("contrast")))
        self.code_unknown = code is None and settings.code is None

    def use_code(self, code: ContrastCode | None) -> None:
        """Take the pattern's code; what was learnt of the light stays."""
        self.code, self.code_unknown = code, False
        contrast = 1.0 if code is None else code.usual
        self._priors = [ResponsePrior(response, self._lag, contrast) for response in self._responses]
        if self._learned is not None:
            return
        light = self._priors[0].light if len(self._priors) == 1 else np.ones(3)
        matrix = np.eye(3) if self._matrix is None else self._matrix @ np.diag(light)
        if self._spectral == "narrow":
            self.crosstalk = Crosstalk.of(np.eye(3), lag=self._lag, surfaces=Surfaces.of(matrix))
        else:
            self.crosstalk = Crosstalk.of(matrix, lag=self._lag)
        self._white = None if self._matrix is None else matrix.sum(axis=1)

    def learn(self, light: LightEstimate | None) -> None:
        """Take a frame's estimate if it is better than none; None: it had none. No other frame is used."""
        self.unknown = False
        if light is None or not light.reliable:
            return
        self._learned = light
        self.crosstalk, self._white = Crosstalk.of(light.crosstalk_matrix, lag=self._lag), None
        response = ResponsePrior(np.broadcast_to(light.response, (3, len(light.response))), None)
        self._learned_cycle = response.template(self.crosstalk.matrix, 0.0)
        self.constant_known = light.constant_known
        self.constant_sigma = light.constant_sigma if light.constant_known else USUAL_TURN

    def fit(
        self,
        image: LevelsImage,
        levels: FrameLevels,
        model: ChannelModel,
        before: FoundSurfaces | OnlyColor | None = None,
    ) -> FittedLight:
        """Fit the light of one frame: balance, response, surfaces, and the channels' model.

        Parameters
        ----------
        image : (H, W, 3) uint8, uint16 or float32
            Linear light, levels, stripes along the rows.
        levels : FrameLevels
            The frame's noise, and what a pixel needs to have a phase.
        model : ChannelModel
            Is fitted to the frame.
        before : FoundSurfaces or OnlyColor, optional
            Those of the previous frame of a video.
        """
        crosstalk, surfaces, odd = self.crosstalk, None, None
        correction, cycle = self._balance(image, crosstalk, levels, model)
        if not self.light_known:  # then the frame's own cycle is read off first
            model.fit(crosstalk, correction, cycle, self.contrast_doubt)
            cycle = model.template
        if self._spectral is None and (self._learned is not None or self._matrix is not None):
            look = FirstLook(image, model, crosstalk, levels)
            surfaces, odd = find_surfaces(look, self._surface_prior(cycle), before)
        if isinstance(surfaces, FoundSurfaces):
            crosstalk, cycle = surfaces.crosstalk, surfaces.template
            correction, _ = self._balance(image, crosstalk, levels, model)
            model.fit(crosstalk, correction, cycle, self.contrast_doubt, fixed=True)
            mismatch, sigma = surfaces.mismatch, float(surfaces.fitted.constant_sigma.max())
        else:
            if self.light_known:
                model.fit(crosstalk, correction, cycle, self.contrast_doubt)
            mismatch = sigma = model.mismatch
        odd_rad = 0.0 if odd is None else odd.phase_rad
        constant_sigma = float(np.hypot(self.constant_sigma, np.hypot(sigma, odd_rad)))
        return FittedLight(crosstalk, correction, surfaces, odd, mismatch, constant_sigma)

    def _balance(
        self, image: LevelsImage, crosstalk: Crosstalk, levels: FrameLevels, model: ChannelModel
    ) -> tuple[_Singles, _Singles]:
        """Balance the channels, and return what equalises their phases, and the light's cycle."""
        model.gains.measure(image, crosstalk, levels)
        return self.cycle(model.recover(crosstalk, levels), model.gains.period_px)

    def _surface_prior(self, cycle: _Singles) -> SurfacePrior:
        """Return the prior of the search for surfaces, given one cycle of the channels on white."""
        matrix = self.crosstalk.matrix.astype(np.float64)
        light = np.asarray(np.linalg.solve(matrix, channel_harmonics(cycle)), np.complex128)
        if not self.light_known:
            # The frame's estimate includes the surfaces; all primaries have the same light.
            turns = np.exp(1j * np.arange(1, light.shape[1] + 1) * channel_delays(self._lag)[:, None])
            light = np.asarray((light / turns).real.mean(axis=0) * turns)
        if self._white is None:
            matrix = np.maximum(matrix, _USUAL_LEAK)
            matrix /= matrix.sum(axis=1, keepdims=True)
        doubt = LightDoubt(
            leak=_UNKNOWN_LEAK if self._white is None else _LEAK,
            contrast=_PLAIN_DOUBT,
            harmonic=_KNOWN_HARMONIC if self.light_known else _SEEN_HARMONIC,
        )
        # Surfaces are fitted to the frame's contrast, not to the neighbourhood's: the code's whole spread is uncertain.
        coded = 0.0 if self.code is None else float(self.code.contrasts.std() / self.code.usual)
        return SurfacePrior(matrix, self._white, light, self._lag, doubt, coded, self._bands)

    def cycle(
        self, histogram: npt.NDArray[np.int64], period_px: float
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return the correction of the projector's response, and one cycle of each channel after it.

        The known response is a prior: the fringe is blurred after it, and the frame decides, as far as its phases show
        it.

        Parameters
        ----------
        histogram : (tiles, bins)
            Counts of each phase; see `ChannelModel.recover`.
        period_px : float
            Camera px per cycle.

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
            measured = measure_correction(histogram, 0)  # nothing that the phases show is used
        if not fits:
            return measured.table(measured.beyond(0.0)), flat_template()
        likeliest = int(np.argmin([misfit for _, misfit in fits]))
        # Without the frame's word the response is taken as it is.
        prior, blur = self._priors[likeliest], fits[likeliest][0] if self._equalize else 0.0
        return measured.table(prior.corrected(measured, blur)), prior.template(self.crosstalk.matrix, blur)

    @property
    def light_known(self) -> bool:
        """True if the projector's light over a cycle is known, so that `cycle` predicts the channels."""
        return self._learned is not None or bool(self._priors)

    @property
    def contrast_doubt(self) -> float:
        """Standard deviation of a pixel's contrast about its neighbourhood's under this pattern, as a fraction."""
        return _PLAIN_DOUBT if self.code is None else _CODED_DOUBT


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
    """Return how the camera encodes light, and warn where its settings differ from those at calibration."""
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
