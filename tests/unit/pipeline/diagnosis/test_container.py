"""What containers say of themselves, and which frames are missing between others."""

import cv2
import numpy as np
import pytest
from support.numbered_frames import record
from support.video_files import encode

from pipeline.diagnosis.footage_inspection import _missing, container_facts
from pipeline.footage.opening import open_source


def facts(path):
    return container_facts(path, open_source(path))


@pytest.mark.parametrize(
    ("places", "missing"),
    [
        ([0, 1, 2, 3, 4, 5], (0, 0)),
        ([0, 40, 80, 200, 240, 280, 320], (2, 1)),
        ([3, 4, 6, 7, 8, 9, 12, 13, 14, 15, 16, 17], (3, 2)),
        ([0, 33, 67, 100, 133, 167], (0, 0)),  # a clock of whole ms
        ([0, 1], (None, 0)),
        ([0, 1, 1, 2], (None, 0)),
        ([0, 5, 6, 30, 31, 90], (None, 0)),  # no rate at all
    ],
)
def test_steps_longer_than_the_usual_one_hide_frames(places, missing):
    assert _missing(places) == missing


def test_a_folder_counts_by_the_numbers_in_its_names(tmp_path):
    for number in (1, 2, 3, 4, 5, 7):
        cv2.imwrite(str(tmp_path / f"take2_{number}.png"), np.zeros((16, 16, 3), np.uint8))
    found = facts(tmp_path)
    assert (found.container, found.codec, found.lossy) == ("a folder of pictures", "png", False)
    assert (found.missing, found.gaps) == (1, 1)


def test_a_picture_may_have_been_made_smaller(tmp_path):
    (tmp_path / "a.jpg").write_bytes(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    found = facts(tmp_path / "a.jpg")
    assert found.container == "a picture" and found.lossy and found.missing is None


def test_a_recording_is_ours(tmp_path):
    record(tmp_path / "a.zarr")
    assert facts(tmp_path / "a.zarr").container == "our recording in Zarr"


def test_a_video_says_its_codec_and_rate(tmp_path):
    planes = [[np.full((32, 48), 10 * number, np.uint8)] * 3 for number in range(6)]
    path = encode(tmp_path / "a.mkv", planes, "ffv1", "yuv444p", stamps=[0, 1, 2, 4, 5, 6])
    found = facts(path)
    assert found.codec == "ffv1" and not found.lossy and found.rate_hz == pytest.approx(30, rel=0.2)
    assert (found.missing, found.gaps) == (1, 1)
    assert found.bits_a_pixel == pytest.approx(8 * path.stat().st_size / (6 * 32 * 48))
