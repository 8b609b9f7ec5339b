import json
import signal
import time
from dataclasses import replace
from itertools import pairwise

import pytest
from support.faulty_rigs import FRAMES, Bench, Faulty, number_in, settings

from hardware import protocols
from hardware.errors import BurstError, CameraError, RigError
from pipeline.acquisition import session
from pipeline.acquisition.capture_folder import CapturePlan
from pipeline.acquisition.session import Stopping, capture_bursts
from pipeline.calibration import Calibration
from pipeline.errors import CalibrationError, OutputError, SettingsError
from pipeline.footage.opening import open_footage
from pipeline.models import SensorPart
from pipeline.recording.recorder import Recorder
from pipeline.settings import DecodeSettings
from pipeline.simulation import simulated_rig

one = frozenset({2})
# Between pulses that run on, s: a busy machine takes their frames when it comes to them.
SLOW_S = 0.04


def captured(bench, folder, plan, **kwargs):
    arguments = {"calibration": None, "decoding": DecodeSettings(), "stopping": Stopping(), **kwargs}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "Rig", bench.repeating(session.Rig))
        return capture_bursts(bench.settings, bench.open, folder, plan, **arguments)


def log_of(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def check_folder(bench, folder, n_bursts):
    """Every recorded frame is logged with the pulse that made it, burst by burst, and nothing else is there."""
    source = open_footage(folder / "recording.zarr")
    frames = list(source.frames())
    logged = [line for line in log_of(folder) if line["event"] == "frame"]
    bursts = [line for line in log_of(folder) if line["event"] == "burst"]
    assert len(frames) == len(logged) == n_bursts * FRAMES
    assert [line["frame"] for line in logged] == list(range(len(frames)))
    assert [(line["first_frame"], line["frames"]) for line in bursts] == [(i * FRAMES, FRAMES) for i in range(n_bursts)]
    for frame, line in zip(frames, logged, strict=True):
        assert bench.truth[number_in(frame.planes[0])][1] == line["pulse"]
    assert not list(folder.glob(".*"))
    return log_of(folder)


def test_bursts_are_recorded_with_their_pulses(tmp_path):
    bench = Bench(settings(), [Faulty(), Faulty(lost_trigger=one)])
    calibration = simulated_rig((96, 64))
    summary = captured(bench, tmp_path / "out", CapturePlan(3), calibration=calibration)
    assert (summary.n_bursts, summary.n_frames, summary.n_rejected, summary.stopped) == (3, 3 * FRAMES, 1, False)
    log = check_folder(bench, tmp_path / "out", 3)
    assert sorted(entry.name for entry in (tmp_path / "out").iterdir()) == [
        "calibration.json",
        "log.jsonl",
        "recording.zarr",
    ]
    start, end = log[0], log[-1]
    assert start["calibration_sha256"] == calibration.digest()
    assert Calibration.read(tmp_path / "out" / "calibration.json").digest() == calibration.digest()
    assert start["pulses"]["period_s"] == bench.settings.timing.period_s
    assert start["rig"]["timing"]["frames"] == FRAMES
    assert "password" not in start["rig"]["projector"]
    assert end["event"] == "end" and end["frames"] == 3 * FRAMES and end["error"] is None
    (rejected,) = [line for line in log if line["event"] == "rejected"]
    assert rejected["faults"][0].startswith("pulse 2: 5 exposures to 6 pulses: the camera's trigger cable")
    frames = [line for line in log if line["event"] == "frame"]
    assert all(line["strobe_s"] == pytest.approx(line["pulse_s"]) for line in frames)
    assert all(abs(line["time"] - time.time()) < 60 and line["arrived"] > line["time"] - 0.1 for line in frames)


def test_endless_pulses_are_numbered_on(tmp_path):
    bench = Bench(settings(period_s=SLOW_S))
    captured(bench, tmp_path / "out", CapturePlan(4, endless=True))
    log = check_folder(bench, tmp_path / "out", 4)
    frames = [line for line in log if line["event"] == "frame"]
    assert [line["pulse"] for line in frames] == list(range(4 * FRAMES))
    assert {line["burst"] for line in frames} == {0}
    assert all(after["frame_id"] == before["frame_id"] + 1 for before, after in pairwise(frames))


def test_after_a_fault_endless_pulses_are_another_burst(tmp_path):
    faults = [Faulty(), Faulty(lost_trigger=frozenset({FRAMES + 1}))]
    bench = Bench(settings(alternating=False, period_s=SLOW_S), faults)
    captured(bench, tmp_path / "out", CapturePlan(3, endless=True))
    frames = [line for line in check_folder(bench, tmp_path / "out", 3) if line["event"] == "frame"]
    assert [(line["burst"], line["pulse"]) for line in frames] == [
        *((0, pulse) for pulse in range(FRAMES)),
        *((1, pulse) for pulse in range(2 * FRAMES)),
    ]


def test_only_the_last_seconds_are_recorded(tmp_path):
    bench = Bench(settings(alternating=False, period_s=SLOW_S))
    burst_s = FRAMES * bench.settings.timing.period_s
    summary = captured(bench, tmp_path / "out", CapturePlan(7, endless=True, keep_last_s=1.5 * burst_s))
    assert summary.n_bursts == 2
    frames = [line for line in check_folder(bench, tmp_path / "out", 2) if line["event"] == "frame"]
    assert [line["pulse"] for line in frames] == list(range(5 * FRAMES, 7 * FRAMES))


def test_more_than_fits_into_memory_is_refused(tmp_path):
    bench = Bench(settings(alternating=False))
    with pytest.raises(SettingsError, match=r"take [0-9]+\.[0-9] GB, and this machine has .*: make timing.frames or"):
        captured(bench, tmp_path / "out", CapturePlan(None, endless=True, keep_last_s=1e9))
    assert not (tmp_path / "out").exists()
    assert bench.calls[-2:] == ["trigger.close", "camera.close"]


class Interrupted(Stopping):
    """Asks to stop after some bursts."""

    def __init__(self, after):
        super().__init__()
        self.after = after

    def shield(self):
        """Do as if Ctrl-C had come in here."""
        self.after -= 1
        self.asked = self.after <= 0
        return super().shield()


def test_ctrl_c_keeps_the_whole_bursts(tmp_path):
    bench = Bench(settings())
    summary = captured(bench, tmp_path / "out", CapturePlan(None), stopping=Interrupted(3))
    assert summary.stopped and summary.n_bursts == 3
    check_folder(bench, tmp_path / "out", 3)
    assert bench.calls[-4:] == ["trigger.abort", "camera.disarm", "trigger.close", "camera.close"]


def test_ctrl_c_in_the_last_burst_stops_nothing(tmp_path):
    summary = captured(Bench(settings()), tmp_path / "out", CapturePlan(3), stopping=Interrupted(3))
    assert (summary.n_bursts, summary.stopped) == (3, False)


def test_a_full_disk_keeps_the_whole_bursts(tmp_path, monkeypatch):
    """The disk fills up in the middle of the third burst."""
    bench = Bench(settings())
    add, n_added = Recorder.add, 0

    def fills_up(self, frame):
        nonlocal n_added
        n_added += 1
        if n_added == 2 * FRAMES + 3:
            raise self._ended_by(OSError(28, "No space left on device"))
        add(self, frame)

    monkeypatch.setattr(Recorder, "add", fills_up)
    with pytest.raises(OutputError, match="the disk is full: free some space"):
        captured(bench, tmp_path / "out", CapturePlan(5))
    log = check_folder(bench, tmp_path / "out", 2)
    assert "the disk is full" in log[-1]["error"]
    assert bench.calls[-2:] == ["trigger.close", "camera.close"]


@pytest.mark.parametrize("error", [BurstError, CameraError])
def test_a_rig_that_fails_keeps_the_whole_bursts(tmp_path, error):
    fault = Faulty(lost_trigger=one) if error is BurstError else Faulty(unplugged_camera=1)
    bench = Bench(settings(alternating=False), [Faulty(), Faulty(), fault, fault, fault])
    with pytest.raises(error):
        captured(bench, tmp_path / "out", CapturePlan(5))
    log = check_folder(bench, tmp_path / "out", 2)
    assert [line["attempt"] for line in log if line["event"] == "rejected"] == [1, 2, 3]
    assert log[-1]["event"] == "end" and log[-1]["error"]


def test_what_was_never_whole_leaves_nothing(tmp_path):
    bench = Bench(settings(alternating=False), 3 * [Faulty(lost_trigger=one)])
    with pytest.raises(BurstError):
        captured(bench, tmp_path / "out", CapturePlan(1))
    assert not (tmp_path / "out").exists()


def test_a_folder_that_exists_is_left_alone(tmp_path):
    (tmp_path / "mine").write_text("mine")
    for out in (tmp_path, tmp_path / "mine"):
        bench = Bench(settings())
        with pytest.raises(OutputError, match="exists: choose another folder"):
            captured(bench, out, CapturePlan(1))
        assert bench.n_opened == 0
    assert [entry.name for entry in tmp_path.iterdir()] == ["mine"]


def test_a_capture_knows_the_part_of_the_sensor_and_so_does_its_calibration(tmp_path):
    part, whole = (SensorPart(sensor_px=(128, 96), offset_px=(x, x), binning=(1, 1)) for x in (8, 0))
    bench = Bench(settings())
    opened = bench.open

    def open_and_say():
        trigger, camera = opened()
        camera.limits = replace(camera.limits, sensor=protocols.SensorPart(**part.model_dump()))
        return trigger, camera

    bench.open = open_and_say
    calibration = simulated_rig((128, 96)).model_copy(update={"sensor": whole})
    captured(bench, tmp_path / "out", CapturePlan(1), calibration=calibration)
    assert open_footage(tmp_path / "out" / "recording.zarr").sensor == part
    kept = Calibration.read(tmp_path / "out" / "calibration.json")
    assert kept.digest() == calibration.cropped(8, 8, (96, 64)).digest()


def test_a_calibration_of_another_size_is_refused_before_anything_is_fired(tmp_path):
    bench = Bench(settings())
    with pytest.raises(CalibrationError, match=r"the camera's frame is 96x64 but the calibration is for 64x48: set"):
        captured(bench, tmp_path / "out", CapturePlan(1), calibration=simulated_rig((64, 48)))
    assert not (tmp_path / "out").exists()
    assert "trigger.fire" not in bench.calls
    assert bench.calls[-2:] == ["trigger.close", "camera.close"]


def test_how_it_stands_is_told_from_the_start_and_after_every_burst(tmp_path):
    bench = Bench(settings(alternating=False), [Faulty(lost_trigger=one)])
    told = []
    captured(bench, tmp_path / "out", CapturePlan(2), notify=told.append)
    assert [(progress.n_bursts, progress.n_rejected) for progress in told] == [(0, 0), (0, 1), (1, 1), (2, 1)]


def test_impossible_timing_leaves_nothing(tmp_path):
    bench = Bench(settings(period_s=1e-3))
    with pytest.raises(RigError, match="make the period that long"):
        captured(bench, tmp_path / "out", CapturePlan(1))
    assert not (tmp_path / "out").exists()


def test_the_last_seconds_are_kept_where_a_camera_is_unplugged(tmp_path):
    fault = Faulty(unplugged_camera=1)
    bench = Bench(settings(alternating=False), [Faulty(), Faulty(), Faulty(), fault, fault, fault])
    burst_s = FRAMES * bench.settings.timing.period_s
    with pytest.raises(CameraError):
        captured(bench, tmp_path / "out", CapturePlan(9, keep_last_s=1.5 * burst_s))
    log = check_folder(bench, tmp_path / "out", 2)
    assert log[-1] == {**log[-1], "event": "end", "frames": 2 * FRAMES, "error": "the cable is out"}


@pytest.mark.parametrize("keep_last_s", [None, 60.0])
def test_the_log_takes_back_a_burst_that_is_not_recorded_and_tells_why(tmp_path, monkeypatch, keep_last_s):
    bench = Bench(settings(alternating=False))
    commit, n = Recorder.commit, 0

    def second_fails(self):
        nonlocal n
        n += 1
        if n == 2:
            raise self._ended_by(OSError(28, "No space left on device"))
        commit(self)

    monkeypatch.setattr(Recorder, "commit", second_fails)
    with pytest.raises(OutputError):
        captured(bench, tmp_path / "out", CapturePlan(3, keep_last_s=keep_last_s))
    log = check_folder(bench, tmp_path / "out", 1)
    assert log[-1]["frames"] == FRAMES and "the disk is full" in log[-1]["error"]


def test_ctrl_c_while_the_last_seconds_are_written_loses_none(tmp_path, monkeypatch):
    """The bursts are all there, and Ctrl-C comes before they are on the disk."""
    bench = Bench(settings(alternating=False))
    add = Recorder.add

    def pressed(self, frame):
        signal.raise_signal(signal.SIGINT)
        add(self, frame)

    monkeypatch.setattr(Recorder, "add", pressed)
    stopping = Stopping()
    with stopping.listening():
        summary = captured(bench, tmp_path / "out", CapturePlan(2, keep_last_s=60.0), stopping=stopping)
    assert (summary.n_bursts, summary.stopped) == (2, False)
    check_folder(bench, tmp_path / "out", 2)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="Windows has no such signal")
def test_a_closed_terminal_is_nothing_to_nohup():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Stopping().listening():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_colours_one_after_another_are_said_to_whoever_decodes(tmp_path):
    """The folder holds what decoding needs to undo motion between them."""
    fields = {"red_s": (0.0, 0.0003), "green_s": (0.0003, 0.0006), "blue_s": (0.0007, 0.001)}
    rig = settings()
    captured(Bench(rig), tmp_path / "plain", CapturePlan(1))
    assert not (tmp_path / "plain" / "settings.toml").exists()
    projector = rig.projector.model_validate({**vars(rig.projector), "fields": fields, "colour_cycle_s": 0.001})
    camera = rig.camera.model_copy(update={"exposure_s": 0.001, "row_s": 1e-5})
    captured(
        Bench(rig.model_copy(update={"projector": projector, "camera": camera})), tmp_path / "told", CapturePlan(1)
    )
    told = DecodeSettings.read(tmp_path / "told" / "settings.toml")
    assert told.row_s == 1e-5
    assert (told.frame_s, told.fields.cycle_s) == (rig.timing.period_s, 0.001)
    assert told.fields.shown_s.tolist() == [list(fields[f"{name}_s"]) for name in ("red", "green", "blue")]
    assert not told.fields.locked
