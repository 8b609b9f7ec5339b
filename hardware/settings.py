"""``rig.toml``: what is wired to what, and when it is fired."""

import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, model_validator
from pydantic_core import core_schema

from hardware.drivers import DRIVERS, SIMULATED, SOFTWARE
from hardware.errors import RigError
from hardware.models import Model
from hardware.plugins import announced, plugin_of

# An hour: longer than any trigger source waits, or camera exposes.
_LONGEST_S = 3600.0
Positive = Annotated[float, Field(gt=0, le=_LONGEST_S)]
NonNegative = Annotated[float, Field(ge=0, le=_LONGEST_S)]
# A hundred thousand times; cameras have 48 dB.
_MOST_GAIN_DB = 100.0
# What instruments and their libraries count in.
Count = Annotated[int, Field(ge=1, lt=2**31)]
# The largest area sensors have sides of about 19,000 px.
_Side = Annotated[int, Field(ge=1, le=2**15)]
_OWN_DRIVER = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")  # module:Class


@dataclass(frozen=True)
class _Driver:
    """Annotate a text as the name of a driver: ours, one that a package announces, or ``module:Class``."""

    group: str  # a key of `DRIVERS`
    others: tuple[str, ...] = ()

    def names(self) -> tuple[str, ...]:
        """Return all names."""
        return tuple(dict.fromkeys((*DRIVERS[self.group], *self.others, *announced(self.group))))

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"enum": [*self.names(), "module:Class"]}

    def check(self, driver: str) -> str:
        """Refuse what no driver is called, and what several are."""
        plugin_of(self.group, driver, (*DRIVERS[self.group], *self.others), RigError)
        if driver not in self.names() and not _OWN_DRIVER.fullmatch(driver):
            known = ", ".join(f'"{name}"' for name in self.names())
            raise ValueError(f'must be {known} or your own driver as "module:Class", got {driver[:40]!r}')
        return driver


class _Section(Model):
    model_config = ConfigDict(use_attribute_docstrings=True)


class TriggerSettings(_Section):
    """The source of the pulses."""

    driver: Annotated[str, _Driver("colorphase.triggers", (SOFTWARE, SIMULATED))]
    """A name in `hardware.drivers`, one that an installed package announces, or ``module:Class``. "software": this
    program triggers the camera itself, some milliseconds late, and the projector not at all."""
    port: str | None = None
    """A serial device, as /dev/ttyUSB0 or COM3, or a pyserial URL, as socket://10.0.0.5:5025."""
    baud: Count | None = None
    """Bits per second; None: the instrument's usual ones are tried."""
    projector_output: Literal["A", "B", "C", "D"] | None = None
    """Output that goes to the projector, of an instrument that leaves the choice; None: the first."""
    camera_output: Literal["A", "B", "C", "D"] | None = None
    """Output that goes to the camera; None: the second."""
    strobe: bool = False
    """True if the camera's exposure output is wired to the trigger source, which then counts exposures."""
    vsync: Literal["free-running", "per-pulse"] | None = None
    """Set if the projector's sync output is wired to the trigger source, which then counts its pictures: it shows them
    at a rate of its own ("free-running"), or one to every pulse ("per-pulse"), so that a lost one is seen."""


class TimingSettings(_Section):
    """Times of the pulses."""

    period_s: Positive
    """From one pulse, and so frame, to the next; no shorter than the camera's exposure and readout."""
    frames: Count = 1
    """Pulses, and so frames, per burst."""
    projector_delay_s: NonNegative = 0.0
    """From the start of each period to the projector's pulse."""
    projector_width_s: Positive = 100e-6
    """Length of the projector's pulse."""
    camera_delay_s: NonNegative = 0.0
    """From the start of each period to the camera's pulse."""
    camera_width_s: Positive = 100e-6
    """Length of the camera's pulse."""


class CameraSettings(_Section):
    """The camera and what is fixed in it."""

    driver: Annotated[str, _Driver("colorphase.cameras", (SIMULATED,))]
    """A name in `hardware.drivers`, one that an installed package announces, or ``module:Class``."""
    serial: Annotated[str | None, Field(coerce_numbers_to_str=True)] = None
    """Its serial number, or for opencv its number; None: the only one there. A simulated one may be
    a "webcam", or see a "ball"."""
    exposure_s: Positive
    """Exposure of each frame; a whole number of colour cycles where the projector shows colours one after another."""
    row_s: NonNegative = 0.0
    """From one row's exposure to the next one's, of a rolling shutter (data sheets: line time); 0: a global one, or not
    known."""
    gain_db: Annotated[float, Field(ge=0, le=_MOST_GAIN_DB)] = 0.0
    """Amplification: noise grows with it, so light and aperture come first."""
    pixel_format: str | None = None
    """As GenICam spells it, as BayerRG12 or RGB8; None: the camera's deepest colour format that can be stored."""
    size_px: tuple[_Side, _Side] | None = None
    """Width and height of a part in the middle; None: all of the sensor."""
    trigger: str = "Line1"
    """The line that the trigger source is wired to, or "software"."""
    strobe_line: str | None = None
    """The line that reports exposures, as Line2; None: none."""

    @model_validator(mode="after")
    def _check(self) -> "CameraSettings":
        # A real camera lists its own when it is opened.
        if self.driver == SIMULATED and self.pixel_format not in (None, "RGB8"):
            raise ValueError(f'pixel_format must be "RGB8" with the simulated camera, got {self.pixel_format[:40]!r}')
        return self


class FieldSettings(_Section):
    """Times at which a projector that shows its colours one after another switches each of them on and off."""

    red_s: tuple[NonNegative, NonNegative]
    """From when to when red is on, after the start of a colour cycle."""
    green_s: tuple[NonNegative, NonNegative]
    """From when to when green is on."""
    blue_s: tuple[NonNegative, NonNegative]
    """From when to when blue is on."""
    locked: bool = False
    """True if a trigger starts every exposure together with a cycle. False: the camera runs freely, and decoding finds
    where in the cycle each exposure began."""


class ProjectorSettings(_Section):
    """The projector, how it makes colours, and how it is spoken to."""

    display: Annotated[int, Field(ge=0, le=99)] | None = None
    """The number of its display, as `colorphase devices` lists them: this program then shows the pattern on it; None:
    something else shows it."""
    colour_cycle_s: Positive | None = None
    """Time that R, G and B take together, where the projector shows them one after another; None: it does not."""
    fields: FieldSettings | None = None
    """Times at which each of them is on, by its data sheet; None: not known."""
    control: Annotated[str, _Driver("colorphase.projectors")] | None = None
    """Driver that switches it on: a name in `hardware.drivers`, one that an installed package announces, or
    ``module:Class``; None: somebody does."""
    port: str | None = None
    """A serial device, or a URL such as socket://10.0.0.6:4352."""
    baud: Count | None = None
    """Bits per second of a serial line; None: the projector's usual ones are tried."""
    password: str | None = None
    """PJLink's, where one is set; None: none. It is kept out of logs."""
    alternating: bool = False
    """True if each projector pulse shows the other of two pictures, the second one dimmer (`colorphase pattern
    --brightness 0.85`), so that a lost projector pulse is seen in the frames. Without, it goes unnoticed."""

    @model_validator(mode="after")
    def _check(self) -> "ProjectorSettings":
        if self.fields is not None and self.colour_cycle_s is None:
            raise ValueError("fields need colour_cycle_s, how long they take together")
        return self


class RigSettings(_Section):
    """A rig.

    Examples
    --------
    >>> timing = dict(period_s=0.02, frames=4, camera_delay_s=0.001)
    >>> parts = dict(trigger=dict(driver="simulated"), camera=dict(driver="simulated", exposure_s=0.008))
    >>> settings = colorphase.RigSettings(timing=timing, **parts)
    >>> f"{1000 * settings.camera.exposure_s:.0f} ms"
    '8 ms'
    """

    trigger: TriggerSettings
    timing: TimingSettings
    camera: CameraSettings
    projector: ProjectorSettings = ProjectorSettings()
    calibration: str | None = None
    """The rig's calibration.json, next to this file."""
