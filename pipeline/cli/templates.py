"""`colorphase settings` and `colorphase rig`: TOML files to begin with, in which every key is explained."""

import json
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

from cyclopts import Parameter
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from hardware.drivers import CAMERAS, PROJECTORS, SIMULATED, SOFTWARE, TRIGGERS
from hardware.models import allowed_values
from hardware.settings import CameraSettings, ProjectorSettings, RigSettings, TriggerSettings
from pipeline.cli.console import Replace, bounded, check_target, say
from pipeline.errors import SettingsError
from pipeline.files import write_atomically
from pipeline.models import build
from pipeline.settings import DecodeSettings

_WIDTH = 118
_FILL_IN = "FILL IN"
_UNITS = {"_s": "s", "_db": "dB", "_px": "px"}
# Plausible values where each rig has its own: of a camera at 20 frames per second before a projector at 60 Hz, whose
# colour fields are thirds of a cycle.
_EXAMPLES = {
    "calibration": "calibration.json",
    "trigger.port": "/dev/ttyUSB0",
    "timing.period_s": 0.05,
    "camera.exposure_s": 0.016667,
    "projector.port": "/dev/ttyUSB1",
    "projector.fields.red_s": 0.0028,
    "projector.fields.green_s": 0.0083,
    "projector.fields.blue_s": 0.0139,
}
# Drivers whose instruments are mostly spoken to over the network, at their usual ports.
_NETWORK = {"dg645": "socket://10.0.0.5:5025", "pjlink": "socket://10.0.0.6:4352"}
# This program triggers some milliseconds late: most cameras keep up with this.
_SOFTWARE_PERIOD_S = 0.5
_NO_PROJECTOR = "none"


def settings(file: Path, /, *, force: Replace = False) -> None:
    """Write a file of all settings with their defaults and what they mean, each to be uncommented where it is changed.

    Example: colorphase settings settings.toml

    Parameters
    ----------
    file
        The TOML file to make.
    """
    check_target(file, force=force)
    write_atomically(file, settings_template().encode())
    say(f"wrote {file}: decode with --settings {file}")


def settings_template() -> str:
    """Return a settings file in which every default is a comment, below what it means."""
    lines = ["# Settings for colorphase decode. What is commented out, or left out, has its default."]
    for name, field in DecodeSettings.model_fields.items():
        meaning = " ".join((field.description or "").split())
        lines += ["", *_comment(f"{meaning} Allowed: {allowed_values(DecodeSettings, name)}.")]
        default = "(left out)" if field.default is None else json.dumps(field.default)
        lines.append(f"# {name} = {default}")
    return "\n".join(lines) + "\n"


def rig(
    file: Path,
    /,
    *,
    trigger: Annotated[
        str, Parameter(help=f"Where the pulses come from: {', '.join([*TRIGGERS, SOFTWARE, SIMULATED])}.")
    ],
    camera: Annotated[str, Parameter(help=f"The camera's driver: {', '.join([*CAMERAS, SIMULATED])}.")],
    projector: Annotated[
        str, Parameter(help=f"What switches the projector: {', '.join(PROJECTORS)}; or none: somebody does.")
    ] = _NO_PROJECTOR,
    display: Annotated[
        int | None, Parameter(validator=bounded(0), help="Which display it is, as `colorphase devices` numbers them.")
    ] = None,
    serial: Annotated[str | None, Parameter(help="The camera's serial number, or a webcam's number.")] = None,
    force: Replace = False,
) -> None:
    """Write a rig.toml for some instruments, in which every key is explained, and what is to be filled in is marked.

    A driver of your own is named as module:Class.

    Example: colorphase rig rig.toml --trigger box --camera basler --projector pjlink

    Parameters
    ----------
    file
        The TOML file to make.
    """
    check_target(file, force=force)
    text = rig_template(trigger, camera, None if projector == _NO_PROJECTOR else projector, display, serial)
    write_atomically(file, text.encode())
    n_marked = text.count(f"  # {_FILL_IN}\n")
    say(f"wrote {file}: fill in the {n_marked} lines that end in {_FILL_IN}, and capture with --rig {file}")


def rig_template(
    trigger: str, camera: str, control: str | None, display: int | None = None, serial: str | None = None
) -> str:
    """Return a rig's file in which every key follows its meaning, a comment where it has its default.

    Parameters
    ----------
    trigger, camera : str
        The drivers, by their names in `hardware.drivers` or as ``module:Class``.
    control : str or None
        The projector's; None: nothing switches it.
    display : int or None
        Number of the projector's display; None: something else shows the pattern.
    serial : str or None
        The camera's serial number; None: the only camera there is.

    Raises
    ------
    SettingsError
        There is no such driver, or these do not go together.
    """
    _check_drivers(trigger, camera, control)
    given: dict[str, Any] = {"trigger.driver": trigger, "camera.driver": camera, "projector.display": display}
    given["camera.serial"] = serial
    given["calibration"] = _EXAMPLES["calibration"]
    needed = {"timing.period_s", "camera.exposure_s"}
    if trigger in (SOFTWARE, SIMULATED):
        given["camera.trigger"] = "software" if trigger == SOFTWARE else None
        given["timing.period_s"] = _SOFTWARE_PERIOD_S if trigger == SOFTWARE else _EXAMPLES["timing.period_s"]
    else:
        given["trigger.port"] = _NETWORK.get(trigger, _EXAMPLES["trigger.port"])
        needed.add("trigger.port")
    if control is not None:
        given["projector.control"] = control
        given["projector.port"] = _NETWORK.get(control, _EXAMPLES["projector.port"])
        needed.add("projector.port")
    values = {**{key: _EXAMPLES[key] for key in needed}, **{key: v for key, v in given.items() if v is not None}}
    lines = [
        "# A rig for colorphase capture. What is commented out, or left out, has its default.",
        f"# Lines that end in {_FILL_IN} hold an example: put your rig's value there.",
        *_section(RigSettings, "", values, needed),
    ]
    return "\n".join(lines) + "\n"


def _check_drivers(trigger: str, camera: str, control: str | None) -> None:
    """Refuse drivers that there are not, or that do not go together."""
    for option, model, values in (
        ("--trigger", TriggerSettings, {"driver": trigger}),
        ("--camera", CameraSettings, {"driver": camera, "exposure_s": _EXAMPLES["camera.exposure_s"]}),
        ("--projector", ProjectorSettings, {"control": control}),
    ):
        build(model, values, SettingsError, option)
    if (trigger == SIMULATED) != (camera == SIMULATED):
        raise SettingsError("a simulated trigger source and a simulated camera go together: choose simulated for both")
    if camera == "opencv" and trigger != SOFTWARE:
        raise SettingsError("a webcam cannot be triggered: choose --trigger software, or another --camera")


def _section(model: type[BaseModel], prefix: str, values: Mapping[str, Any], needed: set[str]) -> Iterator[str]:
    """Yield the lines of a section: its keys, then the sections in it; one that nobody needs is commented out."""
    inner: list[tuple[str, FieldInfo, type[BaseModel]]] = []
    for name, field in model.model_fields.items():
        section = _model_in(field.annotation)
        if section is not None:
            inner.append((name, field, section))
            continue
        key = prefix + name
        yield from ("", *_explained(model, name, field))
        value = values.get(key, _EXAMPLES.get(key, field.default) if field.is_required() else field.default)
        shown = "(left out)" if value is None else json.dumps(value)
        mark = f"  # {_FILL_IN}" if key in needed else ""
        yield f"{name} = {shown}{mark}" if key in values else f"# {name} = {shown}"
    for name, field, section in inner:
        optional = field.default is None
        said = " ".join((field.description or section.__doc__ or "").split())
        yield from ("", *_comment(said.replace("None:", "left out:")))
        yield f"{'# ' if optional else ''}[{prefix}{name}]"
        yield from _section(section, f"{prefix}{name}.", values, needed)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the section that a key holds, if it does."""
    for kind in (annotation, *get_args(annotation)):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind
    return None


def _explained(model: type[BaseModel], name: str, field: FieldInfo) -> list[str]:
    """Return the comment above a key: its meaning, its unit, what it may be and its default."""
    meaning = " ".join((field.description or "").split()).replace("None:", "left out:").rstrip(".")
    sentences = [meaning, *(f"In {unit}" for suffix, unit in _UNITS.items() if name.endswith(suffix))]
    if (allowed := allowed_values(model, name)) != "text":
        sentences.append(f"Allowed: {allowed}")
    if field.is_required():
        sentences.append("It has no default")
    elif field.default is not None:
        sentences.append(f"Default: {json.dumps(field.default)}")
    elif "left out:" not in meaning:
        sentences.append("Default: left out")
    return _comment(". ".join(sentences) + ".")


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False)
