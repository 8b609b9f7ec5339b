"""Footage that changes between runs, and while one runs: its frames are decoded anew, or refused in one line."""

import os
import random
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import zarr
from support.recorded_footage import contents, job_of, record

from pipeline.batch import job as jobs
from pipeline.batch.run import Stopped, decode_job
from pipeline.calibration import Calibration
from pipeline.errors import FootageError, OutputError
from pipeline.output.stored_result import StoredResult
from pipeline.recording.video_export import export_video

pytestmark = pytest.mark.usefixtures("cpu")

N_FRAMES, CHAIN = 7, 3
REFUSED = re.compile(
    r".* holds frames made otherwise \(footage\.(frames is \d+ there, \d+ here|first_frame is another one)\): choose .*"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, cpu):
    """Return a folder with footage of two takes, as pictures, recordings and videos, and the rig's calibration."""
    folder = tmp_path_factory.mktemp("takes")
    rig = record(folder / "both.zarr", 2 * N_FRAMES)
    (folder / "rig.json").write_text(rig.model_dump_json())
    frames = zarr.open_group(folder / "both.zarr", mode="r")["frames"]
    for name, first in (("here", 0), ("other", N_FRAMES)):
        (folder / name / "pictures").mkdir(parents=True)
        for number in range(N_FRAMES):
            picture = folder / name / "pictures" / f"{number}.bmp"
            cv2.imwrite(str(picture), frames[first + number][..., ::-1])
        shutil.copytree(folder / "both.zarr", folder / name / "film.zarr")
    return folder


def chosen(rng, folder):
    """Return one of the files that hold a frame."""
    return folder / rng.choice(sorted(name for name in os.listdir(folder) if re.search(r"\.bmp$|^c\.", name)))


def put(content, file):
    """Write into a file whose time stays what it was."""
    about = file.stat()
    file.write_bytes(content)
    os.utime(file, ns=(about.st_atime_ns, about.st_mtime_ns))


def replace_one(rng, here, other):
    put(chosen(rng, other).read_bytes(), chosen(rng, here))


def copy_one(rng, here, other):
    put(chosen(rng, here).read_bytes(), chosen(rng, here))


def swap_two(rng, here, other):
    one, two = chosen(rng, here), chosen(rng, here)
    first = one.read_bytes()
    put(two.read_bytes(), one)
    put(first, two)


def cut_one(rng, here, other):
    file = chosen(rng, here)
    put(file.read_bytes()[: rng.randrange(file.stat().st_size)], file)


def alter_one(rng, here, other):
    file = chosen(rng, here)
    content = bytearray(file.read_bytes())
    content[rng.randrange(len(content) // 2, len(content))] ^= 1 << rng.randrange(8)
    put(content, file)


def remove_one(rng, here, other):
    chosen(rng, here).unlink()


def add_one(rng, here, other):
    shutil.copy2(chosen(rng, other), here / f"{rng.randrange(N_FRAMES)}_.bmp")


def rename_one(rng, here, other):
    chosen(rng, here).rename(here / f"{rng.randrange(N_FRAMES)}_.bmp")


def add_and_remove_one(rng, here, other):
    add_one(rng, here, other)
    remove_one(rng, here, other)


BLOCKS = [replace_one, copy_one, swap_two, cut_one, alter_one, remove_one]
PICTURES = [*BLOCKS, add_one, rename_one, add_and_remove_one]


class Footage:
    """Frames that change, and runs over them."""

    def __init__(self, kind, folder, place, seed):
        self.kind, self.folder, self.place, self.rng = kind, folder, place, random.Random(seed)
        self.name = {"pictures": "pictures", "recording": "film.zarr", "video": "film.mkv"}[kind]
        self.renew()

    @property
    def frames(self):
        """Where the files of the frames are."""
        return self.place / "pictures" if self.kind == "pictures" else self.place / "film.zarr" / "frames"

    def renew(self):
        """Begin again, with a store of its own."""
        shutil.rmtree(self.place, ignore_errors=True)
        shutil.copytree(self.folder / "here", self.place)
        self.finish()

    def finish(self):
        """Make the video of the recording as it is now, under the same name."""
        if self.kind == "video":
            (self.place / "film.mkv").unlink(missing_ok=True)
            export_video(self.place / "film.zarr", self.place / "film.mkv")

    def change(self):
        """Change one thing, so that the time of no file changes."""
        how = self.rng.choice(PICTURES if self.kind == "pictures" else BLOCKS[:3] if self.kind == "video" else BLOCKS)
        how(self.rng, self.frames, self.folder / "other" / self.frames.relative_to(self.place))
        self.finish()

    def job(self, store):
        """Return a job that decodes it as it is now."""
        rig = Calibration.read(self.folder / "rig.json")  # what is learnt from a frame would stay a result's
        job = job_of(self.place, self.place / store)
        return replace(job, footage=str(self.place / self.name), calibration=rig, fields=("unwrapped_phase",))


def stored(store: Path):
    """Return what is stored of frames: their values and marks."""
    result = StoredResult(store)
    assert all(np.isfinite(result.frame(number).unwrapped_phase).any() for number in result.done)
    return {name: digest for name, digest in contents(store).items() if re.search(r"^(unwrapped_phase|done)/c\.", name)}


def check_against_a_fresh_run(footage):
    """Decode what has been decoded before; it is as if it had been decoded now, or refused."""
    try:
        decode_job(footage.job("result.zarr"))
    except (OutputError, FootageError) as error:
        assert REFUSED.fullmatch(str(error)), error
        footage.renew()
        return False
    shutil.rmtree(footage.place / "fresh.zarr", ignore_errors=True)
    decode_job(footage.job("fresh.zarr"))
    assert stored(footage.place / "result.zarr") == stored(footage.place / "fresh.zarr")
    return True


@pytest.fixture(params=["pictures", "recording", "video"])
def footage(request, folder, tmp_path, monkeypatch):
    monkeypatch.setattr(jobs, "CHAIN_FRAMES", CHAIN)
    monkeypatch.setattr("pipeline.batch.worker._COMMIT_S", 0.0)
    return Footage(request.param, folder, tmp_path / "place", seed=11)


def test_changes_between_runs(footage):
    """Of runs, too, that were stopped: a frame is never another one's result, and none is lost."""
    n_again = 0
    for _ in range(12):
        try:
            stop = footage.rng.randrange(2 * N_FRAMES)

            def notify(done, of, stop=stop):
                if done == stop:
                    raise KeyboardInterrupt

            decode_job(footage.job("result.zarr"), notify=notify)
        except (Stopped, KeyboardInterrupt):
            pass
        footage.change()
        n_again += check_against_a_fresh_run(footage)
    assert n_again >= 3


def test_changes_while_it_runs_that_are_undone_afterwards(footage):
    """What was read in between is not what is there in the end, nor what was there at first."""
    n_bad = 0
    for _ in range(8):
        before = footage.place.with_name("before")
        shutil.rmtree(before, ignore_errors=True)
        at = footage.rng.choice(["compiling kernels", "compiling kernels", 0, 1])
        ends = footage.rng.random() < 0.5

        def change(when, at=at, before=before, ends=ends):
            if when == at and not before.exists():
                shutil.copytree(footage.frames, before)
                footage.change()
            elif ends and before.exists() and when == 4:
                raise KeyboardInterrupt

        shutil.rmtree(footage.place / "result.zarr", ignore_errors=True)
        try:
            summary = decode_job(
                footage.job("result.zarr"), workers=1, step=change, notify=lambda done, of, change=change: change(done)
            )
            n_bad += sum("has changed since this run began: run again" in bad.reason for bad in summary.bad)
        except (Stopped, KeyboardInterrupt):
            pass
        except (OutputError, FootageError) as error:  # the worker opens it again
            assert REFUSED.fullmatch(str(error)), error
        shutil.rmtree(footage.frames)
        shutil.copytree(before, footage.frames)
        footage.finish()
        assert check_against_a_fresh_run(footage)
    assert n_bad >= 1
