"""The process that decodes footage, spoken to as its starter does."""

import os
import pickle
import signal
import subprocess
import sys

import pytest
from support.recorded_footage import record

from pipeline import DecodeSettings
from pipeline.batch.job import Job
from pipeline.batch.run import decode_footage
from pipeline.batch.worker_process import Done, Failure
from pipeline.errors import OutputError
from pipeline.footage.source import StoredAs


@pytest.fixture
def process():
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    program = "from pipeline.batch.worker_process import serve; serve()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", program], env=environment, **pipes) as process:
        yield process
        process.kill()


@pytest.fixture
def job(tmp_path, cpu):
    record(tmp_path / "film.zarr", 4)
    return Job(
        str(tmp_path / "film.zarr"),
        StoredAs(),
        DecodeSettings(transfer="linear"),
        None,
        None,
        1,
        0,
        ("mask",),
        str(tmp_path / "r"),
        "cpu",
    )


def say(process, message):
    pickle.dump(message, process.stdin)
    process.stdin.flush()


def test_frames_are_told_one_by_one(process, job):
    decode_footage(job, stop=1)  # makes the store
    say(process, job)
    assert isinstance(pickle.load(process.stdout), Done)
    if os.name == "posix":
        process.send_signal(signal.SIGINT)  # which is not its business
    say(process, [(range(4), frozenset({2, 3}))])
    assert [pickle.load(process.stdout).number for _ in range(2)] == [2, 3]
    assert isinstance(pickle.load(process.stdout), Done)
    assert process.communicate(timeout=60) == (b"", b"")
    assert process.returncode == 0


def test_what_goes_wrong_is_sent_back(process, job):
    say(process, job)
    failure = pickle.load(process.stdout)
    assert isinstance(failure, Failure) and isinstance(failure.error, OutputError)
    assert "every worker must see it" in str(failure.error) and "Traceback" in failure.trace


def test_nobody_listens_any_more(process, job):
    decode_footage(job, stop=1)
    say(process, job)
    assert isinstance(pickle.load(process.stdout), Done)
    process.stdout.close()
    say(process, [(range(4), frozenset({1, 2, 3}))])
    assert process.wait(60) == 1
    assert process.stderr.read() == b""
