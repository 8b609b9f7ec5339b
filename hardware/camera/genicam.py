"""GenICam cameras: what is fixed in them, by the names of the Standard Features Naming Convention, and their frames.

Basler's library and Aravis reach the same features; each gives them here as `Features`. The order matters: a trigger
that is on may forbid to switch the frame rate's limit off (Aravis pull request 879), a pixel format decides which
features there are, and an exposure can only be set when nothing else chooses it.
"""

import re
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from math import lcm
from typing import Literal, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from hardware.camera.opened_camera import Setup
from hardware.errors import CameraError, RigError
from hardware.protocols import CameraLimits, FrameFormat, Levels, SensorPart
from hardware.settings import CameraSettings

Value = str | float | int | bool

# Cameras that report it get ready within about 100 ms after acquisition is started.
_READY_S = 2.0
# A burst's buffers, at most: 1 GiB holds 200 frames of 5 megapixels, a second and more for whoever reads them.
_BUFFER_BYTES = 1 << 30
_ENDLESS_BUFFERS = 256
_MIN_BUFFERS = 4


class Features(Protocol):
    """A camera's features by their names. Whatever the camera refuses raises CameraError."""

    def has(self, name: str) -> bool:
        """Return whether it exists at present."""

    def get(self, name: str) -> Value:
        """Return its value; an enumeration's is the entry's name."""

    def set(self, name: str, value: Value) -> None:
        """Change it."""

    def execute(self, name: str) -> None:
        """Give a command."""

    def options(self, name: str) -> tuple[str, ...]:
        """Return the entries of an enumeration that can be chosen at present."""

    def bounds(self, name: str) -> tuple[float, float]:
        """Return the least and the largest value of a number."""

    def step(self, name: str) -> int:
        """Return the step of an integer."""


#: What changes levels or geometry by itself or behind one's back: the feature, what it must be, and what it would do.
_FIXED: tuple[tuple[str, Value, str], ...] = (
    ("ExposureAuto", "Off", "the camera chooses its exposure"),
    ("GainAuto", "Off", "the camera chooses its gain"),
    ("BalanceWhiteAuto", "Off", "the camera chooses its white balance"),
    ("BlackLevelAuto", "Off", "the camera chooses its black level"),
    ("ColorSpace", "RGB", "levels are not proportional to light"),
    ("BslColorSpace", "Off", "levels are not proportional to light"),
    ("BslContrast", 0.0, "levels are not proportional to light"),
    ("BslBrightness", 0.0, "levels are not proportional to light"),
    ("ColorTransformationEnable", False, "colours are mixed"),
    ("ColorAdjustmentEnable", False, "colours are mixed"),
    ("LightSourceSelector", "Off", "colours are mixed"),
    ("LightSourcePreset", "Off", "colours are mixed"),
    ("BslLightSourcePreset", "Off", "colours are mixed"),
    ("SaturationEnable", False, "colours are mixed"),
    ("BslSaturation", 1.0, "colours are mixed"),
    ("HueEnable", False, "colours are mixed"),
    ("BslHue", 0.0, "colours are mixed"),
    ("PgiMode", "Off", "edges are changed"),
    ("SharpnessEnable", False, "edges are changed"),
    ("SharpeningEnable", False, "edges are changed"),
    ("SharpnessEnhancement", 0.0, "edges are changed"),
    ("BslSharpnessEnhancement", 0.0, "edges are changed"),
    ("NoiseReduction", 0.0, "pixels are mixed"),
    ("BslNoiseReduction", 0.0, "pixels are mixed"),
)
_GEOMETRY = (
    ("BinningHorizontal", 1),
    ("BinningVertical", 1),
    ("DecimationHorizontal", 1),
    ("DecimationVertical", 1),
    ("ReverseX", False),
    ("ReverseY", False),
)
#: SFNC, Basler's ace 2, older Basler, older FLIR: frames per second with everything as it is, readout and link
#: included.
_RESULTING_RATES = (
    "ResultingFrameRate",
    "BslResultingAcquisitionFrameRate",
    "ResultingFrameRateAbs",
    "AcquisitionResultingFrameRate",
)


def set_up(features: Features, settings: CameraSettings) -> Setup:
    """Fix all that a camera might change by itself, set what the settings specify, and read it back.

    Raises
    ------
    RigError
        The settings request what this camera cannot do; the message lists what it can.
    CameraError
        It refuses what every GenICam camera must do.
    """
    unlocked: list[str] = []
    _release(features)
    name, frame_format = _set_pixel_format(features, settings.pixel_format)
    size_px, sensor = _set_size(features, settings.size_px)
    for feature, value, harm in _FIXED:
        _fix(features, feature, value, harm, unlocked)
    _fix_gamma(features, unlocked)
    _fix_balance(features, unlocked)
    exposure = _set_exposure(features, settings.exposure_s)
    _set_gain(features, settings.gain_db, unlocked)
    _set_lines(features, settings)
    _set_trigger(features, settings.trigger)
    # Rounding may follow the pixel format, the gain and the trigger: what counts is what it is in the end.
    exposure_s = _number(features, exposure) / 1e6
    least_us, most_us = features.bounds(exposure)
    limits = CameraLimits(
        size_px=size_px,
        format=frame_format,
        exposure_s=(least_us / 1e6, most_us / 1e6),
        min_period_s=_min_period_s(features, exposure_s, unlocked),
        triggered=True,
        sensor=sensor,
    )
    return Setup(limits, exposure_s, tuple(unlocked), swapped=name.startswith("BGR"))


def wait_until_ready(features: Features, exposure_s: float) -> None:
    """Return when the camera takes triggers, where it reports it; one that comes before is lost.

    Raises
    ------
    CameraError
        It does not within two seconds and an exposure.
    """
    selector, waiting = "AcquisitionStatusSelector", "FrameTriggerWait"
    if not (features.has("AcquisitionStatus") and features.has(selector) and waiting in features.options(selector)):
        return
    features.set(selector, waiting)
    wait_s = exposure_s + _READY_S
    deadline = time.monotonic() + wait_s
    while not features.get("AcquisitionStatus"):
        if time.monotonic() > deadline:
            raise CameraError(f"the camera has taken no triggers for {wait_s:g} s: switch it off and on")
        time.sleep(0.001)


def sensor_temperature_c(features: Features) -> float | None:
    """Return how warm the sensor is, where the camera reports that it is the sensor."""
    selector = "DeviceTemperatureSelector"
    if not (features.has("DeviceTemperature") and features.has(selector) and "Sensor" in features.options(selector)):
        return None
    features.set(selector, "Sensor")
    return _number(features, "DeviceTemperature")


def buffers_for(count: int | None, frame_bytes: int) -> int:
    """Return how many buffers a burst gets: one per frame and some more, as memory allows."""
    wanted = _ENDLESS_BUFFERS if count is None else count + _MIN_BUFFERS
    return max(_MIN_BUFFERS, min(wanted, _BUFFER_BYTES // frame_bytes))


def choose(serial: str | None, found: Sequence[tuple[str, str]]) -> int:
    """Return which of the cameras found, as (serial number, model), is meant.

    Raises
    ------
    CameraError
        There is none, another one, or more than one; the message lists them.
    """
    if not found:
        raise CameraError("no camera is found: look for its power and its cable, and at a network camera's address")
    there = ", ".join(f"{number} ({model})" for number, model in found)
    if serial is None:
        if len(found) > 1:
            raise CameraError(f"{len(found)} cameras are there: say which one with serial: {there}")
        return 0
    for index, (number, _) in enumerate(found):
        if number == serial:
            return index
    raise CameraError(f"no camera has the serial number {serial}; there is {there}")


class FrameNumbers:
    """Frame numbers that count on where a network camera's 16 bits wrap: 65535 is followed by 1."""

    def __init__(self) -> None:
        self._last = 0
        self._turns = 0

    def count_on(self, frame_id: int) -> int:
        """Return the number of the frame with the next id; ids come in order, some may be missing."""
        if self._last - frame_id > 1 << 15 and self._last < 1 << 16:
            self._turns += 1
        self._last = frame_id
        return frame_id + self._turns * 65535


def copy_image(raw: npt.NDArray[np.uint8], setup: Setup, row_padding: int = 0) -> Levels | None:
    """Copy a camera's buffer, (bytes,), into a frame of its own; None: it holds less than a frame.

    The only copy that is made: (H, W, 3) RGB or an (H, W) mosaic, uint8, or uint16 with the levels right-aligned.
    """
    width, height = setup.limits.size_px
    row_bytes = frame_bytes(setup.limits) // height
    pitch = row_bytes + row_padding
    if raw.size < height * pitch:
        return None
    rows = raw[: height * pitch].reshape(height, pitch)[:, :row_bytes]
    levels: Levels = rows.view("<u2") if setup.limits.format.bits > 8 else rows
    if setup.limits.format.layout == "bayer":
        return levels.copy()
    image = levels.reshape(height, width, 3)
    if setup.swapped:
        swapped: Levels = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return swapped
    return image.copy()


def frame_bytes(limits: CameraLimits) -> int:
    """Return how many bytes a frame has, rows without padding."""
    width, height = limits.size_px
    samples = width * height * (3 if limits.format.layout == "rgb" else 1)
    return samples * (2 if limits.format.bits > 8 else 1)


def storable(pixel_format: str) -> FrameFormat | None:
    """Return how frames of a GenICam pixel format come; None: it has no colour, or is packed in odd bits.

    In the names of RGB formats, "Packed" is an old way to say that a pixel's samples are neighbours.
    """
    if found := re.fullmatch(r"Bayer(RG|BG|GR|GB)(8|10|12|16)", pixel_format):
        patterns: dict[str, Literal["rggb", "bggr", "grbg", "gbrg"]] = {
            "RG": "rggb",
            "BG": "bggr",
            "GR": "grbg",
            "GB": "gbrg",
        }
        return FrameFormat("bayer", int(found[2]), patterns[found[1]])
    if found := re.fullmatch(r"(?:RGB|BGR)(8|10|12|16)(?:Packed)?", pixel_format):
        return FrameFormat("rgb", int(found[1]))
    return None


def _release(features: Features) -> None:
    """Stop whatever an earlier program left on that could forbid the rest."""
    require(features, "AcquisitionMode", "Continuous")
    for _ in each(features, "TriggerSelector"):
        if features.has("TriggerMode"):
            features.set("TriggerMode", "Off")
    for name in ("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled"):
        if features.has(name):
            require(features, name, False)


def _set_pixel_format(features: Features, asked: str | None) -> tuple[str, FrameFormat]:
    formats = {name: kind for name in features.options("PixelFormat") if (kind := storable(name))}
    if not formats:
        raise CameraError(
            "the camera has no colour format that can be stored, only "
            f"{', '.join(features.options('PixelFormat'))}: take a colour camera"
        )
    if asked is None:
        # A mosaic is what the sensor saw; of the same depth, it comes first.
        asked = max(formats, key=lambda name: (formats[name].bits, formats[name].layout == "bayer"))
    if asked not in formats:
        raise RigError(f"the camera has no pixel_format {asked} that can be stored; it has {', '.join(formats)}")
    require(features, "PixelFormat", asked)
    return asked, formats[asked]


def _set_size(features: Features, asked: tuple[int, int] | None) -> tuple[tuple[int, int], SensorPart | None]:
    """Return width and height of the frames, and the part of the sensor that they are; None: it is not known."""
    for name, value in _GEOMETRY:
        if features.has(name) and features.get(name) != value:
            require(features, name, value)
    sides, wholes, offsets = [], [], []
    for axis, (size, offset) in enumerate((("Width", "OffsetX"), ("Height", "OffsetY"))):
        if features.has(offset):
            features.set(offset, 0)
        least, most = (int(bound) for bound in features.bounds(size))
        step = features.step(size)
        side = most if asked is None else asked[axis]
        if not least <= side <= most or (side - least) % step:
            raise RigError(
                f"size_px says a {size.lower()} of {side}: this camera's is {least} to {most} px in steps of {step}"
            )
        require(features, size, side)
        if features.has(offset):
            # Even, so that the mosaic begins with the same colour.
            grid = lcm(features.step(offset), 2)
            features.set(offset, (most - side) // 2 // grid * grid)
            offsets.append(int(_number(features, offset)))
        elif side == most:
            offsets.append(0)
        sides.append(side)
        wholes.append(most)
    sensor = None
    if len(offsets) == 2:
        sensor = SensorPart(sensor_px=(wholes[0], wholes[1]), offset_px=(offsets[0], offsets[1]), binning=(1, 1))
    return (sides[0], sides[1]), sensor


def _fix(features: Features, name: str, value: Value, harm: str, unlocked: list[str]) -> None:
    if not features.has(name):
        return
    with suppress(CameraError):  # what counts is what it is then
        if features.get(name) != value:
            features.set(name, value)
    try:
        found = features.get(name)
    except CameraError:
        unlocked.append(f"{name} cannot be read back; where it is not {value}, {harm}: look in the maker's own program")
        return
    # A ratio of 1 may come back as the nearest one in fixed point.
    near = isinstance(value, float) and not isinstance(found, str) and abs(found - value) < 0.005
    if found != value and not near:
        unlocked.append(f"{name} stays {found}, so {harm}: set it to {value} in the maker's own program")


def _fix_gamma(features: Features, unlocked: list[str]) -> None:
    harm = "levels are not proportional to light"
    _fix(features, "GammaEnable", False, harm, unlocked)
    if not features.has("GammaEnable") or features.get("GammaEnable"):
        _fix(features, "Gamma", 1.0, harm, unlocked)
    for _ in each(features, "LUTSelector"):
        _fix(features, "LUTEnable", False, harm, unlocked)


def _fix_balance(features: Features, unlocked: list[str]) -> None:
    """All colours alike: what the projector and the sensor make of them is measured by the calibration."""
    for colour in each(features, "BalanceRatioSelector"):
        for ratio in ("BalanceRatio", "BalanceRatioAbs"):
            _fix(features, ratio, 1.0, f"{colour.lower()} is scaled by the camera", unlocked)


def _set_exposure(features: Features, exposure_s: float) -> str:
    if features.has("ExposureMode"):
        require(features, "ExposureMode", "Timed")
    name = _first(features, "ExposureTime", "ExposureTimeAbs")
    if name is None:
        raise CameraError("the camera's exposure cannot be set or read: take another camera")
    least_us, most_us = features.bounds(name)
    if not least_us <= exposure_s * 1e6 <= most_us:
        raise RigError(
            f"exposure_s is {exposure_s:g} s: this camera exposes for {least_us / 1e6:g} to {most_us / 1e6:g} s"
        )
    features.set(name, exposure_s * 1e6)
    return name


def _set_gain(features: Features, gain_db: float, unlocked: list[str]) -> None:
    selector = "GainSelector"
    if features.has(selector):
        choices = features.options(selector)
        for choice in ("DigitalAll", "AnalogAll", "All"):  # the last one there stays selected
            if choice in choices:
                features.set(selector, choice)
                if choice == "DigitalAll":
                    _fix(features, "Gain", 0.0, "levels are stretched", unlocked)
    name = _first(features, "Gain", "GainAbs")
    if name is not None:
        least_db, most_db = features.bounds(name)
        if not least_db <= gain_db <= most_db:
            raise RigError(f"gain_db is {gain_db:g}: this camera's gain is {least_db:g} to {most_db:g} dB")
        features.set(name, gain_db)
        found_db = _number(features, name)
        if abs(found_db - gain_db) > 0.1:
            unlocked.append(f"the gain is {found_db:g} dB, not {gain_db:g}: write gain_db = {found_db:g}")
        return
    if gain_db > 0:
        raise RigError(f"gain_db is {gain_db:g}: this camera's gain cannot be set in dB; leave gain_db out")
    if features.has("GainRaw"):
        features.set("GainRaw", int(features.bounds("GainRaw")[0]))
        unlocked.append(f"its gain has no unit: it was set to its least, {features.get('GainRaw')}")
    else:
        unlocked.append("its gain cannot be read back: check that it is fixed in the maker's own program")


def _set_lines(features: Features, settings: CameraSettings) -> None:
    """Make the trigger's line an input, and the strobe's an output that is high while the sensor exposes."""
    if settings.strobe_line is not None and settings.strobe_line == settings.trigger:
        raise RigError(f"strobe_line and trigger are both {settings.trigger}: wire them to two lines")
    if settings.trigger != "software" and features.has("LineSelector"):
        # A trigger may also come over the network or from a timer, which is no line.
        if settings.trigger in features.options("LineSelector"):
            features.set("LineSelector", settings.trigger)
            _set_line(features, "Input", settings.trigger)
    if settings.strobe_line is None:
        return
    lines = features.options("LineSelector") if features.has("LineSelector") else ()
    if settings.strobe_line not in lines:
        raise RigError(
            f"the camera has no strobe_line {settings.strobe_line}; it has {', '.join(lines) or 'no lines at all'}"
        )
    features.set("LineSelector", settings.strobe_line)
    _set_line(features, "Output", settings.strobe_line)
    sources = features.options("LineSource") if features.has("LineSource") else ()
    if "ExposureActive" not in sources:
        raise RigError(
            f"strobe_line {settings.strobe_line} cannot report exposures, only {', '.join(sources) or 'nothing'}: "
            "take another line, or leave strobe_line out"
        )
    require(features, "LineSource", "ExposureActive")


def _set_line(features: Features, mode: str, line: str) -> None:
    if features.has("LineMode") and features.get("LineMode") != mode:
        if mode not in features.options("LineMode"):
            raise RigError(f"{line} cannot be an {mode.lower()} of this camera: choose another line")
        require(features, "LineMode", mode)
    if features.has("LineInverter"):
        require(features, "LineInverter", False)


def _set_trigger(features: Features, trigger: str) -> None:
    """Expose for each rising edge; on only now that all else is set."""
    if not features.has("TriggerSelector") or "FrameStart" not in features.options("TriggerSelector"):
        raise CameraError("the camera cannot be triggered frame by frame: take another camera")
    require(features, "TriggerSelector", "FrameStart")
    source = "Software" if trigger == "software" else trigger
    sources = features.options("TriggerSource")
    if source not in sources:
        raise RigError(f"the camera has no trigger {trigger}; it has {', '.join(sources)}")
    require(features, "TriggerSource", source)
    if trigger != "software" and features.has("TriggerActivation"):
        require(features, "TriggerActivation", "RisingEdge")
    for name in ("TriggerDelay", "TriggerDelayAbs"):
        if features.has(name):
            require(features, name, 0.0)
    require(features, "TriggerMode", "On")


def _min_period_s(features: Features, exposure_s: float, unlocked: list[str]) -> float:
    """Return the shortest time between triggers, rather too long than too short.

    While a frame is read out, most cameras expose the next one: then the period is the longer of the two, else their
    sum. A camera's own resulting rate knows; the sum is used where TriggerOverlap is off or not reported.
    """
    name = _first(features, *_RESULTING_RATES)
    if name is not None and _number(features, name) > 0:
        period_s = 1 / _number(features, name)
        one_after_another = features.has("TriggerOverlap") and features.get("TriggerOverlap") == "Off"
        return period_s + exposure_s if one_after_another else max(period_s, exposure_s)
    name = _first(features, "AcquisitionFrameRate", "AcquisitionFrameRateAbs")
    most_hz = features.bounds(name)[1] if name is not None else 0.0
    unlocked.append(
        "it does not report its frame rate as it is set up: leave time for the readout between "
        "triggers, and have its exposures counted"
    )
    return (1 / most_hz if most_hz > 0 else 0.0) + exposure_s


def each(features: Features, selector: str) -> Iterator[str]:
    """Select each entry in turn; where there is no selector, there is one of what it would select."""
    if not features.has(selector):
        yield "it"
        return
    for entry in features.options(selector):
        features.set(selector, entry)
        yield entry


def require(features: Features, name: str, value: Value) -> None:
    """Change a feature, and see that it is changed."""
    features.set(name, value)
    found = features.get(name)
    if found != value:
        raise CameraError(f"the camera's {name} stays {found}, not {value}: set it in the maker's own program")


def _first(features: Features, *names: str) -> str | None:
    return next((name for name in names if features.has(name)), None)


def _number(features: Features, name: str) -> float:
    return float(features.get(name))
