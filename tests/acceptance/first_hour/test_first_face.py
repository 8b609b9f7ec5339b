"""The page "Your first face in an hour", as a new user follows it: every command, on the simulated rig."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.page_blocks import PageBlocks

from pipeline.calibration import Calibration
from pipeline.simulation import simulated_truth

pytestmark = pytest.mark.timeout(1500)

PAGE = Path(__file__).resolve().parents[3] / "docs" / "first_face.md"
PROGRAMS = Path(sys.executable).parent
#: The commands up to the first depth, without the one that prints the board.
TO_DEPTH = ("rig rig.toml", "expose", "calibrate capture", "capture", "decode")


def test_the_page_ends_with_a_face_and_a_ball_in_millimetres(tmp_path):
    commands = PageBlocks.of(PAGE).commands
    assert shutil.which("colorphase", path=str(PROGRAMS)), "the project is not installed"
    environment = {**os.environ, "PATH": f"{PROGRAMS}{os.pathsep}{os.environ['PATH']}", "COLUMNS": "200"}
    said = {}
    for line in commands:
        done = subprocess.run(
            line, shell=True, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900, check=False
        )
        assert done.returncode == 0, f"{line}\n{done.stderr[-2000:]}"
        said[line] = done.stdout
    needed = [line for line in commands if line.startswith("colorphase")][1 : len(TO_DEPTH) + 1]
    assert all(line.startswith(f"colorphase {name}") for line, name in zip(needed, TO_DEPTH, strict=True))
    # By hand: the sheet once, the poses, and the face.
    told = [
        (int(acts), int(seconds))
        for line in needed
        for acts, seconds in re.findall(r"simulated: (\d+) manual acts, (\d+) s by the rig's clock", said[line])
    ]
    assert len(told) == 3
    assert 8 <= told[2][0] <= 10
    assert sum(seconds for _, seconds in told) < 600
    # Blind, and good to what it says of itself.
    found = Calibration.read(tmp_path / "calibration.json")
    truth = simulated_truth()
    off_mm = np.linalg.norm(found.translation_mm) - np.linalg.norm(truth.translation_mm)
    assert abs(off_mm) < 4 * np.linalg.norm(found.uncertainty.translation_mm) < 1
    assert found.uncertainty.depth_bias_mm < 0.2
    assert "no fault was found" in said[needed[1]]
    assert (tmp_path / "face.png").stat().st_size > 20_000
    checked = said[commands[-1]]
    assert len(re.findall(r"│ (?:noise of a point|probing error, .*?) +│ .*│ fine │", checked)) == 3, checked
    log = (tmp_path / "face" / "log.jsonl").read_text().splitlines()
    assert json.loads(log[0])["calibration_sha256"] == found.digest()
