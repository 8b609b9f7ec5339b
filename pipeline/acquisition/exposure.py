"""Find the exposure and gain of a camera, and the faults of its rig, from pictures alone.

The exposure is a whole number of the cycles with which the projector's light repeats, and as long as the brightest lit
pixels and the frame rate allow. Gain makes up for what is missing.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log10

import numpy as np

from pipeline.acquisition.camera_effects import CameraEffects
from pipeline.acquisition.light_cycle import FlashMeter, LightCycle
from pipeline.acquisition.light_fields import MeasuredFields, measure_fields
from pipeline.acquisition.rig_faults import (
    MAX_FLICKER,
    MAX_SATURATED,
    RAD_PER_PART,
    SATURATED,
    SURE_S,
    RigFault,
    RigProbe,
    saturated_part,
)
from pipeline.acquisition.studio import Studio
from pipeline.acquisition.tone_curve import MAX_CLIPPED, MAX_CURVE, ToneCurve, measure_tone_curve
from pipeline.models import FloatArray

# The brightest lit pixels, all but this many percent, are to have this part of full scale: noise and stray light of
# other pictures need the rest.
_TARGET, _BRIGHTEST = 0.9, 99.5
# They may miss it by this.
_NEAR = 0.02
# White below this is too dark: a longer exposure then gives half the noise or less (verdict.py).
_DARK = 0.35
# Room light and the camera's own black may take this part of white: they cost as much of the range.
_MAX_BLACK = 0.2
# Most gain, dB, and its step: 16 times, beyond which 8 bits hold little but noise.
_MOST_GAIN_DB, _GAIN_STEP_DB = 24.0, 0.1
# Light of bars at the longest exposure; and the least gamma of projectors, by which their code is chosen.
_BAR_LIGHT, _LEAST_GAMMA = 0.7, 1.8
# Codes become darker by this factor, and exposures by a half, until white is not saturated; so often at most.
_DIMMER, _TRIES = 0.8, 6
# How often frames are taken that are averaged where the room's light flickers: two fifths of its 1 % are left then.
_FLICKER_TAKES = 6
# Frames by which a flicker is measured come from this many starts of the camera.
_STARTS = 6


@dataclass(frozen=True)
class ExposureReport:
    """Exposure and gain to set, and what is wrong with a rig."""

    faults: tuple[RigFault, ...]  # the worst first
    exposure_s: float
    gain_db: float
    level: float  # of the brightest lit pixels with these, of full scale
    cycle: LightCycle | None  # None: the light is constant
    transfer: str  # the camera's tone curve, where it is a named one
    contrast: FloatArray | None  # (3,) of the working fringes; None: not measured
    fields: MeasuredFields | str | None = None  # times of colours and rows, or why they are not known; None: no cycle


class ExposureFinder:
    """Finds exposure, gain and faults of a rig.

    Parameters
    ----------
    studio : Studio
        Projector and camera, before a still surface.
    exposure_s, gain_db : float
        The camera's present setting.
    period_px : float
        The pattern's period, projector px.
    axis : {0, 1}
        Along which the phase grows: 0 is down the picture's rows.
    notify : callable
        Called with what is being done.
    """

    def __init__(
        self,
        studio: Studio,
        exposure_s: float,
        gain_db: float,
        period_px: float,
        axis: int,
        notify: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._studio, self._probe = studio, RigProbe(studio)
        self._exposure_s, self._gain_db = exposure_s, gain_db
        self._fringe = period_px, axis
        self._notify = notify
        self._faults: dict[str, RigFault] = {}
        self._fields: MeasuredFields | str | None = None

    def find(self) -> ExposureReport:
        """Measure the rig as it is set, set its camera, and test it; the camera stays as it is set.

        Raises
        ------
        CameraError, TriggerError, RigError
            An instrument fails.
        CalibrationError
            The camera does not see wide bars.
        """
        self._notify("looking at black and white")
        if self._note(self._probe.look()) or self._note(self._probe.measure_delay()):
            return self._report(0.0, None, "linear", None)
        curve = measure_tone_curve(self._probe, self._white_code() * _DIMMER)
        self._notify("testing for automatic exposure")
        automatic = self._note(CameraEffects(self._probe, curve, self._white_code(), *self._fringe).auto_exposure())
        light = self._first_light(curve, automatic=automatic)
        meter, cycle = self._measure_cycle(curve, light, automatic=automatic)
        if automatic:
            self._exposure_s = self._exposure_s if cycle is None else cycle.nearest_s(self._exposure_s)
            self._fields = None if cycle is None else "the camera sets its exposure itself"
        else:
            cycle = self._measure_fields(curve, light, cycle)
            self._set_brightness(curve, light, cycle)
        self._check_room(meter.variation(self._exposure_s, _STARTS).room * self._bars_share)
        return self._test_camera(cycle)

    def _note(self, fault: RigFault | None) -> bool:
        """Keep a fault, if it is one, and return whether it is."""
        if fault is not None:
            self._faults[fault.key] = fault
        return fault is not None

    def _report(
        self, level: float, cycle: LightCycle | None, transfer: str, contrast: FloatArray | None
    ) -> ExposureReport:
        faults = tuple(sorted(self._faults.values(), key=lambda fault: -fault.cost_rad))
        return ExposureReport(faults, self._exposure_s, self._gain_db, level, cycle, transfer, contrast, self._fields)

    def _white_code(self) -> float:
        """Return the brightest code that does not saturate the camera."""
        code = 1.0
        for _ in range(_TRIES):
            white = self._probe.settled(code)
            if saturated_part(white, self._probe.lit) <= MAX_SATURATED:
                break
            code *= _DIMMER
        return code

    def _brightest(self, frame: FloatArray) -> float:
        return float(np.percentile(frame.max(axis=-1)[self._probe.lit], _BRIGHTEST))

    def _first_light(self, curve: ToneCurve, *, automatic: bool) -> float:
        """Return the light of the brightest pixels as the camera is set, 1 at full scale; note where it is wrong."""
        level = self._brightest(self._probe.white)
        if automatic:
            return float(curve.to_light(np.array(level)))
        saturated = saturated_part(self._probe.white, self._probe.lit)
        times = 1
        for _ in range(_TRIES):
            if level < SATURATED:
                break
            times *= 2
            self._studio.set_camera(self._exposure_s / times, self._gain_db)
            level = self._brightest(self._probe.settled(1.0))
        light = times * float(curve.to_light(np.array(level)))
        if saturated > MAX_SATURATED:
            words = f"white saturates {saturated:.0%} of the lit pixels: expose shorter, or close the aperture"
            # A channel loses what is above full scale, in the bright half of the fringe.
            self._note(RigFault("too bright", words, RAD_PER_PART * max(1 - 1 / light, 0.02) / 2))
        elif (projected := light - float(curve.to_light(self._probe.black)[self._probe.lit].mean())) < _DARK:
            words = (
                f"white is brighter than black by {projected:.0%} of full scale's light, so noise is "
                f"{_TARGET / projected:.1f} times as large as it could be: expose longer, open the aperture, then "
                "raise the gain"
            )
            self._note(RigFault("too dark", words, RAD_PER_PART / 255 / projected))
        return light

    def _measure_cycle(
        self, curve: ToneCurve, light: float, *, automatic: bool
    ) -> tuple[FlashMeter, LightCycle | None]:
        """Measure the cycle of the projector's light, and note an exposure that is off it."""
        longest_s = self._studio.exposures_s[1]
        at_longest = light if automatic else light * max(1.0, longest_s / self._exposure_s)
        code = min(1.0, (_BAR_LIGHT / at_longest) ** (1 / _LEAST_GAMMA))
        meter = FlashMeter(self._probe, code, self._exposure_s, self._gain_db, curve.to_light)
        present = meter.variation(self._exposure_s, _STARTS)
        self._bars_share = min(1.0, present.light / light)
        self._check_room(present.room * self._bars_share)
        cycle = meter.cycle(self._notify)
        if present.sigma > MAX_FLICKER:
            what = "is off the cycle of the projector's light"
            if cycle is not None:
                what = f"is {self._exposure_s / cycle.period_s:.3f} cycles of the projector's light, not a whole number"
            words = f"the exposure {what}, so white varies by {present.sigma:.1%} from frame to frame: set it as below"
            self._note(RigFault("exposure off the cycle", words, RAD_PER_PART * present.sigma))
        return meter, cycle

    def _measure_fields(self, curve: ToneCurve, light: float, cycle: LightCycle | None) -> LightCycle | None:
        """Measure the times of colours and rows, if the light repeats; return the cycle, known better by them."""
        if cycle is None:
            return None
        self._notify("measuring when each colour is on")
        light_per_s = light / self._exposure_s / 10 ** (self._gain_db / 20)
        self._fields = measure_fields(self._probe, curve.to_light, cycle.period_s, light_per_s)
        if isinstance(self._fields, str) or not self._fields.is_periodic:
            return cycle
        return replace(cycle, period_s=self._fields.period_s)

    def _set_brightness(self, curve: ToneCurve, light: float, cycle: LightCycle | None) -> None:
        """Set exposure and gain so that the brightest lit pixels have the target level."""
        target = float(curve.to_light(np.array(_TARGET)))
        needed_s = target / light * self._exposure_s * 10 ** (self._gain_db / 20)  # without gain
        if cycle is None and abs(target / light - 1) < _NEAR:
            return
        for _ in range(_TRIES):
            before = self._exposure_s, self._gain_db
            exposure_s = self._allowed_s(needed_s, cycle)
            gain_db = min(max(0.0, 20 * log10(needed_s / exposure_s)), _MOST_GAIN_DB)
            self._gain_db = round(int(gain_db / _GAIN_STEP_DB) * _GAIN_STEP_DB, 2)
            self._exposure_s = self._studio.set_camera(exposure_s, self._gain_db)
            level = self._brightest(self._probe.settled(1.0))
            if abs(level - _TARGET) < _NEAR or (self._exposure_s, self._gain_db) == before:
                return
            seen = 1.2 if level >= SATURATED else float(curve.to_light(np.array(level)))
            needed_s = target / seen * self._exposure_s * 10 ** (self._gain_db / 20)

    def _allowed_s(self, needed_s: float, cycle: LightCycle | None) -> float:
        """Return the longest exposure up to one that is needed: a whole number of cycles, and short enough."""
        shortest_s, longest_s = self._studio.exposures_s
        if cycle is None:
            return float(np.clip(needed_s, shortest_s, longest_s))
        return max(1, int(min(needed_s, longest_s) / cycle.period_s)) * cycle.period_s

    def _check_room(self, varies: float) -> None:
        if varies > MAX_FLICKER:
            words = (
                f"light of the room flickers by {varies:.1%} of white from frame to frame: switch it off, or light the "
                "room by direct current"
            )
            self._note(RigFault("flickering room light", words, RAD_PER_PART * varies))
            self._probe.takes = _FLICKER_TAKES

    def _test_camera(self, cycle: LightCycle | None) -> ExposureReport:
        """Test the rig with the camera as it is set now."""
        probe = self._probe
        self._studio.set_camera(self._exposure_s, self._gain_db)
        self._notify("testing the projector's picture")
        if self._note(probe.look()):
            return self._report(0.0, cycle, "linear", None)
        probe.delay_s = SURE_S  # which automatics of the camera may need
        resampled = self._note(probe.resampled())
        self._note(probe.mirrored())
        self._notify("testing the camera's processing")
        code = self._white_code()
        curve = measure_tone_curve(probe, code, 3 * probe.takes)
        if not resampled and not curve.is_named:
            words = (
                f"the tone curve is none that is known (light is off by {curve.error:.1%} of the range): set the "
                "camera's gamma to 1, and contrast, saturation and picture styles to neutral"
            )
            self._note(RigFault("tone curve", words, RAD_PER_PART * curve.error))
        elif curve.clipped > MAX_CLIPPED:
            words = f"{curve.clipped:.0%} of black has the least level: raise the camera's black level (offset)"
            self._note(RigFault("black clipped", words, RAD_PER_PART * max(curve.lost, 1 / 255)))
        if curve.black > _MAX_BLACK:
            words = (
                f"black has {curve.black:.0%} of white's light: darken the room; if that stays with the lens covered, "
                "lower the camera's black level (offset)"
            )
            self._note(RigFault("bright black", words, RAD_PER_PART / 255 / (1 - min(curve.black, 0.9))))
        effects = CameraEffects(probe, curve, code, *self._fringe)
        for fault in effects.find():
            self._note(fault)
        if "automatic white balance" not in self._faults:
            self._note(probe.swapped_colors())
        level = self._brightest(probe.white)
        return self._report(level, cycle, curve.transfer if curve.error <= MAX_CURVE else "linear", effects.contrast)
