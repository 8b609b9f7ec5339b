"""Every command, block of Python and block of TOML in README and docs runs as it is printed.

README's own commands run in a fresh environment, which its first command makes in a copy of the project; the other
pages' run in the environment that the tests run in.
"""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
from support.missing import skip_but_fail_in_ci
from support.newcomers_things import make_things
from support.page_blocks import PageBlocks

from hardware.settings import RigSettings
from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.acquisition.chosen_rig import read_rig
from pipeline.footage import read_image

pytestmark = pytest.mark.timeout(1500)

ROOT = Path(__file__).resolve().parents[3]
PAGES = {page.name: page for page in sorted((ROOT / "docs").glob("*.md"))}
PROGRAMS = Path(sys.executable).parent
COMMAND_S = 600
#: The longest time that making the files takes which pages read, s.
MAKING_S = 900
_SHOWN = 3000  # of what a command said, characters
TEST_COMMAND = (
    'python3 -m venv .venv && .venv/bin/python -m pip install -e ".[headless,test]" && .venv/bin/python -m pytest -n 2'
)
#: What is not run, and why.
NOT_RUN = {
    TEST_COMMAND: "these tests themselves; .ci/run runs it",
    'python -m pip install -e ".[headless,docs]"': "these tests' environment has them",
    "python -m sphinx -W --keep-going -D plot_gallery=0 docs build/site": "test_site.py runs it",
    "pip install 'colorphase[project]'": "from a package index; the extra is in the tests' environment",
    "colorphase project pattern.png --display 1": "needs a second screen; tests of `colorphase project` have one",
    "colorphase projector on --rig rig.toml": "needs a projector; its tests emulate one",
    "colorphase projector input 31 --rig rig.toml": "the same",
    "colorphase projector blank --rig rig.toml": "the same",
    "colorphase projector status --rig rig.toml": "the same",
    "colorphase projector off --rig rig.toml": "the same",
    "colorphase calibrate capture --rig rig.toml --out captures --board chessboard --squares 11x8 --square-mm 24": (
        "test_first_face.py runs it"
    ),
    **dict.fromkeys(
        (
            f"colorphase certify certified --{known} --diameter-mm 60 --spacing-mm 160.012 --reference-mm 0.004{out}"
            for known, out in (
                ("rig rig.toml", " --out c.json"),
                ("calibration calibration.json", ""),
            )
        ),
        "needs a ball bar and a plate; test_certify.py simulates them",
    ),
    "colorphase certify practice --rig simulated --diameter-mm 60 --spacing-mm 160 --reference-mm 0": (
        "test_certify.py runs it"
    ),
    "sudo apt install gcc-avr avr-libc avrdude make": "needs a person's password",
    "cd hardware/firmware": "only for the next one",
    "make flash PORT=/dev/ttyACM0": "needs the board; tests run the firmware in an emulator",
    "dask scheduler --host 10.0.0.1": "needs other machines; tests/acceptance/pipeline/batch/test_cluster.py has some",
    "dask worker tcp://10.0.0.1:8786 --nthreads 1": "the same",
    "colorphase decode /data/film.mkv --out /data/film --cluster tcp://10.0.0.1:8786": "the same",
}
#: A page with a test of its own.
FIRST_FACE = "first_face.md"
#: What has been run to make the files that pages read, and takes a minute: the folder that it made is copied.
MADE = {"colorphase calibrate simulate --out practice": "practice"}
#: What goes on until Ctrl-C comes, once there is a file by which it has begun.
ENDLESS = {"colorphase capture --rig rig.toml --out cloth --endless --view": "cloth/recording.part.zarr/frames/c.*"}
#: Exit codes that say something of the footage at hand.
ALLOWED = {"colorphase inspect": {0, 3}}
#: What a page's Python takes for given.
GIVEN = """
import colorphase

import cv2, pathlib, time


class Webcam:
    # It films a picture until a loop has shown its depth.

    def __init__(self, index):
        self.picture, self.until_s = cv2.imread("picture.png"), time.monotonic() + 120

    def read(self):
        time.sleep(1 / 30)
        there = not pathlib.Path("depth.png").exists() and time.monotonic() < self.until_s
        return there, self.picture if there else None


cv2.VideoCapture = Webcam
"""


@pytest.fixture(scope="session")
def things(tmp_path_factory, cpu, worker_id):
    """Make the files that the pages read, once for all processes that run these tests."""
    if worker_id == "master":
        folder = tmp_path_factory.mktemp("things")
        make_things(folder)
        return folder
    folder = tmp_path_factory.getbasetemp().parent / "things"
    made = folder.with_name("things.made")
    try:
        folder.mkdir()
    except FileExistsError:  # another process is at it
        deadline = time.monotonic() + MAKING_S
        while not made.exists():
            assert time.monotonic() < deadline, "the process that makes them has failed"
            time.sleep(0.5)
    else:
        make_things(folder)
        made.touch()
    return folder


def test_the_set_to_practise_on_is_complete(things):
    practice = things / "practice"
    assert len(list((practice / "light").glob("*.png"))) == 33
    for name, count in (("poses", 10), ("second-board", 2)):
        assert [len(list(pose.glob("*.png"))) for pose in sorted((practice / name).iterdir())] == [12] * count
    truth = Calibration.read(practice / "truth.json")
    assert np.linalg.norm(truth.translation_mm) == pytest.approx(180) and truth.scale_proof is None
    known = json.loads((practice / "objects.json").read_text())
    assert known["ball"] == {"radius_mm": 85.0, "middle_mm": [0.0, 0.0, 880.0]}
    np.testing.assert_allclose(np.linalg.norm(known["plane"]["normal"]), 1, atol=1e-5)
    assert sum(path.stat().st_size for path in practice.rglob("*.png")) < 50e6


class Reader:
    """Somebody who copies a page's blocks into a shell, one after another."""

    def __init__(self, folder: Path, things: Path, programs: Path) -> None:
        self._folder, self._things = folder, things
        path = f"{programs}{os.pathsep}{os.environ['PATH']}"
        self._environment = {**os.environ, "PATH": path, "COLUMNS": "200", "DISPLAY": ""}  # no browser opens

    def run(self, line: str) -> None:
        """Run a command line; bring first what it reads, where no command before has made it."""
        if line in NOT_RUN:
            return
        if line in MADE:
            shutil.copytree(self._things / MADE[line], self._folder / MADE[line])
            return
        self._bring(line)
        options = {"cwd": self._folder, "env": self._environment, "stdin": subprocess.DEVNULL, "text": True}
        piped = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "start_new_session": True}
        with subprocess.Popen(["bash", "-c", line], **options, **piped) as process:
            try:
                if line in ENDLESS:
                    self._wait_for(ENDLESS[line], process)
                    os.killpg(process.pid, signal.SIGINT)
                elif line.startswith("colorphase view"):
                    heard = iter(process.stdout.readline, "")
                    assert any(" is shown at http://127.0.0.1:" in each for each in heard), line
                    os.killpg(process.pid, signal.SIGINT)
                said, _ = process.communicate(timeout=COMMAND_S)
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
        code = process.returncode
        allowed = next((codes for begin, codes in ALLOWED.items() if line.startswith(begin)), {0})
        assert code in allowed, f"{line}\n{said[-_SHOWN:]}"
        assert "Traceback" not in said, f"{line}\n{said[-_SHOWN:]}"

    def _wait_for(self, file: str, process: subprocess.Popen) -> None:
        deadline = time.monotonic() + COMMAND_S
        while not any(self._folder.glob(file)) and process.poll() is None:
            assert time.monotonic() < deadline, f"no {file}"
            time.sleep(0.2)

    def _bring(self, line: str) -> None:
        words = shlex.split(line)
        for before, word in zip(["", *words], words, strict=False):
            name = word.split("/")[0]
            source = self._things / name
            if before in ("--out", "--make", "pattern", "rig", "settings") or not name or not source.exists():
                continue
            if not (self._folder / name).exists():
                (shutil.copytree if source.is_dir() else shutil.copy)(source, self._folder / name)


def sections(page: Path) -> dict[str, Path]:
    """Return the text of a page's sections by their headings."""
    parts = re.split(r"^## (.+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return dict(zip(["", *parts[1::2]], parts[::2], strict=True))


def copy_of_the_project(folder: Path) -> None:
    """Copy what git has of the project, as a clone does."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
    if not names:  # CI runs in a copy that has no history
        shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(".venv", "__pycache__", ".*_cache"))
    for name in filter(None, names.split("\0")):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, target)


def test_the_readme_in_a_fresh_environment(tmp_path, things):
    """From a clone to a mesh in one command, then on through every section, each in a folder of its own."""
    clone = tmp_path / "clone"
    copy_of_the_project(clone)
    for heading, text in sections(ROOT / "README.md").items():
        commands = PageBlocks.of_text(text).commands
        folder = clone
        if commands and heading != "Install and try":
            folder = tmp_path / re.sub(r"\W+", "-", heading)
            folder.mkdir()
            (folder / ".venv").symlink_to(clone / ".venv")
        reader = Reader(folder, things, clone / ".venv" / "bin")
        for line in commands:
            try:
                reader.run(line)
            except AssertionError as error:
                if re.search(r"Temporary failure in name resolution|NewConnectionError", str(error)):
                    skip_but_fail_in_ci("no package index can be reached from here")
                raise
    assert any((clone / "demo" / name).exists() for name in ("render.png", "shaded.png"))
    report = json.loads((clone / "demo" / "report.json").read_text())
    assert report["against_truth"]["depth_rms_mm"] < 0.2
    assert report["against_truth"]["coverage"] > 0.97


@pytest.mark.parametrize("name", [name for name in PAGES if PageBlocks.of(PAGES[name]).commands and name != FIRST_FACE])
def test_the_commands_of_a_page(tmp_path, things, name):
    (tmp_path / ".venv").symlink_to(sys.prefix)
    reader = Reader(tmp_path, things, PROGRAMS)
    for line in PageBlocks.of(PAGES[name]).commands:
        reader.run(line)


@pytest.mark.parametrize("name", ["README.md", *(name for name, page in PAGES.items() if PageBlocks.of(page).python)])
def test_the_python_of_a_page(tmp_path, things, name):
    page = PAGES.get(name, ROOT / name)
    for thing in ("calibration.json", "picture.png", "rig.toml", "film.mkv"):
        shutil.copy(things / thing, tmp_path)
    source = "\n".join((GIVEN, *PageBlocks.of(page).python))
    shutil.copytree(things / "film", tmp_path / "film")
    options = {"cwd": tmp_path, "capture_output": True, "text": True, "timeout": COMMAND_S, "check": False}
    done = subprocess.run([sys.executable, "-c", source], **options)
    assert done.returncode == 0, done.stderr
    if name == "python.md":
        rig = Calibration.read(tmp_path / "calibration.json")
        frame = Decoder(calibration=rig, arch="cpu").decode(read_image(tmp_path / "picture.png"))
        assert f": {frame.range_image[240, 320]:.1f} mm in the middle\nlive decoding was closed\n" in done.stdout


@pytest.mark.parametrize("name", ["README.md", *(name for name, page in PAGES.items() if PageBlocks.of(page).toml)])
def test_the_files_of_a_page(tmp_path, name):
    """Each is settings, a rig, or the part of a rig's file that the page is about."""
    whole = PageBlocks.of(PAGES["rig.md"]).toml[0]
    for block in PageBlocks.of(PAGES.get(name, ROOT / name)).toml:
        values = tomllib.loads(block)
        if not values.keys() & RigSettings.model_fields:
            DecodeSettings.model_validate(values)
            continue
        RigSettings.model_validate({**tomllib.loads(whole), **values})
        if values.keys() >= {"trigger", "timing", "camera"}:
            (tmp_path / "rig.toml").write_text(block)
            read_rig(tmp_path / "rig.toml")


def test_what_is_not_run_is_still_printed():
    printed = {line for page in (ROOT / "README.md", *PAGES.values()) for line in PageBlocks.of(page).commands}
    assert printed >= NOT_RUN.keys()
    assert printed >= ENDLESS.keys()
    assert printed >= MADE.keys()
