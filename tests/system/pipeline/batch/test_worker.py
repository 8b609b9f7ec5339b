"""One process's share of a run: what it decodes, what it stores, and what it is told of a store that is not there."""

import time
from concurrent.futures import wait
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.recorded_footage import record

from pipeline import Decoder, DecodeSettings
from pipeline.batch import worker as workers
from pipeline.batch.job import Job
from pipeline.batch.worker import GoodFrame, Worker
from pipeline.errors import OutputError
from pipeline.footage.footage import BadFrame, StoredAs
from pipeline.output.store_files import StoreFiles, marked_frames

N_FRAMES = 6


@pytest.fixture
def job(tmp_path, cpu):
    rig = record(tmp_path / "film.zarr", N_FRAMES)
    film, store = str(tmp_path / "film.zarr"), str(tmp_path / "result.zarr")
    return Job(film, StoredAs(), DecodeSettings(), rig, None, 1, 0, ("mask", "phase_sigma"), store, "cpu")


def test_every_worker_must_see_the_store(job):
    with pytest.raises(OutputError, match=r"is not there: every worker must see it under this name"):
        Worker(job)
    assert not Path(job.store).exists()


def test_only_what_is_missing_is_stored_and_bad_frames_are_told(job, tmp_path):
    """Frame 1 is decoded for frame 2, which leans on it."""
    source = job.open()
    job.make_store(source)
    (tmp_path / "film.zarr" / "frames" / "c.4.0.0.0").unlink()
    told = []
    Worker(job).decode([(range(0, 3), frozenset({0, 2})), (range(4, 6), frozenset({4, 5}))], told.append)
    assert marked_frames(StoreFiles(job.store)) == {0, 2, 5}
    assert sorted(each.number for each in told if isinstance(each, GoodFrame)) == [0, 2, 5]
    (bad,) = (each for each in told if isinstance(each, BadFrame))
    assert bad.number == 4 and "missing" in bad.reason


def test_a_frame_knows_how_long_after_the_last_one_it_comes(job, tmp_path, monkeypatch):
    """Where colours come one after another; frame 4 is missing."""
    frame_s = float(np.diff(job.open().times.seconds).mean())
    job = replace(job, settings=DecodeSettings(frame_s=frame_s, fields={"cycle_s": frame_s}))
    job.make_store(job.open())
    (tmp_path / "film.zarr" / "frames" / "c.4.0.0.0").unlink()
    elapsed, decode = [], Decoder.decode

    def noting(self, image, previous=None, out=None, since=1.0):
        if previous is not None:
            elapsed.append(since)
        return decode(self, image, previous, out, since)

    monkeypatch.setattr(Decoder, "decode", noting)
    Worker(job).decode([(range(N_FRAMES), frozenset(range(N_FRAMES)))], lambda outcome: None)
    assert elapsed == [1, 1, 1, 2]


def test_frames_are_told_as_they_are_done(job, monkeypatch):
    """However long the next ones take: before the last of six is decoded, the first ones are counted."""
    job.make_store(job.open())
    told, before = [], {}
    decode = Worker._decode

    def slowly(self, stored, previous, out):
        before[stored.number] = len(told)
        wait([result.written for result in self._results if result.written is not None])
        time.sleep(0.1)
        return decode(self, stored, previous, out)

    monkeypatch.setattr(workers, "_COMMIT_S", 0.0)
    monkeypatch.setattr(Worker, "_decode", slowly)
    Worker(job).decode([(range(N_FRAMES), frozenset(range(N_FRAMES)))], told.append)
    assert before[0] == 0 and before[N_FRAMES - 1] > 0
    assert all(each.n_bytes > 0 for each in told) and len(told) == N_FRAMES
