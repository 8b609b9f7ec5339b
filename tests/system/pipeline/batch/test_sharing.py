"""In how many processes footage is decoded, and what is said of those that are more than help."""

import pytest

from pipeline import DecodeSettings
from pipeline.batch import sharing
from pipeline.batch.job import Job, chains
from pipeline.batch.sharing import idle_processes, worthwhile_processes
from pipeline.footage.source import StoredAs


def job(arch="cpu"):
    return Job("film", StoredAs(), DecodeSettings(), None, None, 1, 0, ("mask",), "result.zarr", arch)


def todo(n_frames):
    return list(chains(range(n_frames), set(range(n_frames))))


@pytest.fixture
def cores(monkeypatch):
    def have(count):
        monkeypatch.setattr(sharing, "usable_cores", lambda: list(range(count)))

    return have


def test_how_many_processes_are_worth_their_start(cores):
    cores(8)
    assert [worthwhile_processes(job(), todo(n)) for n in (1024, 300, 10)] == [8, 2, 1]
    assert worthwhile_processes(job("vulkan"), todo(1024)) == 1


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
    found = idle_processes(job(), todo(n_frames), count)
    assert (found is None) if said is None else (found.startswith("note: ") and found.endswith(said))


def test_one_gpu_does_all_the_work(cores):
    cores(8)
    assert "one GPU does all the work, and --workers 1 is as fast" in idle_processes(job("cuda"), todo(1000), 2)
    assert idle_processes(job("cuda"), todo(1000), 1) is None
