"""`colorphase expose`: exposure and gain of the camera are measured and set, and faults of the rig are named."""

from collections.abc import Callable, Iterator
from math import inf, isclose, isinf
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from hardware.drivers import SIMULATED
from hardware.settings import RigSettings
from pipeline.acquisition.chosen_rig import read_rig
from pipeline.acquisition.exposure import ExposureFinder, ExposureReport
from pipeline.acquisition.focus import FocusMeter
from pipeline.acquisition.light_fields import MeasuredFields
from pipeline.acquisition.rig_faults import RigFault, RigProbe
from pipeline.acquisition.rig_file import change_file
from pipeline.acquisition.simulated_capture import SETTINGS
from pipeline.acquisition.studio import Studio
from pipeline.calibration import Calibration
from pipeline.calibration.model import DEFAULT_PERIOD_PX
from pipeline.cli.console import bounded, remark, say
from pipeline.cli.opened_studio import opened_studio
from pipeline.planning.rig_plan import plan_rig

# Digits of an exposure: cameras set theirs in steps of 1 us.
_EXPOSURE_DIGITS = 6
# Digits of times of colours, to 1 us, and of rows, to 1 ns.
_FIELD_DIGITS, _ROW_DIGITS = 6, 9
# Values that differ by less than this part are the same: an exposure may be off its cycle by 0.002 (colour_cycle.py).
_SAME = 1e-3
# A live figure changes with this delay of the picture at least, s: a shorter one shows the picture before.
_LIVE_S = 0.2


def expose(
    *,
    rig: str,
    focus_s: Annotated[float, Parameter(validator=bounded(0, 3600))] = 0.0,
) -> None:
    """Measure the projector's light, set the camera's exposure and gain to it, and name what is wrong with the rig.

    Put a still, bright surface before the rig, as a sheet of paper. It takes some minutes. The rig's file is changed,
    with its comments kept, and the old one is kept next to it.

    Example: colorphase expose --rig rig.toml --focus-s 60

    Parameters
    ----------
    rig
        The rig's TOML file; or "simulated", which needs nothing to be there.
    focus_s
        Show how sharp projector and camera are before, for so many seconds or until Enter is pressed.
    """
    settings = SETTINGS if rig == SIMULATED else read_rig(rig)
    calibration = None
    if settings.calibration is not None and Path(settings.calibration).exists():
        calibration = Calibration.read(settings.calibration)
    pattern = None if calibration is None else calibration.pattern
    period_px = DEFAULT_PERIOD_PX if pattern is None else pattern.period_px
    axis = 1 if pattern is not None and pattern.stripes == "vertical" else 0
    # Whether the exposure is a whole number of cycles is measured here.
    picture = Path(rig).with_name("guide.png")
    with opened_studio(settings, rig, None, picture, any_exposure=True) as (studio, show):
        if focus_s:
            show("focus")
            say(_watch_focus(studio, period_px, axis, focus_s, show))
        camera = settings.camera
        report = ExposureFinder(studio, camera.exposure_s, camera.gain_db, period_px, axis, show).find()
    mm_per_rad, source = _mm_per_rad(calibration)
    for line in _in_words(report, mm_per_rad, source):
        say(line)
    projector = settings.projector
    locked = projector.fields is not None and projector.fields.locked
    if projector.colour_cycle_s is not None and report.level and not locked and not _in_turns(report):
        remark("the rig's file states projector.colour_cycle_s, but all colours come at once: delete it, and fields")
    if rig != SIMULATED:
        if _change(Path(rig), settings, report) and calibration is not None:
            remark(
                "calibrate the light anew, because the camera is set to other values: colorphase calibrate capture "
                "radiometry"
            )


def _watch_focus(studio: Studio, period_px: float, axis: int, seconds: float, show: Callable[[str], None]) -> str:
    """Show the figures of the focus until a key is pressed or the time is over; return the last of them."""
    probe = RigProbe(studio)
    for fault in (probe.look(), probe.measure_delay()):
        if fault is not None:
            return f"no focus: {fault.words}"
    meter = FocusMeter(probe, lambda values: values, 1.0, period_px, axis)
    settle_s = max(probe.delay_s, _LIVE_S)
    until_s, sharpest, line = studio.now_s() + seconds, 0.0, "focus: no time to measure it"
    while studio.now_s() < until_s and not studio.key_pressed():
        contrast, scene = meter.contrast(settle_s), meter.scene_sharpness(settle_s)
        sharpest = max(sharpest, scene)
        line = (
            "focus: fringes R {:.2f} G {:.2f} B {:.2f} (projector and camera), ".format(*contrast)
            + f"the surface's own edges {scene / max(sharpest, 1e-9):.0%} of the best so far (camera)"
        )
        show(line)
    return line


def _mm_per_rad(calibration: Calibration | None) -> tuple[float, str]:
    """Return how much depth a radian of phase is, and where that comes from."""
    if calibration is not None and calibration.camera is not None and calibration.pattern is not None:
        geometry = calibration.geometry()
        distance_mm = geometry.working_distance_mm()
        if distance_mm is not None:
            return 1 / geometry.rad_per_mm(distance_mm), f"by the calibration, {distance_mm:.0f} mm away"
    plan = plan_rig()
    return plan.fringe.depth_per_rad_mm, "of a usual rig (colorphase plan): this one has no geometry yet"


def _in_words(report: ExposureReport, mm_per_rad: float, source: str) -> Iterator[str]:
    """Yield the lines of a report."""
    cycle = report.cycle
    if cycle is not None:
        hz = 1 / cycle.period_s
        how = f"one colour after another, {3 * hz:.1f} fields per s" if cycle.in_turns else "all colours at once"
        yield f"the projector's light repeats every {1e3 * cycle.period_s:.4f} ms ({hz:.2f} Hz), {how}"
    elif report.level:
        yield "the projector's light is constant, so any exposure sees all of it"
    yield from _fields_in_words(report)
    if report.level:
        cycles = "" if cycle is None else f" ({report.exposure_s / cycle.period_s:.0f} cycles)"
        yield (
            f"exposure {1e3 * report.exposure_s:.4f} ms{cycles}, gain {report.gain_db:.1f} dB: the brightest lit "
            f"pixels have {report.level:.0%} of full scale"
        )
    if report.contrast is not None:
        yield "contrast of the fringes: R {:.2f}, G {:.2f}, B {:.2f}".format(*report.contrast)
    if report.transfer != "linear":
        yield f'levels are not proportional to light: calibrate and decode with transfer = "{report.transfer}"'
    yield from (_priced(fault, mm_per_rad) for fault in report.faults)
    if not report.faults:
        yield "no fault was found"
    elif min(fault.cost_rad for fault in report.faults) < inf:
        yield f"mm are RMS, at {mm_per_rad:.2f} mm per rad {source}"


def _in_turns(report: ExposureReport) -> bool:
    return report.cycle is not None and report.cycle.in_turns


def _fields_in_words(report: ExposureReport) -> Iterator[str]:
    """Yield when each colour is on, and how the camera's rows follow each other."""
    fields = report.fields
    if fields is None:
        if report.level:
            yield "camera.row_s cannot be measured under constant light: a rolling shutter's data sheet has it"
    elif isinstance(fields, str):
        yield f"times of colours and rows cannot be measured: {fields}"
    else:
        if _in_turns(report):
            if fields.doubt is None:
                red, green, blue = (f"from {on:.3f} to {off:.3f} ms" for on, off in 1e3 * fields.apart_s)
                yield (
                    f"red is on {red}, green {green}, blue {blue} of each cycle, to {1e3 * fields.shown_sigma_s:.3f} ms"
                )
            else:
                yield f"projector.fields is not set: {fields.doubt}"
        if fields.is_periodic:
            sigma_us = f"{1e6 * fields.row_sigma_s:.2g} us"
            if fields.row_s:
                yield f"the shutter rolls, {1e6 * fields.row_s:.2f} us from row to row, to {sigma_us}"
            else:
                yield f"all rows are exposed at once, to {sigma_us} from row to row"


def _field_values(settings: RigSettings, fields: MeasuredFields, *, in_turns: bool) -> dict[str, float | list[float]]:
    """Return the values of a rig's file for colours and rows that differ significantly from those in it."""
    values: dict[str, float | list[float]] = {}
    moved_s = abs(fields.row_s - settings.camera.row_s)
    if fields.is_periodic and moved_s > max(3 * fields.row_sigma_s, _SAME * fields.row_s):
        values["camera.row_s"] = round(fields.row_s, _ROW_DIGITS)
    stated = settings.projector.fields
    # Fields that are locked to the trigger start with it, which no frame shows.
    if in_turns and fields.doubt is None and (stated is None or not stated.locked):
        shown_s = fields.apart_s
        if stated is not None:
            off_s = np.array([stated.red_s, stated.green_s, stated.blue_s]) - stated.red_s[0] - shown_s
            off_s -= fields.period_s * np.rint(off_s / fields.period_s)
            if np.abs(off_s).max() <= max(3 * fields.shown_sigma_s, _SAME * fields.period_s):
                return values
        for name, span_s in zip(("red", "green", "blue"), shown_s, strict=True):
            values[f"projector.fields.{name}_s"] = [round(float(time_s), _FIELD_DIGITS) for time_s in span_s]
    return values


def _priced(fault: RigFault, mm_per_rad: float) -> str:
    """Return a fault with its cost."""
    if isinf(fault.cost_rad):
        return f"nothing can be measured: {fault.key}: {fault.words}"
    return f"{fault.cost_rad * mm_per_rad:.2f} mm ({fault.cost_rad:.3f} rad): {fault.key}: {fault.words}"


def _change(rig: Path, settings: RigSettings, report: ExposureReport) -> bool:
    """Write what differs from the rig's file into it; return whether anything does."""
    if not report.level:
        return False
    present = {
        "camera.exposure_s": settings.camera.exposure_s,
        "camera.gain_db": settings.camera.gain_db,
        "projector.colour_cycle_s": settings.projector.colour_cycle_s,
    }
    found = {"camera.exposure_s": round(report.exposure_s, _EXPOSURE_DIGITS), "camera.gain_db": report.gain_db}
    if report.cycle is not None and report.cycle.in_turns:
        found["projector.colour_cycle_s"] = round(report.cycle.period_s, _EXPOSURE_DIGITS + 2)
    values: dict[str, float | list[float]] = {
        key: value
        for key, value in found.items()
        if (before := present[key]) is None or not isclose(value, before, rel_tol=_SAME)
    }
    if isinstance(report.fields, MeasuredFields):
        values |= _field_values(settings, report.fields, in_turns=_in_turns(report))
    kept, difference = change_file(rig, values)
    if kept is None:
        say(f"{rig} is as it should be")
        return False
    for line in difference:
        say(line)
    say(f"changed {rig}, the old one is {kept}")
    return True
