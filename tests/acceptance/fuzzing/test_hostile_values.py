"""Any value under any key of settings, calibrations and rig files: accepted, or refused in one line."""

import json
import tomllib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hardware.errors import RigError
from hardware.settings import RigSettings
from pipeline.calibration import Calibration
from pipeline.errors import CalibrationError, SettingsError
from pipeline.models import build, read_file
from pipeline.settings import DecodeSettings
from pipeline.text import one_line
from tikernels.errors import Error

FIXED = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=200,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
MODELS = {DecodeSettings: SettingsError, Calibration: CalibrationError, RigSettings: RigError}
NUMBERS = st.one_of(st.integers(), st.floats(), st.sampled_from([0, -1, 2**31, 2**63, 10**400, 1e308, 1e-320]))
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=8)),
    lambda values: st.one_of(st.lists(values, max_size=4), st.dictionaries(st.text(max_size=8), values, max_size=3)),
    max_leaves=12,
)
MATRICES = st.lists(st.lists(NUMBERS, min_size=3, max_size=3), min_size=3, max_size=3)


@pytest.mark.parametrize("model", MODELS)
def test_any_value_is_accepted_or_refused_in_one_line(model):
    @FIXED
    @given(st.dictionaries(st.sampled_from([*model.model_fields]), st.one_of(VALUES, MATRICES), max_size=6))
    def check(values):
        try:
            build(model, values, MODELS[model], "values")
        except MODELS[model] as error:
            assert "\n" not in str(error) and "Input should" not in str(error)

    check()


@pytest.mark.parametrize("parse", [json.loads, tomllib.loads])
def test_any_text_is_read_or_refused_in_one_line(parse, tmp_path_factory):
    path = tmp_path_factory.mktemp("texts") / "text"

    @FIXED
    @given(st.one_of(st.binary(max_size=200), st.text(max_size=200).map(lambda text: text.encode("utf-8", "replace"))))
    def check(content):
        path.write_bytes(content)
        try:
            read_file(path, DecodeSettings, parse, SettingsError)
        except Error as error:
            assert "\n" not in str(error)

    check()


@FIXED
@given(st.text(st.characters()))
def test_what_is_printed_has_no_control_characters(text):
    shown = one_line(text)
    assert not [letter for letter in shown if letter < " " or "\x7f" <= letter <= "\x9f" or letter in "\u202e\u2028"]
    assert shown.encode().decode() == shown
    assert one_line(shown) == shown
