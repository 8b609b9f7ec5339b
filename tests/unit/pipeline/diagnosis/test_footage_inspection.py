"""Facts that containers state, and findings from evidence written down by hand: grades, costs and advice."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.numbered_frames import record
from support.video_files import encode

from pipeline.diagnosis.footage_evidence import FootageEvidence, FrameQuality, KeptFrame, Scale
from pipeline.diagnosis.footage_inspection import (
    ContainerFacts,
    _missing,
    container_facts,
    container_findings,
    cost_findings,
    frame_findings,
    fringe_findings,
    light_findings,
    storage_findings,
    time_findings,
)
from pipeline.diagnosis.ripple import Diagnosis
from pipeline.footage.footage import BadFrame
from pipeline.footage.opening import open_footage
from pipeline.settings import DecodeSettings

GOOD = FrameQuality(0.5, 0.012, 0.001, 0.013, 0.0, 0.0, 0.0)
LOSSLESS = ContainerFacts("matroska", "ffv1", "bgr0", False, False, 30.0, 8.0, 0, 0)


def facts(path):
    return container_facts(path, open_footage(path))


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


@pytest.fixture
def source(tmp_path):
    record(tmp_path / "a.zarr")
    return open_footage(tmp_path / "a.zarr")


def seen(**changed):
    return replace(FootageEvidence(DecodeSettings(), n_frames=9, n_pairs=4, brightest=0.9), **changed)


def graded(findings):
    return {finding.topic: finding.grade for finding in findings}


def test_missing_frames_cost_and_are_counted(source):
    found = {f.topic: f for f in container_findings(replace(LOSSLESS, missing=3, gaps=2), source)}
    assert found["dropped"].grade == "costs" and "3 frames are missing in 2 places" in found["dropped"].found
    assert graded(container_findings(LOSSLESS, source)) == {"container": "fine"}


def test_frames_without_fringes_and_damaged_ones():
    bad = seen(bad=[BadFrame(4, "it is missing")])
    findings = {f.topic: f for f in frame_findings(bad, LOSSLESS, DecodeSettings())}
    assert findings["damaged"].found == "1 of 9 frames; frame 4: it is missing"
    assert findings["fringes"].grade == "spoils" and findings["fringes"].found == "none in 8 frames"


def test_one_picture_is_not_counted():
    (fringes,) = frame_findings(seen(n_frames=1), LOSSLESS, DecodeSettings())
    assert fringes.found == "none in this frame"


@pytest.mark.parametrize("faint, grade", [(0.01, "fine"), (0.08, "costs"), (0.3, "spoils")])
def test_a_part_without_a_fringe_is_said(faint, grade):
    """The rest of the frame may be as good as ever."""
    light, everywhere = np.zeros((9, 9, 3), np.float32), np.ones((9, 9), bool)
    kept = [KeptFrame(light, light, light[..., 0], everywhere, 12.0)]
    found = {f.topic: f for f in fringe_findings(seen(kept=kept), replace(GOOD, faint=faint))}
    assert found["contrast"].grade == grade
    assert ("less than 12% on" in found["contrast"].found) == (grade != "fine")


def test_an_exposure_is_told_by_what_stands_still():
    """Where all comes nearer it becomes brighter by itself; the colours' balance is told all the same."""
    phase, light = np.zeros((120, 160), np.float32), np.full((120, 160, 3), 0.4, np.float32)
    first = KeptFrame(light, light, phase, phase == 0, 12.0)
    brighter = np.float32([1.32, 1.2, 1.2]) * light
    for moved_rad, found in ((0.0, "exposure by up to 23"), (1.0, "exposure unknown")):
        later = KeptFrame(brighter, brighter, phase + np.float32(moved_rad), phase == 0, 12.0)
        (drift,) = time_findings(seen(kept=[first, later]), GOOD)
        assert drift.topic == "drift" and drift.grade == "costs"
        assert found in drift.found and "white balance by up to 6.6%" in drift.found


def test_what_a_codec_takes_is_what_noise_and_levels_leave_unexplained(source):
    """Of 0.02 rad as neighbours differ, 0.012 are the camera's noise: 0.016 are the codec's."""
    lossy = replace(LOSSLESS, codec="h264", lossy=True)
    found = {f.topic: f for f in storage_findings(seen(), lossy, source, replace(GOOD, sigma_rad=0.02))}
    assert found["codec"].cost_rad == pytest.approx(0.016) and found["codec"].grade == "costs"
    assert graded(storage_findings(seen(), LOSSLESS, source, GOOD)) == {"codec": "fine", "depth": "fine"}


def test_bits_that_no_value_uses(source):
    (depth,) = (f for f in storage_findings(seen(brightest=0.05), LOSSLESS, source, GOOD) if f.topic == "depth")
    assert depth.grade == "costs" and "no value uses more than 4 of them" in depth.found and "--bits 4" in depth.advice


@pytest.mark.parametrize("lost, grade", [(0.0, "fine"), (0.01, "costs"), (0.3, "spoils")])
def test_clipped_pixels_cost_by_how_many_have_no_phase(lost, grade):
    assert graded(light_findings(seen(), replace(GOOD, lost=lost)))["saturation"] == grade


def test_light_that_cannot_be_told_is_not_called_fine():
    """Where no surface is large and smooth enough, the fringes contradict nothing and confirm nothing."""
    blind = Diagnosis((), {}, {}, float("nan"), ("too little smooth surface to say anything",))
    for diagnosis, grade in ((blind, "costs"), (replace(blind, limit_rad=0.01, notes=()), "fine")):
        (transfer,) = (f for f in light_findings(seen(diagnosis=diagnosis), GOOD) if f.topic == "transfer")
        assert transfer.grade == grade
        assert ("do not show" in transfer.found) == (grade == "costs")


@pytest.mark.parametrize("motion_rad, grade", [(0.03, "fine"), (1.0, "costs"), (2.2, "spoils")])
def test_motion_of_a_third_of_a_cycle_spoils(motion_rad, grade):
    assert graded(time_findings(seen(motion_rad=[motion_rad]), GOOD))["motion"] == grade


def test_motion_costs_mm_per_speed_where_rows_and_colours_come_in_turn():
    """At the speed that is seen, or at 100 mm/s; the exposure needs a scale."""
    timed = {"frame_s": 1 / 30, "row_s": 2e-5, "fields": {"cycle_s": 1 / 60}}
    seen = FootageEvidence(DecodeSettings(**timed), motion_rad=[0.5])

    def costs(evidence: FootageEvidence, scale: Scale | None) -> dict[str, str]:
        return {finding.topic: finding.found for finding in cost_findings(evidence, LOSSLESS, GOOD, scale, 1001)}

    assert costs(seen, None) == {
        "colours in turn": "0.23 mm RMS at most, a ripple at 100 mm/s: 0.0023 mm per mm/s",
        "rows in turn": "1 mm in the first and the last row at 100 mm/s: 0.01 mm per mm/s",
    }
    found = costs(seen, Scale(0.4, 7.0))  # 0.499 rad of 7 mm, 30 times a second
    assert found["longest exposure"] == "27 ms at 105 mm/s motion then takes as much detail as smoothing"
    assert found["rows in turn"].startswith("1 mm in the first and the last row at 105 mm/s")
    still = FootageEvidence(DecodeSettings())
    assert costs(still, None) == {}
    assert costs(still, Scale(0.4, 7.0))["longest exposure"].startswith("28 ms at 100 mm/s")
