"""Settings as options, and TOML files to begin with: whatever is chosen, they are read as what was chosen."""

import tomllib
from itertools import product
from pathlib import Path

import pytest

from hardware.drivers import CAMERAS, PROJECTORS, SIMULATED, SOFTWARE, TRIGGERS
from hardware.settings import RigSettings
from pipeline.acquisition.chosen_rig import read_rig
from pipeline.cli.decode import SettingsOptions
from pipeline.cli.templates import _UNITS, _model_in, rig_template, settings_template
from pipeline.errors import SettingsError
from pipeline.settings import DecodeSettings

EVERY = list(product([*TRIGGERS, SOFTWARE, SIMULATED, "lab:Pulses"], [*CAMERAS, SIMULATED], [*PROJECTORS, None]))


def test_the_file_to_begin_with_has_every_setting_and_changes_nothing(command, tmp_path):
    code, said, _ = command("settings", "settings.toml")
    assert (code, said) == (0, "wrote settings.toml: decode with --settings settings.toml\n")
    path = tmp_path / "settings.toml"
    assert DecodeSettings.read(path) == DecodeSettings()
    text = path.read_text()
    assert all(len(line) <= 120 for line in text.splitlines())
    for name, field in DecodeSettings.model_fields.items():
        assert field.description and f"\n# {name} = " in text
    code, _, complained = command("settings", "settings.toml")
    assert code == 1 and "exists already: choose another name, or add --force" in complained


def test_the_display_that_the_projector_is():
    assert "\ndisplay = 1\n" in rig_template("software", "opencv", None, 1)
    assert "\n# display = (left out)\n" in rig_template("software", "opencv", None)


def test_what_is_uncommented_has_its_default():
    lines = settings_template().splitlines()
    given = [line[2:] for line in lines if " = " in line and line[2:].split(" = ")[0] in DecodeSettings.model_fields]
    set_ones = [line for line in given if not line.endswith("(left out)")]
    assert len(given) == len(DecodeSettings.model_fields) and len(set_ones) >= 3
    assert DecodeSettings(**tomllib.loads("\n".join(set_ones))) == DecodeSettings()


def test_options_overrule_the_file_and_leave_the_rest():
    said = DecodeSettings(smoothing_px=3, transfer="bt709", crosstalk_matrix=[[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])
    chosen = SettingsOptions(stripes="vertical", transfer="srgb", period=12.5).applied_to(said)
    assert (chosen.stripes, chosen.transfer, chosen.camera_period_px, chosen.smoothing_px) == (
        "vertical",
        "srgb",
        12.5,
        3,
    )
    assert chosen.crosstalk_matrix[0, 1] == 0.1
    assert chosen.model_fields_set == said.model_fields_set | {"stripes", "camera_period_px"}
    assert SettingsOptions().applied_to(said) is said
    assert SettingsOptions(smoothing=0, code="contrast").applied_to(said).smoothing_px == 0
    with pytest.raises(SettingsError, match="smoothing_px: must be 0 or odd"):
        SettingsOptions(smoothing=4).applied_to(said)


def keys_of(model, prefix=""):
    """Yield every key of a model and of its sections."""
    for name, field in model.model_fields.items():
        section = _model_in(field.annotation)
        if section is None:
            yield prefix + name, field
        else:
            yield from keys_of(section, f"{prefix}{name}.")


def fits(trigger, camera):
    return (trigger == SIMULATED) == (camera == SIMULATED) and (camera != "opencv" or trigger == SOFTWARE)


@pytest.mark.parametrize(("trigger", "camera", "control"), [each for each in EVERY if fits(*each[:2])])
def test_the_file_is_read_as_the_rig_that_was_chosen(tmp_path, trigger, camera, control):
    path = tmp_path / "rig.toml"
    path.write_text(rig_template(trigger, camera, control), encoding="utf-8")
    rig = read_rig(path)
    assert (rig.trigger.driver, rig.camera.driver, rig.projector.control) == (trigger, camera, control)
    assert (rig.trigger.port is None) == (trigger in (SOFTWARE, SIMULATED))
    assert (rig.projector.port is None) == (control is None)
    assert (rig.camera.trigger == "software") == (trigger == SOFTWARE)  # as `check_timing` asks for
    assert rig.timing.period_s > rig.camera.exposure_s
    assert Path(rig.calibration) == tmp_path / "calibration.json" and rig.projector.fields is None


def test_every_key_says_what_it_may_hold():
    settings = dict(_explanations(settings_template()))
    assert settings["stripes"].endswith('Allowed: "horizontal" or "vertical".')
    assert settings["camera_period_px"].endswith("Allowed: a number from 4 to 10000.")
    assert settings["capture"].endswith("Allowed: a section of exposure_s, gain, white_balance, transfer.")
    assert settings["noise"].endswith("Allowed: 2 values, each a number from 0 to 16777216.")
    assert "\n# crosstalk_matrix = " in settings_template().partition("Allowed: 3x3 numbers.")[2]
    assert settings_template().count("Allowed:") == len(DecodeSettings.model_fields)
    rig = dict(_explanations(rig_template("box", "basler", "pjlink")))
    assert 'Allowed: "free-running" or "per-pulse".' in rig["trigger.vsync"]
    assert 'Allowed: "basler", "aravis", "opencv", "simulated" or "module:Class".' in rig["camera.driver"]
    assert "Allowed: 2 values, each a whole number from 1 to 32768." in rig["camera.size_px"]
    assert "Allowed: a whole number from 0 to 99." in rig["projector.display"]


def test_every_key_is_explained_with_its_unit_and_default():
    text = rig_template("box", "basler", "pjlink")
    assert all(len(line) <= 120 for line in text.splitlines())
    comments = dict(_explanations(text))
    for key, field in keys_of(RigSettings):
        name = key.rpartition(".")[2]
        comment = comments[key]
        assert field.description, f"{key} is not explained"
        for suffix, unit in _UNITS.items():
            assert not name.endswith(suffix) or f"In {unit}." in comment
        assert "default" in comment.lower() or "left out" in comment
        assert field.is_required() == ("It has no default." in comment)
    assert comments.keys() == {key for key, _ in keys_of(RigSettings)}


def _explanations(text):
    """Yield each key of a template with the comment above it."""
    section, comment = "", []
    for line in text.splitlines():
        bare = line.removeprefix("# ")
        if bare.startswith("[") and bare.endswith("]"):
            section = bare[1:-1] + "."
        elif " = " in bare and bare.split(" = ")[0].isidentifier():
            yield section + bare.split(" = ")[0], " ".join(comment)
        elif line.startswith("# "):
            comment.append(bare)
            continue
        comment = []


def test_what_is_uncommented_is_marked_or_was_chosen():
    lines = [line for line in rig_template("dg645", "aravis", "infocus").splitlines() if line and line[0] not in "#["]
    marked = [line.split(" = ")[0] for line in lines if line.endswith("  # FILL IN")]
    assert marked == ["port", "period_s", "exposure_s", "port"]
    assert [line for line in lines if not line.endswith("  # FILL IN")] == [
        'calibration = "calibration.json"',
        'driver = "dg645"',
        'driver = "aravis"',
        'control = "infocus"',
    ]


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (("leica", "basler", None), '--trigger: driver: must be "box"'),
        (("box", "leica", None), '--camera: driver: must be "basler"'),
        (("box", "basler", "telnet"), '--projector: control: must be "pjlink"'),
        (("box", SIMULATED, None), "go together"),
        (("box", "opencv", None), "a webcam cannot be triggered"),
    ],
)
def test_what_cannot_be_a_rig_is_refused(chosen, message):
    with pytest.raises(SettingsError, match=message) as fault:
        rig_template(*chosen)
    assert "\n" not in str(fault.value)


def test_the_command_writes_it_and_replaces_nothing(command, tmp_path):
    arguments = ("rig", "rig.toml", "--trigger", "box", "--camera", "basler")
    said = "wrote rig.toml: fill in the 3 lines that end in FILL IN, and capture with --rig rig.toml\n"
    assert command(*arguments) == (0, said, "")
    assert read_rig(tmp_path / "rig.toml").projector.control is None
    (tmp_path / "rig.toml").write_text("mine")
    code, _, complained = command(*arguments)
    assert code == 1 and "exists already: choose another name, or add --force" in complained
    assert (tmp_path / "rig.toml").read_text() == "mine"
    assert command(*arguments, "--force")[0] == 0
