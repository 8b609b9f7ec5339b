"""A power cut at any moment: every frame that a store or a recording then claims to hold is whole."""

import sys

import numpy as np
import pytest
from support.numbered_frames import RGB8, frame_of
from support.power_cuts import PowerCuts
from support.recorded_footage import job_of, record

from pipeline.batch.run import decode_job
from pipeline.errors import FootageError
from pipeline.footage.footage import StoredFrame
from pipeline.footage.opening import open_footage
from pipeline.output.stored_result import StoredResult
from pipeline.recording.recorder import Recorder

pytestmark = [
    pytest.mark.usefixtures("cpu"),
    pytest.mark.skipif(sys.platform != "linux", reason="what is synced is named by /proc"),
]

# Which names a disk keeps that nobody has synced: none, all, those that say what is there.
DISKS = {
    "late": lambda path: False,
    "early": lambda path: True,
    "marks first": lambda path: "/done/" in path or path.endswith("result.zarr/zarr.json"),
    "chunks first": lambda path: "/done/" not in path and not path.endswith("zarr.json"),
}
N_FRAMES, MOMENTS = 10, 50


@pytest.mark.parametrize("disk", DISKS)
def test_results(tmp_path, monkeypatch, disk):
    record(tmp_path / "film.zarr", N_FRAMES)
    monkeypatch.setattr("pipeline.batch.worker._COMMIT_S", 0.05)
    (tmp_path / "out").mkdir()
    cuts, told = PowerCuts(tmp_path / "out", monkeypatch), []
    job = job_of(tmp_path, tmp_path / "out" / "result.zarr")
    decode_job(job, notify=lambda done, of: told.append((len(cuts.events), done)))
    monkeypatch.undo()
    kept = []
    for moment in np.unique(np.linspace(0, len(cuts.events), MOMENTS).astype(int)):
        left = tmp_path / f"left {moment}"
        cuts.left(moment, left, DISKS[disk])
        try:
            result = StoredResult(left / "result.zarr")
        except FootageError:
            kept.append(0)
        else:
            assert [result.fault(number) for number in result.done] == [None] * len(result.done)
            kept.append(len(result.done))
        # What the run has told of is there.
        assert kept[-1] >= max((done for n_events, done in told if n_events <= moment), default=0)
    assert kept[-1] == N_FRAMES and len(set(kept)) > 2


@pytest.mark.parametrize("disk", DISKS)
def test_a_store_that_was_cut_off_is_completed(tmp_path, monkeypatch, disk):
    record(tmp_path / "film.zarr", 3)
    (tmp_path / "out").mkdir()
    cuts = PowerCuts(tmp_path / "out", monkeypatch)
    decode_job(job_of(tmp_path, tmp_path / "out" / "result.zarr"))
    monkeypatch.undo()
    for moment in np.linspace(0, len(cuts.events), 6).astype(int):
        cuts.left(moment, tmp_path / f"left {moment}", DISKS[disk])
        summary = decode_job(job_of(tmp_path, tmp_path / f"left {moment}" / "result.zarr"))
        assert summary.damaged == {}
        result = StoredResult(tmp_path / f"left {moment}" / "result.zarr")
        assert [result.fault(number) for number in range(3)] == [None] * 3


@pytest.mark.parametrize("disk", ["late", "early", "chunks first"])
def test_recordings(tmp_path, monkeypatch, disk):
    (tmp_path / "out").mkdir()
    cuts, committed = PowerCuts(tmp_path / "out", monkeypatch), []
    recorder = Recorder(tmp_path / "out" / "a.zarr", RGB8)
    for number in range(N_FRAMES):
        recorder.add(frame_of(number))
        recorder.commit()
        committed.append((len(cuts.events), number + 1))
    n_events = len(cuts.events)
    recorder.close()
    monkeypatch.undo()
    for moment in np.unique(np.linspace(0, n_events, MOMENTS).astype(int)):
        left = tmp_path / f"left {moment}"
        cuts.left(moment, left, DISKS[disk])
        n_held = 0
        if (left / "a.part.zarr").exists():
            try:
                source = open_footage(left / "a.part.zarr")
            except FootageError:
                pass  # nothing has been committed
            else:
                frames = list(source.frames())
                source.close()
                assert all(isinstance(frame, StoredFrame) for frame in frames)
                n_held = len(frames)
        assert n_held >= max((n for at, n in committed if at <= moment), default=0)
