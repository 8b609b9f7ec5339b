"""What is said of footage by what was seen of it: grades, costs and advice, from evidence written down by hand."""

from dataclasses import replace

import numpy as np
import pytest
from support.numbered_frames import record

from pipeline.diagnosis.footage_evidence import FootageEvidence, FrameQuality, KeptFrame
from pipeline.diagnosis.footage_inspection import (
    ContainerFacts,
    container_findings,
    frame_findings,
    fringe_findings,
    light_findings,
    storage_findings,
    time_findings,
)
from pipeline.diagnosis.ripple import Diagnosis
from pipeline.footage.opening import open_source
from pipeline.footage.source import BadFrame
from pipeline.settings import DecodeSettings

GOOD = FrameQuality(0.5, 0.012, 0.001, 0.013, 0.0, 0.0, 0.0)
LOSSLESS = ContainerFacts("matroska", "ffv1", "bgr0", False, False, 30.0, 8.0, 0, 0)


@pytest.fixture
def source(tmp_path):
    record(tmp_path / "a.zarr")
    return open_source(tmp_path / "a.zarr")


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
    for moved_rad, found in ((0.0, "exposure by up to 23"), (1.0, "exposure not told")):
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
        assert ("do not tell" in transfer.found) == (grade == "costs")


@pytest.mark.parametrize("motion_rad, grade", [(0.03, "fine"), (1.0, "costs"), (2.2, "spoils")])
def test_motion_of_a_third_of_a_cycle_spoils(motion_rad, grade):
    assert graded(time_findings(seen(motion_rad=[motion_rad]), GOOD))["motion"] == grade
