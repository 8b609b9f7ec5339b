"""Real processes of Dask distributed: the same bytes as here, whoever dies on the way."""

import os
import signal
import socket
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
from support.command_line import command
from support.missing import import_but_fail_in_ci
from support.recorded_footage import contents, record

from pipeline import DecodeSettings
from pipeline.batch.cluster import local_cluster
from pipeline.batch.job import CHAIN_FRAMES, Job
from pipeline.batch.run import decode_footage
from pipeline.errors import ClusterError, FootageError
from pipeline.footage.source import StoredAs
from pipeline.output.store import chosen_fields

import_but_fail_in_ci("distributed")
# Not ours: what Dask leaves behind when its processes are killed.
pytestmark = [
    pytest.mark.usefixtures("kernels_on_disk"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
N_FRAMES = 200


@pytest.fixture(scope="module")
def folder(tmp_path_factory, cpu):
    folder = tmp_path_factory.mktemp("cluster")
    record(folder / "film.mkv", N_FRAMES)
    return folder


@pytest.fixture(scope="module")
def here(folder):
    """Return what a run in this process stores."""
    store = folder / "here.zarr"
    decode_footage(job_of(folder, store))
    return contents(store)


def job_of(folder, store):
    fields = chosen_fields(("mask", "unwrapped_phase", "phase_sigma"), in_mm=False)
    film = str(folder / "film.mkv")
    return Job(film, StoredAs(), DecodeSettings(), None, None, 1, 0, fields, str(store), "cpu")


def children():
    """Return the processes that run frames for us: Dask's workers, which their nannies have started."""
    mine, found = os.getpid(), []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == mine and b"spawn_main" in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
        except (OSError, IndexError):
            pass  # it has ended
    return found


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc").exists(), reason="processes are found in /proc")
def test_workers_that_are_killed(folder, here, tmp_path):
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
        summary = decode_footage(job_of(folder, store), workers=2)
    finally:
        finished.set()
        killer.join()
    assert killed[:2] == [15, 60]
    assert summary.bad == []
    assert contents(store) == here


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="a terminal's Ctrl-C is a signal to a group of processes")
def test_ctrl_c_at_the_terminal(folder, tmp_path):
    """Workers end with the frame that they are at, and neither they nor Dask say anything."""
    arguments = command("decode", folder / "film.mkv", "--out", tmp_path / "out", "--arch", "cpu", "--workers", "2")
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
    assert said == f"stopped: {n_done} of {N_FRAMES} frames are done; the same command goes on from there\n"
    assert n_done < CHAIN_FRAMES
    assert not list((tmp_path / "out").rglob("*.part*"))


def test_an_error_in_a_worker_is_one_line(folder, tmp_path):
    """A damaged frame ends a strict run with its number."""
    film = tmp_path / "film.zarr"
    record(film, 70)
    (film / "frames" / "c.66.0.0.0").unlink()
    fields = chosen_fields(("mask",), in_mm=False)
    job = Job(str(film), StoredAs(), DecodeSettings(), None, None, 1, 0, fields, str(tmp_path / "r.zarr"), "cpu")
    with pytest.raises(FootageError, match=r"frame 66 of .*film\.zarr: it is missing"):
        decode_footage(job, strict=True, workers=1)
    assert decode_footage(job).bad[0].number == 66


def test_another_cluster_on_this_machine(recwarn):
    """Its port for pages about itself, which nobody asks for, is taken."""
    with socket.socket() as taken:
        with suppress(OSError):  # or it is in use already
            taken.bind(("127.0.0.1", 8787))
            taken.listen()
        with local_cluster(1) as cluster:
            assert len(cluster.scheduler_info["workers"]) == 1
    assert not recwarn.list


def test_no_scheduler(folder, tmp_path):
    """It is known at once where nobody listens."""
    with pytest.raises(ClusterError, match=r"no scheduler answers at tcp://127\.0\.0\.1:9 \(.*refused"):
        decode_footage(job_of(folder, tmp_path / "result.zarr"), cluster="tcp://127.0.0.1:9")


def test_something_else_listens(folder, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"

        def answer():
            for _ in range(2):  # the first only asks whether anybody is there
                connection, _ = server.accept()
                with connection:
                    connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        answering = threading.Thread(target=answer)
        answering.start()
        with pytest.raises(ClusterError, match="is no Dask scheduler"):
            decode_footage(job_of(folder, tmp_path / "result.zarr"), cluster=address)
        answering.join(10)


def test_no_worker_is_left(folder, tmp_path, monkeypatch):
    """A scheduler alone waits for another one; we do not wait for ever."""
    monkeypatch.setattr("pipeline.batch.cluster._LOOK_S", 0.5)
    monkeypatch.setattr("pipeline.batch.cluster._ALONE_S", 1)
    job = job_of(folder, tmp_path / "result.zarr")
    with local_cluster(1) as cluster:
        cluster.scale(0)
        with pytest.raises(ClusterError, match="no worker is left: start one"):
            decode_footage(job, cluster=cluster.scheduler_address)
