"""Footage that is decoded in several processes, and what one process makes of it."""

import pytest
from support.recorded_footage import N_FRAMES, contents, job_of, record

from pipeline.batch.run import decode_job


@pytest.fixture(scope="session")
def folder(tmp_path_factory, cpu):
    """Return a folder with the footage, ``film.zarr``."""
    folder = tmp_path_factory.mktemp("film")
    record(folder / "film.zarr", N_FRAMES)
    return folder


@pytest.fixture(scope="session")
def here(folder):
    """Return what a run in this process stores."""
    store = folder / "here.zarr"
    decode_job(job_of(folder, store))
    return contents(store)
