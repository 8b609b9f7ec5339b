"""Settings from a file: each mistake is one line that names the key."""

import numpy as np
import pytest

from pipeline import DecodeSettings
from pipeline.errors import SettingsError


def test_settings_from_toml(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text('stripes = "vertical"\nsmoothing_px = 7\nnoise = [1.5, 0.0]\n')
    settings = DecodeSettings.read(path)
    assert (settings.stripes, settings.smoothing_px, settings.noise) == ("vertical", 7, (1.5, 0.0))
    assert settings.equalize  # what is left out is the default


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stripe = 'vertical'", "stripe: is not a known key"),
        ("stripes = 'diagonal'", "stripes: "),
        ("smoothing_px = 4", "smoothing_px: must be 0 or odd"),
        ("camera_period_px = 2.0", "camera_period_px"),
        ("crosstalk_matrix = [[1, 0, 0], [1, 0, 0], [0, 0, 1]]", "crosstalk_matrix cannot be inverted"),
        ("camera_period_px = 1e6", "camera_period_px: must be a number from 4 to 10000, got 1000000.0"),
        ("white_level = 1e30", "white_level: must be a number from 0.0009765625 to 16777216, got 1e\\+30"),
        ("white_level = 1e-6", "white_level: must be a number from 0.0009765625 to 16777216, got 1e-06"),
        ("noise = [1e300, 0.0]", "noise.0: must be a number from 0 to 16777216, got 1e\\+300"),
        ("min_modulation = 1e39", "min_modulation"),
        ("fields = {cycle_s = 1e9}", "fields.cycle_s: must be a number above 0 and at most 3600"),
        ("frame_s = 0.01\nfields = {cycle_s = 0.016}", "fields: a colour cycle of 0.016 s is longer than a frame"),
        (
            "fields = {cycle_s = 1, shown_s = [[0, 0.4], [0.3, 0.6], [0.6, 1]]}",
            "fields: two colours are on at the same time: a white, yellow or cyan segment",
        ),
        (
            "fields = {cycle_s = 0.5, shown_s = [[0, 0.3], [0.3, 0.6], [0.7, 1]]}",
            "fields: each colour must go on before it goes off, and all within 0.5 s",
        ),
        ("fields = {cycle_s = 0.5, locked = true}", "fields: locked needs shown_s"),
        ("fields = {cycle_s = 0.5}", "fields need frame_s"),
        ("row_s = -1", "row_s: must be a number from 0 to 3600"),
        ("a = [", "not what it should be"),
    ],
)
def test_wrong_settings_are_refused_by_their_key(tmp_path, text, message):
    path = tmp_path / "settings.toml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=message):
        DecodeSettings.read(path)


def test_fields_in_cycles_and_frames():
    shown_s = ((0, 0.1), (0.1, 0.2), (0.2, 0.3))
    told = DecodeSettings(frame_s=0.5, fields={"cycle_s": 0.3, "shown_s": shown_s, "locked": True}).fields
    fields = told.in_cycles(0.5, 0.003)
    assert (fields.cycle, fields.row, fields.start) == (pytest.approx(0.6), pytest.approx(0.01), 0.0)
    np.testing.assert_allclose(fields.shown, [[0, 1 / 3], [1 / 3, 2 / 3], [2 / 3, 1]])
    assert told.model_copy(update={"locked": False}).in_cycles(0.5, 0.003).start is None
