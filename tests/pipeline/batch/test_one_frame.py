"""A picture decoded into a folder: everything that a single frame gives, or nothing."""

import json

import numpy as np
import pytest

from pipeline import DecodeSettings
from pipeline.batch.one_frame import decode_picture
from pipeline.errors import FootageError
from pipeline.footage.image_file import read_image
from pipeline.footage.source import StoredAs
from pipeline.output.mesh_files import read_mesh
from pipeline.output.range_image import write_png
from pipeline.simulation import TYPICAL_CROSSTALK, simulate_frame, simulated_rig

pytestmark = pytest.mark.usefixtures("cpu")


@pytest.fixture
def picture(tmp_path):
    rig = simulated_rig((128, 96), period_px=2 * 768 / 44)
    write_png(tmp_path / "frame.png", simulate_frame(rig).image)
    return tmp_path / "frame.png", rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})


def decoded(path, out, calibration, told=None):
    tell = (lambda text: None) if told is None else told.append
    return decode_picture(path, out, DecodeSettings(), calibration, StoredAs(), "cpu", force=False, tell=tell)


def test_a_folder_with_all_that_a_frame_gives(picture, tmp_path):
    path, calibration = picture
    told = []
    frame = decoded(path, tmp_path / "out", calibration, told)
    assert told == ["reading", "decoding", "writing"]
    names = {"mesh.ply", "range.png", "report.json", "result.zarr", "shaded.png"}
    assert {entry.name for entry in (tmp_path / "out").iterdir()} == names
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["source"] == "frame.png" and report["range_unit"] == "mm"
    assert report["valid_fraction"] == frame.mask.mean() > 0.5
    assert len(read_mesh(tmp_path / "out" / "mesh.ply").vertices) == frame.mask.sum()
    assert read_image(tmp_path / "out" / "shaded.png").shape == (96, 128, 3)


def test_a_picture_that_cannot_be_read_leaves_no_folder(picture, tmp_path):
    path, calibration = picture
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(FootageError, match=r"frame\.png.*truncated"):
        decoded(path, tmp_path / "out", calibration)
    assert [entry.name for entry in tmp_path.iterdir()] == ["frame.png"]
