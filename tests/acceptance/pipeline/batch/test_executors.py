"""Real processes on this machine: the same bytes as in one, whoever dies on the way."""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from support.command_line import command
from support.recorded_footage import N_FRAMES, contents, job_of, record

from pipeline import DecodeSettings
from pipeline.batch import executors
from pipeline.batch.job import CHAIN_FRAMES, Job
from pipeline.batch.run import decode_job
from pipeline.errors import ClusterError, FootageError, OutputError
from pipeline.footage.footage import StoredAs
from pipeline.output.store import chosen_fields
from tikernels import runtime


def children():
    """Return the processes that decode frames for us."""
    mine, found = os.getpid(), []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == mine and b"decode_what_comes" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
        except (OSError, IndexError):
            pass  # it has ended
    return found


@pytest.mark.usefixtures("kernels_on_disk")
@pytest.mark.skipif(not Path("/proc").exists(), reason="processes are found in /proc")
def test_processes_that_are_killed(folder, here, tmp_path):
    store = tmp_path / "result.zarr"
    killed = []

    def kill():
        """Kill a worker whenever twenty more frames are done."""
        for target in (15, 60, 110):
            while not finished.is_set() and len(list((store / "done").glob("c.*"))) < target:
                time.sleep(0.005)
            if not finished.is_set() and (workers := children()):
                os.kill(workers[len(killed) % len(workers)], signal.SIGKILL)
                killed.append(target)

    finished = threading.Event()
    killer = threading.Thread(target=kill)
    killer.start()
    try:
        summary = decode_job(job_of(folder, store), workers=2)
    finally:
        finished.set()
        killer.join()
    assert killed[:2] == [15, 60]
    assert summary.bad == []
    assert contents(store) == here


@pytest.mark.usefixtures("kernels_on_disk")
@pytest.mark.skipif(os.name != "posix", reason="a terminal's Ctrl-C is a signal to a group of processes")
def test_ctrl_c_at_the_terminal(folder, tmp_path):
    """What is stored is whole, and no process says anything."""
    arguments = command("decode", folder / "film.zarr", "--out", tmp_path / "out", "--arch", "cpu", "--workers", "2")
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True, start_new_session=True)
    marks = tmp_path / "out" / "result.zarr" / "done"
    with process:
        while len(list(marks.glob("c.*"))) < 5:
            assert process.poll() is None
            time.sleep(0.005)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=120)
    assert process.returncode == 130
    n_done = len(list(marks.glob("c.*")))
    *progress, last = said.splitlines()
    # A slow machine tells how far it is.
    steps = ("compiling kernels", "starting processes")
    assert all(line.startswith(steps) and re.search(r"after \d+ s$", line) for line in progress), said
    assert last == f"stopped: {n_done} of {N_FRAMES} frames are done; the same command goes on from there"
    assert n_done < CHAIN_FRAMES
    assert not list((tmp_path / "out").rglob("*.part*"))


KERNELS_FOR_THE_PROCESSES = """
import sys
from pathlib import Path
from support.recorded_footage import job_of
from pipeline.batch.job import Job
from pipeline.batch.run import decode_job
from tikernels import runtime
from tikernels._taichi import ti

def learn(job, source):
    print(ti.lang.impl.current_cfg().cpu_max_num_threads, runtime.is_started())
    raise KeyboardInterrupt

Job.learn = learn
folder, workers = Path(sys.argv[1]), int(sys.argv[2])
try: decode_job(job_of(folder, Path(sys.argv[3])), workers=workers)
except KeyboardInterrupt: pass
"""


@pytest.mark.usefixtures("kernels_on_disk")
@pytest.mark.parametrize("workers", [1, len(executors.usable_cores())])
def test_kernels_are_compiled_for_as_many_threads_as_the_processes_have(folder, tmp_path, workers):
    """They take none that were compiled for another number."""
    arguments = [sys.executable, "-c", KERNELS_FOR_THE_PROCESSES, folder, str(workers), tmp_path / "result.zarr"]
    tests = str(Path(__file__).parents[3])
    environment = {name: value for name, value in os.environ.items() if name not in runtime.THREAD_VARIABLES}
    environment["PYTHONPATH"] = os.pathsep.join([tests, *sys.path])
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=120)
    threads = len(executors.shares(executors.usable_cores(), workers)[0])
    assert done.stdout.splitlines()[-1:] == [f"{threads} True"], done.stderr


@pytest.mark.usefixtures("kernels_on_disk")
def test_an_error_in_a_worker_is_one_line(folder, tmp_path):
    """A damaged frame ends a strict run with its number."""
    film = tmp_path / "film.zarr"
    record(film, 70)
    (film / "frames" / "c.66.0.0.0").unlink()
    fields = chosen_fields(("mask",), in_mm=False)
    job = Job(str(film), StoredAs(), DecodeSettings(), None, None, 1, 0, fields, str(tmp_path / "r.zarr"), "cpu")
    with pytest.raises(FootageError, match=r"frame 66 of .*film\.zarr: it is missing"):
        decode_job(job, strict=True, workers=2)
    assert decode_job(job).bad[0].number == 66


@pytest.mark.usefixtures("kernels_on_disk")
def test_that_die_again_and_again(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(executors, "_SILENT_S", 0.0)
    with pytest.raises(ClusterError, match="processes died over the same frames"):
        decode_job(job_of(folder, tmp_path / "result.zarr"), workers=2)


@pytest.mark.usefixtures("kernels_on_disk")
def test_an_error_of_ours_comes_back_as_it_was(folder, tmp_path):
    """A store that vanishes is told in the words that this process would use; nobody makes it again."""
    job = job_of(folder, tmp_path / "result.zarr")

    def remove(done, of):
        if done == 5:
            shutil.rmtree(job.store, ignore_errors=True)

    with pytest.raises(OutputError, match=r"vanished|is not there"):
        decode_job(job, workers=2, notify=remove)
    assert not (Path(job.store) / "zarr.json").exists()


@pytest.mark.usefixtures("kernels_on_disk")
@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="processes cannot be bound to cores here")
def test_each_process_has_its_share_of_the_cores(folder, tmp_path):
    seen = set()

    def look(done, of):
        seen.update(tuple(sorted(os.sched_getaffinity(child))) for child in children())

    decode_job(job_of(folder, tmp_path / "result.zarr"), workers=2, notify=look)
    assert seen == {tuple(share) for share in executors.shares(executors.usable_cores(), 2)}
