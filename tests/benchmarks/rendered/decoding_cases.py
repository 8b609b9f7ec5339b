"""One frame and what the decoder is told of it, decoded and judged."""

import warnings
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from camera_film import Sensor, noise_free
from judgement import Verdict, judge, judged
from ray_samples import NOTHING
from rendered_scenes import scenes
from studio import Rig, Studio

from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.calibration.model import Uncertainty
from pipeline.decoding.frame import DecodedFrame
from pipeline.errors import DecodeWarning
from tikernels import runtime
from tikernels.raw.demosaicing import demosaic
from tikernels.raw.pixel_format import PixelFormat

#: What the decoder may know, besides the rig's true geometry and whether the pattern is compensated.
KNOWN = ("nothing", "matrix", "matrix and response")


_SENSOR, _RIG = Sensor(), Rig()


@dataclass(frozen=True)
class Case:
    """A frame, and what is known when it is decoded."""

    scene: str
    pattern: str = "plain"
    known: str = "nothing"
    bands: Literal["broad", "narrow"] | None = None
    sensor: Sensor = _SENSOR
    rig: Rig = _RIG
    before: str | None = None  # the frame before, of a projector that shows its colours in turns


@dataclass(frozen=True)
class Judged:
    """What came of a case, without and with noise, by surface."""

    case: Case
    clean: dict[str, Verdict]
    noisy: dict[str, Verdict]
    constant_sigma: float  # without noise
    constant_known: bool


def calibration_for(case: Case, studio: Studio) -> Calibration:
    """Return the calibration that holds what a case says is known."""
    measured = studio.calibration(case.rig)
    compensated = case.pattern == "compensated"
    update = {"code": "contrast" if case.pattern == "coded" else None, "compensated": compensated}
    light = {name: getattr(measured, name) for name in ("crosstalk_matrix", "response", "uncertainty")}
    if case.known != "matrix and response":
        # Who has not measured the response knows that a pattern is compensated, but not that it is plain.
        update["compensated"] = True if compensated else None
        light["response"] = None
        light["uncertainty"] = Uncertainty()
    if case.known == "nothing":
        light["crosstalk_matrix"] = None
    assert measured.pattern is not None
    return measured.model_copy(update={**light, "capture": None, "pattern": measured.pattern.model_copy(update=update)})


def developed(levels: npt.NDArray[np.integer], sensor: Sensor) -> npt.NDArray[np.generic]:
    """Return what the decoder is given, (H, W, 3): levels as they are, or of a mosaic and of 12 bits, floats."""
    if sensor.mosaic:
        return runtime.to_host(demosaic(levels, PixelFormat("bayer", bits=sensor.bits)))
    return levels if sensor.bits in (8, 16) else (levels / (2**sensor.bits - 1)).astype(np.float32)


def decode(case: Case, studio: Studio, sensor: Sensor) -> tuple[DecodedFrame, npt.NDArray[np.floating]]:
    """Return a case's frame by this sensor, decoded, and its levels of 0..255."""
    image = developed(studio.frame(case.scene, case.pattern, sensor, case.rig), sensor)
    full = 1.0 if image.dtype == np.float32 else float(np.iinfo(image.dtype).max)
    thirds = ((0, 1 / 3), (1 / 3, 2 / 3), (2 / 3, 1))
    fields = None if case.before is None else {"cycle_s": 1, "shown_s": thirds, "locked": True}
    settings = DecodeSettings(reflectance_bands=case.bands, frame_s=1, fields=fields)
    decoder = Decoder(settings, calibration_for(case, studio), arch="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecodeWarning)  # what is not known is what is measured
        previous = None
        if case.before is not None:
            before = developed(studio.frame(case.before, case.pattern, sensor, case.rig), sensor)
            previous = decoder.decode(before)
        return decoder.decode(image, previous=previous), image * (255.0 / full)


def study(case: Case, studio: Studio) -> Judged:
    """Decode a case without and with noise, and judge both."""
    truth, names = studio.truth(case.scene), scenes()[case.scene].surfaces
    period = studio.geometry.pattern.period_px
    results, sigma, known = [], np.nan, False
    for sensor in (case.sensor, noise_free(case.sensor)):
        frame, levels = decode(case, studio, sensor)
        results.append({verdict.surface: verdict for verdict in judge(frame, levels, truth, names, period)})
        sigma, known = float(frame.constant_sigma), bool(frame.constant_known)
    return Judged(case, clean=results[1], noisy=results[0], constant_sigma=sigma, constant_known=known)


@dataclass(frozen=True)
class Orders:
    """What is said of the absolute orders, as shares of the judged pixels of all surfaces."""

    absolute: float  # said to be absolute, and right
    wrong: float  # said to be absolute, and not
    decoded: float


def study_orders(case: Case, studio: Studio) -> Orders:
    """Decode a case with noise, and count its absolute orders."""
    truth = studio.truth(case.scene)
    frame, levels = decode(case, studio, case.sensor)
    looked_at = judged(levels, truth) & (truth.surface != NOTHING)
    phase = 2 * np.pi / studio.geometry.pattern.period_px * np.nan_to_num(truth.projector_row)
    right = np.abs(np.where(frame.mask, frame.unwrapped_phase, 0) - phase) < np.pi
    claimed = looked_at & frame.mask & frame.absolute
    count = np.count_nonzero(looked_at)
    return Orders(
        absolute=np.count_nonzero(claimed & right) / count,
        wrong=np.count_nonzero(claimed & ~right) / count,
        decoded=np.count_nonzero(looked_at & frame.mask) / count,
    )


def with_gamma(rig: Rig, gamma: float) -> Rig:
    """Return the rig with another response of the projector."""
    return replace(rig, optics=replace(rig.optics, gamma=gamma))
