"""Models of users' files: arrays with their shapes, unknown keys refused, one line that names the key."""

import json
import tomllib
from typing import Annotated

import numpy as np
import pytest

from pipeline.errors import SettingsError
from pipeline.models import ArrayOf, FloatArray, Matrix3, Model, Positive, build, read_file


class Lamp(Model):
    """A lamp."""

    watts: Positive
    colour: Annotated[FloatArray, ArrayOf((3,))]
    mixing: Matrix3 | None = None


def refused(values):
    with pytest.raises(SettingsError) as raised:
        build(Lamp, values, SettingsError, "lamp.toml")
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_arrays_are_float64_and_read_only_and_survive_json():
    lamp = build(Lamp, {"watts": 5, "colour": [1, 0.5, 0]}, SettingsError, "lamp")
    assert lamp.colour.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        lamp.colour[0] = 2
    again = Lamp.model_validate(json.loads(lamp.model_dump_json()))
    np.testing.assert_array_equal(again.colour, lamp.colour)
    assert again.mixing is None


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"watts": 0}, "lamp.toml: watts: must be a number above 0 and at most 1000000000, got 0"),
        ({"watts": float("inf")}, "lamp.toml: watts: must be a number above 0 and at most 1000000000, got Infinity"),
        ({"volts": 3}, "lamp.toml: volts: is not a known key"),
        ({"colour": [1, 2]}, "lamp.toml: colour: must have shape (3,), got (2,)"),
        ({"colour": [1, 2, "x"]}, "lamp.toml: colour: must be 3 numbers"),
        ({"colour": [1, 2, float("nan")]}, "lamp.toml: colour: must be finite"),
        ({"colour": [1, 2, 1e300]}, "lamp.toml: colour: must lie from -1e+09 to 1e+09"),
        ({"colour": [1, 2, 10**400]}, "lamp.toml: colour: must be 3 numbers"),
        ({"watts": 1e10}, "lamp.toml: watts: must be a number above 0 and at most 1000000000, got 10000000000.0"),
        (
            {"watts": -1, "volts": 3},
            "lamp.toml: watts: must be a number above 0 and at most 1000000000, got -1 (and 1 more)",
        ),
    ],
)
def test_one_line_names_the_key(changed, message):
    assert refused({"watts": 5, "colour": [1, 0.5, 0], **changed}) == message


def test_what_is_missing_is_named():
    assert refused({"watts": 5}) == "lamp.toml: colour: is missing"


@pytest.mark.parametrize(
    ("parse", "content", "message"),
    [
        (json.loads, "[" * 100_000, "nested too deep"),
        (tomllib.loads, "a = " + "[" * 100_000, "nested too deep"),
        (tomllib.loads, "a." * 100_000 + "a = 1", "nested too deep"),  # takes minutes, and all memory
        (json.loads, '{"watts": ' + "9" * 5000 + "}", "a number in it has more than 400 digits"),
        (json.loads, " " * 2**21, "larger than 1,048,576 bytes"),
        (json.loads, '{"watts": 1, "colour": ' + "[" * 300 + "]" * 300 + "}", "colour: must be 3 numbers|colour: must"),
    ],
)
def test_files_that_would_take_all_memory_or_time(tmp_path, parse, content, message):
    (tmp_path / "lamp").write_text(content)
    with pytest.raises(SettingsError, match=message) as raised:
        read_file(tmp_path / "lamp", Lamp, parse, SettingsError)
    assert "\n" not in str(raised.value)


def test_constructors_name_the_key_from_the_top():
    class Room(Model):
        lamp: Lamp

    with pytest.raises(SettingsError, match=r"^watts: must be"):
        Lamp(watts=0, colour=(1, 1, 1))
    for values, message in (
        ({"lamp": {"watts": 0, "colour": (1, 1, 1)}}, "lamp.watts: must be a number above 0 and at most 1000000000"),
        ({}, "lamp: is missing"),
        ({"lamp": {}, "door": 1}, r"lamp.watts: is missing \(and 2 more\)"),
    ):
        with pytest.raises(SettingsError, match=f"^{message}") as raised:
            Room(**values)
        assert "\n" not in str(raised.value)


def test_a_replaced_value_is_checked_and_what_was_left_out_stays_left_out():
    lamp = Lamp(watts=5, colour=(1, 0.5, 0))
    changed = lamp.replace(watts=7)
    assert (changed.watts, lamp.watts, changed.model_fields_set) == (7, 5, {"watts", "colour"})
    np.testing.assert_array_equal(changed.colour, lamp.colour)
    for values, message in (({"watts": -7}, "watts: must be"), ({"volts": 3}, "volts: is not a known key")):
        with pytest.raises(SettingsError, match=message):
            lamp.replace(**values)


def test_files_that_cannot_be_read(tmp_path):
    for content, message in ((b"\xff\x00", "it is no text file"), (b"{", "is not what it should be")):
        (tmp_path / "lamp.json").write_bytes(content)
        with pytest.raises(SettingsError, match=message):
            read_file(tmp_path / "lamp.json", Lamp, json.loads, SettingsError)
    with pytest.raises(SettingsError, match=r"cannot read .*none\.json: No such file"):
        read_file(tmp_path / "none.json", Lamp, json.loads, SettingsError)
