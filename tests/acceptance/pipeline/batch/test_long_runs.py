"""Runs that are killed again and again, and long ones."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from support.command_line import command
from support.recorded_footage import contents, kill_again_and_again, record

from pipeline import DecodeSettings
from pipeline.batch.job import Job
from pipeline.batch.run import decode_job
from pipeline.footage.footage import StoredAs
from pipeline.output.store import chosen_fields

pytestmark = pytest.mark.usefixtures("cpu")

KILLS = 20


@pytest.mark.timeout(1800)
@pytest.mark.usefixtures("kernels_on_disk")
def test_killed_again_and_again(tmp_path):
    """In the command's own chains and its own process; what is stored is what an undisturbed run stores."""
    film = tmp_path / "long.zarr"
    record(film, 20 * KILLS)
    options = ("--fields", "mask", "range_image", "phase_sigma")
    fields = chosen_fields(options[1:], in_mm=False)

    def finish(folder: Path) -> None:
        store = f"{folder}/result.zarr"
        decode_job(Job(str(film), StoredAs(), DecodeSettings(), None, None, 1, 0, fields, store, "cpu"))

    finish(tmp_path / "whole")
    killed = kill_again_and_again(film, tmp_path / "killed", KILLS, 5, *options)
    assert killed >= 2 * KILLS // 3
    finish(tmp_path / "killed")
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
def test_memory_stays_flat(tmp_path):
    """From the time that all buffers are there, less than 20 MB; `tests/benchmarks/throughput.py` does 2,000 frames."""
    film = tmp_path / "film.zarr"
    record(film, 150)
    sizes = {}

    def note(done, of):
        sizes[done] = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    fields = chosen_fields(None, in_mm=False)
    decode_job(
        Job(str(film), StoredAs(), DecodeSettings(), None, None, 1, 0, fields, str(tmp_path / "r"), "cpu"), notify=note
    )
    assert sizes[150] - sizes[50] < 20


@pytest.mark.skipif(os.name != "posix", reason="a terminal's Ctrl-C is a signal to a group of processes")
@pytest.mark.usefixtures("kernels_on_disk")
def test_ctrl_c_at_the_terminal(tmp_path):
    """Exit code 130, and one line that says how to go on."""
    record(tmp_path / "film.zarr", 300)
    arguments = command("decode", tmp_path / "film.zarr", "--out", tmp_path / "out", "--arch", "cpu")
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True, start_new_session=True)
    with process:
        while len(list((tmp_path / "out" / "result.zarr" / "done").glob("c.*"))) < 5:
            assert process.poll() is None
            time.sleep(0.005)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "stopped: " in said and "of 300 frames are done; the same command goes on from there" in said
    assert "Traceback" not in said
    assert not list((tmp_path / "out").rglob("*.part*"))
