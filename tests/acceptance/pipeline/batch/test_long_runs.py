"""Runs that are killed again and again, and long ones."""

import os
from pathlib import Path

import pytest
from support.recorded_footage import contents, kill_again_and_again, record

from pipeline import DecodeSettings
from pipeline.batch.job import Job
from pipeline.batch.run import decode_footage
from pipeline.footage.source import StoredAs
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
        decode_footage(Job(str(film), StoredAs(), DecodeSettings(), None, None, 1, 0, fields, store, "cpu"))

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
    decode_footage(
        Job(str(film), StoredAs(), DecodeSettings(), None, None, 1, 0, fields, str(tmp_path / "r"), "cpu"), tell=note
    )
    assert sizes[150] - sizes[50] < 20
