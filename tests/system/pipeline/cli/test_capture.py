"""`colorphase capture` as its user meets it; what is recorded has tests of its own."""

import json
from types import SimpleNamespace

import pytest

from pipeline.acquisition import capture_folder, simulated_capture
from pipeline.acquisition.capture_folder import CaptureProgress
from pipeline.calibration import Calibration
from pipeline.cli.capture import _frames, _line
from pipeline.footage.opening import open_footage

SIMULATED = """
[trigger]
driver = "simulated"
strobe = true
[timing]
period_s = 0.02
frames = 3
[camera]
driver = "simulated"
exposure_s = 0.01
"""


@pytest.fixture
def small(monkeypatch):
    """Let the simulated rig render two places."""
    monkeypatch.setattr(simulated_capture, "_PLACES", 2)


def test_bursts_of_a_simulated_rig_are_recorded_and_the_next_command_is_said(command, small, tmp_path):
    (tmp_path / "rig.toml").write_text(SIMULATED, encoding="utf-8")
    ended, said, complained = command("capture", "--rig", "rig.toml", "--out", "face", "--bursts", "2", "--arch", "cpu")
    assert ended == 0, complained
    recorded, next_command = said.splitlines()
    assert recorded == "recorded 6 frames of 2 bursts in face/recording.zarr; each frame's pulse is in face/log.jsonl"
    assert next_command == (
        "colorphase decode face/recording.zarr --out face/decoded --calibration face/calibration.json"
    )
    events = [json.loads(line) for line in (tmp_path / "face" / "log.jsonl").read_text().splitlines()]
    assert [event["pulse"] for event in events if event["event"] == "frame"] == [0, 1, 2, 0, 1, 2]


def test_a_short_capture_waits_for_live_decoding(command, small, tmp_path, monkeypatch):
    monkeypatch.setattr(capture_folder, "LIVE_READY_S", 120.0)  # a busy machine may compile kernels for a minute
    (tmp_path / "rig.toml").write_text(SIMULATED, encoding="utf-8")
    ended, said, complained = command(
        "capture", "--rig", "rig.toml", "--out", "face", "--view", "--no-browser", "--arch", "cpu"
    )
    assert ended == 0
    assert "over before live decoding" not in complained
    assert "face is shown at http://127.0.0.1:" in said


def test_a_simulated_webcam_is_recorded_with_its_transfer(command, small, tmp_path):
    (tmp_path / "rig.toml").write_text(SIMULATED + 'serial = "webcam"', encoding="utf-8")
    ended, _, complained = command("capture", "--rig", "rig.toml", "--out", "face", "--arch", "cpu")
    assert ended == 0, complained
    assert open_footage(tmp_path / "face" / "recording.zarr").transfer == "srgb"
    assert Calibration.read(tmp_path / "face" / "calibration.json").capture.transfer == "srgb"


@pytest.mark.parametrize(
    ("rig", "arguments", "code", "message"),
    [
        (SIMULATED, ("--bursts", "0"), 2, "must be above 0, and a number"),
        (SIMULATED, ("--keep-last", "inf"), 2, "must be above 0, and a number"),
        (SIMULATED, ("--settings", "rig.toml"), 1, "add --view, or omit --settings"),
        (SIMULATED.replace("period_s = 0.02", "period_s = 0.001"), (), 1, "make the period that long"),
        (SIMULATED.replace('"simulated"', '"basler"', 1), (), 1, 'trigger.driver: must be "box", '),
        (SIMULATED.replace('"simulated"', '"box"', 1), (), 1, "a simulated trigger source and a simulated camera"),
        (SIMULATED.replace('"simulated"', '"no_such:Own"'), (), 1, "trigger.driver: no_such cannot be imported"),
        (SIMULATED + '[projector]\ncontrol = "no_such:Own"', (), 0, "recorded"),  # nothing of it is there
    ],
)
def test_what_cannot_be_captured_is_one_line(command, small, tmp_path, rig, arguments, code, message):
    (tmp_path / "rig.toml").write_text(rig, encoding="utf-8")
    ended, said, complained = command("capture", "--rig", "rig.toml", "--out", "face", "--arch", "cpu", *arguments)
    assert ended == code
    assert message in (said if code == 0 else complained)
    assert code == 0 or complained.count("\n") == 1
    assert (tmp_path / "face").exists() == (code == 0)


def test_the_line_that_shows_how_it_stands():
    watched = SimpleNamespace(decoder=SimpleNamespace(latency_s=0.0312))
    stands = CaptureProgress(n_bursts=1, n_frames=25, n_rejected=2, rate_hz=49.6, note="pulse 3: lost", watched=watched)
    assert _frames(stands) == "25 frames of 1 burst"
    assert _line(stands) == (
        "25 frames of 1 burst, 50 frames/s, 31 ms from strobe to range image, "
        "twice a burst was thrown away (pulse 3: lost)"
    )
