<<<<<<< HEAD
"""One picture into a folder: what a picture that cannot be decoded leaves, and what is said meanwhile."""
=======
"""A picture decoded into a folder: everything that a single frame gives, or nothing."""

import json
>>>>>>> refs/heads/tests

import numpy as np
import pytest

<<<<<<< HEAD
from pipeline.batch.one_frame import decode_picture
from pipeline.errors import DecodeWarning, FootageError, OutputError
from pipeline.footage.source import StoredAs
from pipeline.output.range_image import write_png
from pipeline.settings import DecodeSettings

AS_IT_SAYS = StoredAs()


def decode(picture, out, *, force=False):
    said = []
    frame = decode_picture(picture, out, DecodeSettings(), None, AS_IT_SAYS, "cpu", force=force, tell=said.append)
    return frame, said


def test_a_black_picture_gives_all_files_and_nothing_in_them(tmp_path):
    write_png(tmp_path / "black.png", np.zeros((48, 64, 3), np.uint8))
    with pytest.warns(DecodeWarning, match="no fringe stands out"):
        frame, said = decode(tmp_path / "black.png", tmp_path / "out")
    assert not frame.mask.any()
    assert said == ["reading", "decoding", "writing"]
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["mesh.ply", "range.png", "report.json", "result.zarr", "shaded.png"]


def test_what_cannot_be_read_leaves_no_folder(tmp_path):
    write_png(tmp_path / "whole.png", np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "half.png").write_bytes((tmp_path / "whole.png").read_bytes()[:60])
    for name in ("half.png", "none.png"):
        with pytest.raises(FootageError):
            decode(tmp_path / name, tmp_path / "out")
        assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_else_is_kept(tmp_path):
    write_png(tmp_path / "black.png", np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    with pytest.raises(OutputError, match="holds something else"):
        decode(tmp_path / "black.png", tmp_path / "out")
    with pytest.warns(DecodeWarning):
        decode(tmp_path / "black.png", tmp_path / "out", force=True)
    assert (tmp_path / "out" / "thesis.tex").exists()
=======
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
>>>>>>> refs/heads/tests
