"""What a store says of itself, and nobody else."""

import json

import pytest
import zarr
from support.stored_planes import store

from pipeline.errors import DamageError, FootageError
from pipeline.output.store import is_there
from pipeline.output.stored_result import StoredResult

pytestmark = pytest.mark.usefixtures("cpu")


@pytest.mark.parametrize(
    "edit",
    [
        lambda about: about["attributes"].update(settings={"smoothing_px": 1}),
        lambda about: about["attributes"].update(light=[1, "odd"]),
        lambda about: about["attributes"].update(note="mine"),
        lambda about: about["attributes"].pop("range_unit"),
    ],
)
def test_attributes_that_were_edited(tmp_path, edit):
    path = store(tmp_path / "result.zarr", [400.0])
    about = json.loads((path / "zarr.json").read_text())
    edit(about)
    (path / "zarr.json").write_text(json.dumps(about))
    with pytest.raises(FootageError, match="its metadata is not what was written"):
        StoredResult(path)
    with pytest.raises(DamageError):
        is_there(path)


@pytest.mark.parametrize(
    ("key", "value"), [("shape", [2, 60, 80]), ("data_type", "uint8"), ("codecs", []), ("fill_value", True)]
)
def test_an_array_that_was_edited(tmp_path, key, value):
    path = store(tmp_path / "result.zarr", [400.0])
    about = json.loads((path / "mask" / "zarr.json").read_text())
    (path / "mask" / "zarr.json").write_text(json.dumps({**about, key: value}))
    with pytest.raises(FootageError, match="its metadata is not what was written"):
        StoredResult(path)


@pytest.mark.parametrize("in_mm", [True, False])
def test_arrays_say_what_they_are(tmp_path, in_mm):
    """By the names that xarray shows."""
    group = zarr.open_group(store(tmp_path / "result.zarr", [400.0], in_mm=in_mm), mode="r")
    assert group["range_image"].attrs["units"] == ("mm" if in_mm else "rad")
    assert group["phase_sigma"].attrs["units"] == "rad"
    assert "units" not in group["mask"].attrs
    assert group["mask"].attrs["long_name"] == "mask"
    assert group["modulation"].attrs["comment"].startswith("The fringe's amplitude")
