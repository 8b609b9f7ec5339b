"""Pictures to project, and the captures of them under the same names."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.calibration.captures import (
    CapturedFolder,
    PictureSequence,
    captured_files,
    full_scale,
    write_sequence,
)
from pipeline.errors import CalibrationError, OutputError
from pipeline.footage.image_file import read_image
from pipeline.models import SensorPart

SEQUENCE = PictureSequence(kind="radiometry", size_px=(6, 4), names=("00-black", "01-red"))


def codes(name):
    picture = np.zeros((4, 6, 3))
    picture[..., 0] = 0.5 if name == "01-red" else 0.0
    return picture


def test_a_sequence_is_written_whole(tmp_path):
    write_sequence(tmp_path / "new" / "ramps", SEQUENCE, codes)
    folder = tmp_path / "new" / "ramps"
    assert {entry.name for entry in folder.iterdir()} == {"00-black.png", "01-red.png", "sequence.json"}
    assert json.loads((folder / "sequence.json").read_text())["names"] == ["00-black", "01-red"]
    np.testing.assert_array_equal(read_image(folder / "01-red.png")[0, 0], (128, 0, 0))


def test_a_sequence_that_fails_leaves_nothing(tmp_path):
    def broken(name):
        if name == "01-red":
            raise OSError(28, "No space left on device")
        return codes(name)

    with pytest.raises(OutputError, match="the disk is full"):
        write_sequence(tmp_path / "ramps", SEQUENCE, broken)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(OutputError, match="is not an empty folder"):
        write_sequence(tmp_path, SEQUENCE, codes)
    assert [entry.name for entry in tmp_path.iterdir()] == ["mine"]


def test_captures_may_be_tiff_and_each_is_read_when_asked_for(tmp_path):
    write_sequence(tmp_path / "ramps", SEQUENCE, codes)
    folder = tmp_path / "ramps"
    red = read_image(folder / "01-red.png")
    (folder / "01-red.png").unlink()
    (folder / "01-red.TIF").write_bytes(cv2.imencode(".tif", red[..., ::-1])[1].tobytes())
    (folder / "notes.txt").write_text("")
    assert captured_files(folder).keys() == {"00-black", "01-red"}
    captures = CapturedFolder(folder, SEQUENCE.names)
    assert list(captures) == list(SEQUENCE.names) and len(captures) == 2
    np.testing.assert_array_equal(captures["01-red"], red)


def test_a_missing_capture_is_named(tmp_path):
    with pytest.raises(CalibrationError, match=r"lacks the capture 00-black\.png and 1 more"):
        CapturedFolder(tmp_path, SEQUENCE.names)


def test_captures_are_of_the_part_of_the_sensor_that_their_session_says(tmp_path):
    part = SensorPart(sensor_px=(99, 80), offset_px=(4, 7), binning=(2, 1))
    pose = tmp_path / "poses" / "pose-01"
    pose.mkdir(parents=True)
    assert CapturedFolder(pose, ()).sensor is None
    session = tmp_path / "session.json"
    for said, found in (({}, None), ({"part of the sensor": part.model_dump()}, part)):
        session.write_text(json.dumps(said))
        assert CapturedFolder(pose, ()).sensor == CapturedFolder(pose.parent, ()).sensor == found
    for text in ("[", "[]", '{"part of the sensor": 1}'):
        session.write_text(text)
        with pytest.raises(CalibrationError, match=r"session\.json"):
            CapturedFolder(pose, ())


def test_captures_that_are_turned_otherwise_are_named(tmp_path):
    """Within a pose and between poses: turned by 180 degrees, which their size does not show."""
    orientations = []
    for pose, second in (("a", 1), ("b", 3)):
        (tmp_path / pose).mkdir()
        for name, orientation in (("00-black", 1), ("01-red", second)):
            tags = Image.Exif()
            tags[274] = orientation
            Image.new("RGB", (6, 4)).save(tmp_path / pose / f"{name}.png", exif=tags)
        captures = CapturedFolder(tmp_path / pose, SEQUENCE.names, orientations)
        assert captures["00-black"].shape == (4, 6, 3)
    with pytest.raises(CalibrationError, match=r"01-red\.png: its Exif orientation is 3, the first has 1"):
        captures["01-red"]
    with pytest.raises(CalibrationError, match=r"00-black\.png: its Exif orientation is 1, the first has 3"):
        CapturedFolder(tmp_path / "a", SEQUENCE.names, [3])["00-black"]


def test_captures_of_two_cameras_do_not_mix(tmp_path):
    write_sequence(tmp_path / "ramps", SEQUENCE, codes)
    cv2.imwrite(str(tmp_path / "ramps" / "01-red.png"), np.zeros((5, 6, 3), np.uint16))
    captures = CapturedFolder(tmp_path / "ramps", SEQUENCE.names)
    assert captures["00-black"].shape == (4, 6, 3)
    with pytest.raises(CalibrationError, match=r"01-red\.png is 6x5 uint16, others are 6x4 uint8: do not change"):
        captures["01-red"]


def test_full_scale_is_the_types_where_nobody_knows_better():
    assert full_scale(np.full((2, 2, 3), 200, np.uint8)) == 255
    assert full_scale(np.full((2, 2, 3), 0.4, np.float32)) == 1.0
    assert full_scale(np.full((2, 2, 3), 900, np.uint16), 1023) == 1023
    with pytest.raises(CalibrationError, match="end at 4095: the camera has fewer bits, give 4095"):
        full_scale(np.full((2, 2, 3), 4095, np.uint16))
    with pytest.raises(CalibrationError, match="white_level is 0"):
        full_scale(np.zeros((2, 2, 3), np.uint16), 0)
