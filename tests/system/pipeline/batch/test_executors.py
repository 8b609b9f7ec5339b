"""In how many processes footage is decoded, and one of them, spoken to as its starter does."""

import os
import signal

import pytest
from support.recorded_footage import record

from pipeline import DecodeSettings
from pipeline.batch import executors
from pipeline.batch.executors import ProcessExecutor, idle_processes, worthwhile_processes
from pipeline.batch.job import Job, chains
from pipeline.batch.run import decode_job
from pipeline.errors import FootageError, OutputError
from pipeline.footage.footage import StoredAs
from pipeline.processes import Child


def job_on(arch="cpu"):
    return Job("film", StoredAs(), DecodeSettings(), None, None, 1, 0, ("mask",), "result.zarr", arch)


def todo(n_frames):
    return list(chains(range(n_frames), set(range(n_frames))))


@pytest.fixture
def cores(monkeypatch):
    def have(count):
        monkeypatch.setattr(executors, "usable_cores", lambda: list(range(count)))

    return have


def test_how_many_processes_are_worth_their_start(cores):
    cores(8)
    assert [worthwhile_processes(job_on(), todo(n)) for n in (1024, 300, 10)] == [8, 2, 1]
    assert worthwhile_processes(job_on("vulkan"), todo(1024)) == 1


@pytest.mark.parametrize(
    ("n_cores", "n_frames", "count", "said"),
    [
        (2, 1000, 1, None),
        (2, 1000, 2, None),
        (2, 1000, 8, "--workers 8: this machine has 2 cores for it: --workers 2 is as fast"),
        (1, 1000, 2, "--workers 2: this machine has one core: --workers 1 is as fast"),
        (8, 40, 2, "in chains of 64, and what is left to decode is one chain: --workers 1 is as fast"),
        (8, 150, 5, "and what is left to decode is 3 chains: --workers 3 is as fast"),
        (8, 150, 3, None),
    ],
)
def test_processes_that_do_not_help_are_named(cores, n_cores, n_frames, count, said):
    cores(n_cores)
    found = idle_processes(job_on(), todo(n_frames), count)
    assert (found is None) if said is None else (found.startswith("note: ") and found.endswith(said))


IDLE = """
from pipeline.processes import serve
def work(receive, say):
    while True: say(receive() and None)
serve(work)
"""


def test_after_an_error_processes_without_work_are_ended_too(monkeypatch):
    """One that is only killed leaves its pipes open, and stays a zombie."""
    started = []

    class Idle(Child):
        def __init__(self, *_):
            super().__init__(IDLE)
            started.append(self)

    monkeypatch.setattr(executors, "Child", Idle)
    with pytest.raises(FootageError), ProcessExecutor(job_on(), 1) as processes:
        processes.submit(todo(1), print).result()
        raise FootageError("of another process")
    (child,) = started
    assert child._process.returncode is not None
    assert child._process.stdin.closed and child._process.stdout.closed


def test_one_gpu_does_all_the_work(cores):
    cores(8)
    assert "one GPU does all the work, and --workers 1 is as fast" in idle_processes(job_on("cuda"), todo(1000), 2)
    assert idle_processes(job_on("cuda"), todo(1000), 1) is None


@pytest.fixture
def child(tmp_path, cpu):
    """Return a process that decodes, and a job for it; only what a test needs of the store is there."""
    record(tmp_path / "film.zarr", 4)
    settings = DecodeSettings(transfer="linear")
    film, store = str(tmp_path / "film.zarr"), str(tmp_path / "r")
    job = Job(film, StoredAs(), settings, None, None, 1, 0, ("mask",), store, "cpu")
    with Child("from pipeline.batch.executors import decode_what_comes; decode_what_comes()") as child:
        yield child, job


def test_frames_are_told_one_by_one(child):
    process, job = child
    decode_job(job, stop=1)  # makes the store
    process.send(job)
    assert process.receive() is None
    if os.name == "posix":
        os.kill(process.pid, signal.SIGINT)  # which is not its business
    process.send([(range(4), frozenset({2, 3}))])
    assert [process.receive().number for _ in range(2)] == [2, 3]
    assert process.receive() is None


def test_what_goes_wrong_is_sent_back(child):
    process, job = child
    process.send(job)
    with pytest.raises(OutputError, match="every worker must see it") as caught:
        process.receive()
    assert "Traceback" in str(caught.value.__cause__)
