"""What arrays say of themselves: by CF, the same in the store and in xarray."""

import re
import sys

import numpy as np
import pytest
import xarray

from pipeline import Decoder, DecodeSettings
from pipeline.decoding.frame import FIELDS
from pipeline.decoding.labels import (
    COORDINATES,
    DATASET_LABELS,
    axis_coordinates,
    dataset_labels,
    field_labels,
    frame_coordinates,
)
from pipeline.errors import OutputError, SettingsError
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig


@pytest.fixture(scope="module")
def decoded(cpu):
    """Return a frame in mm and one in rad, of which there is something to know."""
    rig = simulated_rig((128, 96), period_px=2 * 768 / 44)
    image = simulate_frame(rig, SimulationSettings(seed=1)).image
    decoders = (Decoder(DecodeSettings(), calibration, arch="cpu") for calibration in (rig, None))
    in_mm, in_rad = (decoder.decode(image) for decoder in decoders)
    in_rad.warnings = ("it is dim", "it moves")
    return in_mm, in_rad


@pytest.mark.parametrize("unit", ["mm", "rad"])
def test_every_unit_is_one_that_cf_knows(unit):
    units = {name: field_labels(name, field, unit).get("units") for name, field in FIELDS.items()}
    assert set(units.values()) == {"rad", "mm", "1", None}
    assert units["range_image"] == unit
    assert units["modulation"] == "1"
    for name, field in FIELDS.items():
        labels = field_labels(name, field, unit)
        assert labels["comment"] and "\n" not in labels["comment"]
        if field.dtype == "bool":
            assert len(labels["flag_meanings"].split()) == len(labels["flag_values"]) == 2


def test_labels_name_neither_machine_nor_time():
    labels = dataset_labels("0.9")
    assert labels["history"] == "decoded by colorphase 0.9"
    assert not re.search(r"[/\\]|\d\d:\d\d|20\d\d", " ".join(labels.values()))
    assert {*labels, "coordinates"} == set(DATASET_LABELS)


def test_coordinates_of_a_part_are_those_of_the_whole_picture():
    found = axis_coordinates(("y", "x", "rgb"), (4, 3), (100, 50))
    assert list(found) == ["y", "x", "rgb"]
    np.testing.assert_array_equal(found["y"][1], [50, 51, 52])
    np.testing.assert_array_equal(found["x"][1], [100, 101, 102, 103])


def test_rows_of_a_rolling_shutter_have_times():
    """From the first row of the camera's picture, of which a part may be decoded."""
    assert "row_time" not in axis_coordinates(("y", "x"), (4, 3))
    axes, values, labels = axis_coordinates(("y", "x"), (4, 3), (100, 50), 2e-5)["row_time"]
    assert (axes, labels["units"]) == (("y",), "s")
    np.testing.assert_allclose(values, [1e-3, 1.02e-3, 1.04e-3])


def test_times_have_a_date_only_where_one_is_known():
    assert list(frame_coordinates(3)) == ["frame"]
    seconds = np.array([0, 0.1, 0.3])
    assert frame_coordinates(3, seconds)["time"][2]["units"] == "s"
    dated = frame_coordinates(3, seconds, "2026-11-25T10:00:00Z")["time"][2]
    assert (dated["units"], dated["calendar"]) == ("seconds since 2026-11-25T10:00:00Z", "standard")
    assert set(frame_coordinates(3, seconds)) < set(COORDINATES)


def test_a_frame_as_a_dataset(decoded):
    frame = decoded[0]
    dataset = frame.to_xarray()
    assert set(dataset.data_vars) == set(FIELDS)
    np.testing.assert_array_equal(dataset.points.sel(xyz="z"), frame.range_image)
    np.testing.assert_array_equal(dataset.texture.sel(rgb="G"), frame.texture[..., 1])
    assert float(dataset.range_image.sel(y=3, x=20)) == frame.range_image[3, 20]
    assert dataset.range_image.attrs["units"] == dataset.attrs["range_unit"] == "mm"
    assert dataset.constant_sigma.shape == ()
    assert dataset.attrs["Conventions"] == "CF-1.11"
    mean = float(dataset.range_image.where(dataset.mask).mean())
    assert mean == pytest.approx(float(frame.range_image[frame.mask].mean()), rel=1e-5)


def test_a_frame_in_rad_says_so_and_what_to_know(decoded):
    dataset = decoded[1].to_xarray()
    assert dataset.range_image.attrs["units"] == "rad"
    assert not {"points", "point_sigma"} & set(dataset.data_vars)
    assert "xyz" not in dataset.coords
    assert dataset.attrs["comment"].splitlines() == ["it is dim", "it moves"]
    assert "comment" not in decoded[0].to_xarray().attrs


def test_it_can_be_written_as_netcdf(decoded, tmp_path):
    """Which takes no nested labels; by SciPy, which scikit-image brings, and which knows no bytes."""
    dataset = decoded[0].to_xarray().drop_vars("texture")
    dataset.to_netcdf(tmp_path / "frame.nc", engine="scipy")
    with xarray.open_dataset(tmp_path / "frame.nc", engine="scipy") as again:
        np.testing.assert_array_equal(again.range_image, dataset.range_image)
        assert again.range_image.attrs["units"] == "mm"
        assert list(again.xyz.astype(str).values) == ["x", "y", "z"]


def test_without_xarray_one_line_says_what_to_do(decoded, monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(OutputError, match=r"^xarray is not installed: pip install 'colorphase\[xarray\]'$"):
        decoded[0].to_xarray()


def test_a_frame_draws_its_fields(decoded):
    in_mm, in_rad = decoded
    assert in_mm.plot().axes[1].get_ylabel() == "range image (mm)"
    assert in_rad.plot().axes[1].get_ylabel() == "range image (rad)"
    assert in_mm.plot("modulation").axes[1].get_ylabel() == "modulation (grey levels)"
    assert in_mm.plot("region").axes[1].get_ylabel() == "region"
    np.testing.assert_array_equal(in_mm.plot("texture").axes[0].images[0].get_array(), in_mm.texture)
    assert in_mm.plot("point_sigma") is not in_mm.plot("point_sigma")


@pytest.mark.parametrize("field", ["points", "constant_sigma", "depth"])
def test_what_is_no_picture_is_refused(decoded, field):
    with pytest.raises(SettingsError, match=rf"cannot plot '{field}': choose one of wrapped_phase, .*range_image"):
        decoded[0].plot(field)
    with pytest.raises(SettingsError, match="cannot plot 'point_sigma'"):
        decoded[1].plot("point_sigma")
