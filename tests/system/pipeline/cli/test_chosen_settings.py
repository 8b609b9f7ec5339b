"""Settings as options, and as a file to begin with."""

import tomllib

import pytest

from pipeline.cli.decode import SettingsOptions
from pipeline.cli.templates import settings_template
from pipeline.errors import SettingsError
from pipeline.settings import DecodeSettings


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


def test_what_is_uncommented_has_its_default():
    lines = settings_template().splitlines()
    given = [line[2:] for line in lines if " = " in line and line[2:].split(" = ")[0] in DecodeSettings.model_fields]
    set_ones = [line for line in given if not line.endswith("(left out)")]
    assert len(given) == len(DecodeSettings.model_fields) and len(set_ones) >= 3
    assert DecodeSettings.of(**tomllib.loads("\n".join(set_ones))) == DecodeSettings()


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
