"""The store of results."""

import pytest

from pipeline.errors import SettingsError
from pipeline.output.store import chosen_fields

pytestmark = pytest.mark.usefixtures("cpu")


def test_fields_that_are_none():
    with pytest.raises(SettingsError, match="no field is called 'depth': choose of wrapped_phase"):
        chosen_fields(("depth",), in_mm=False)
    with pytest.raises(SettingsError, match="points needs a calibration"):
        chosen_fields(("points",), in_mm=False)
    assert chosen_fields(("range_image", "mask"), in_mm=False) == ("mask", "range_image")
