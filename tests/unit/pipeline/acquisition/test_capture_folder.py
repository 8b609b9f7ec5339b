"""The log of a capture: a line for everything, whole, and what it says of a burst can be taken back."""

import json
import time

import pytest

from hardware.pairing import Fault
from hardware.rig import Rejected
from pipeline.acquisition.capture_folder import CaptureLog
from pipeline.errors import OutputError


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_times_are_those_of_the_day(tmp_path):
    log = CaptureLog(tmp_path / "log.jsonl")
    log.say("start", rig={"period_s": 0.1})
    log.close()
    (line,) = lines(tmp_path / "log.jsonl")
    assert line["event"] == "start" and line["rig"] == {"period_s": 0.1}
    assert abs(line["time"] - time.time()) < 10


def test_what_was_said_last_can_be_taken_back(tmp_path):
    log = CaptureLog(tmp_path / "log.jsonl")
    log.say("start")
    log.reject(Rejected(3, 1, (Fault("cable", "check the cable", 2), Fault("other", "and the other"))))
    log.take_back()
    log.say("end")
    log.close()
    assert [line["event"] for line in lines(tmp_path / "log.jsonl")] == ["start", "end"]


def test_why_a_burst_was_thrown_away(tmp_path):
    log = CaptureLog(tmp_path / "log.jsonl")
    log.reject(Rejected(3, 1, (Fault("cable", "check the cable", 2), Fault("other", "and the other"))))
    log.close()
    (line,) = lines(tmp_path / "log.jsonl")
    assert (line["burst"], line["attempt"]) == (3, 1)
    assert line["faults"] == ["pulse 2: check the cable", "and the other"]


def test_a_full_disk_leaves_no_part_of_a_line(tmp_path):
    class Full:
        def __init__(self, file):
            self._file = file

        def __getattr__(self, name):
            return getattr(self._file, name)

        def write(self, text):
            self._file.write(text[:7])
            raise OSError(28, "No space left on device")

    log = CaptureLog(tmp_path / "log.jsonl")
    log.say("start")
    log._file = Full(log._file)
    with pytest.raises(OutputError, match="the disk is full: free some space"):
        log.say("end")
    log.close()
    assert [line["event"] for line in lines(tmp_path / "log.jsonl")] == ["start"]


def test_a_log_is_never_overwritten(tmp_path):
    (tmp_path / "log.jsonl").write_text("mine")
    with pytest.raises(OutputError, match="cannot write"):
        CaptureLog(tmp_path / "log.jsonl")
    assert (tmp_path / "log.jsonl").read_text() == "mine"
