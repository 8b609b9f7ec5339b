"""The lowest versions that pyproject.toml names: with all of them at once, a frame is measured and drawn."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.missing import skip_but_fail_in_ci

ROOT = Path(__file__).resolve().parents[2]
#: The Python whose wheels the lowest versions have.
PYTHON = (3, 11)
#: Tests of what touches other packages the most, and what they need.
TESTS = [f"tests/unit/pipeline/{name}.py" for name in ("calibration/test_model", "footage/test_image_file")]
TESTS += [f"tests/unit/pipeline/output/{name}.py" for name in ("test_store", "formats/test_ply")]
NEEDED = ["pytest", "pytest-timeout", "pytest-xdist"]


def run(*command, **options):
    """Return what a command prints, and fail with it."""
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=1800, **options)
    assert done.returncode == 0, done.stdout[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """Install the project and the lowest version of each of its dependencies into an empty environment."""
    uv = shutil.which("uv", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if uv is None:
        skip_but_fail_in_ci("uv, which finds the lowest versions, is not installed: pip install uv")
    if sys.version_info[:2] != PYTHON:
        skip_but_fail_in_ci("the lowest versions have wheels for Python {}.{} only".format(*PYTHON))
    folder = tmp_path_factory.mktemp("lowest") / "environment"
    run(uv, "venv", "--python", sys.executable, folder)
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    install = [uv, "pip", "install", "--quiet", "--python", python]
    lowest = subprocess.run(
        [*install, "--resolution", "lowest-direct", ROOT], capture_output=True, text=True, timeout=1800
    )
    if "error sending request" in lowest.stderr or "dns error" in lowest.stderr:
        skip_but_fail_in_ci("no package index is reached")
    assert lowest.returncode == 0, lowest.stderr[-3000:]
    run(*install, *NEEDED)
    return python.parent


@pytest.mark.timeout(5400)
def test_a_frame_is_measured_and_drawn(programs, tmp_path):
    """Nothing warns; the picture is that of the mesh, or a note says that a graphics library is missing."""
    out = tmp_path / "demo"
    said = run(programs / "colorphase", "demo", "--out", out, "--arch", "cpu", cwd=tmp_path)
    assert "Warning" not in said
    assert (out / "render.png").exists() or "OpenGL" in said
    assert json.loads((out / "report.json").read_text())["against_truth"]["depth_rms_mm"] < 0.2
    calibrated = ["--calibration", out / "calibration.json", "--out", tmp_path / "again", "--arch", "cpu"]
    assert "Warning" not in run(programs / "colorphase", "decode", out / "frame.png", *calibrated, cwd=tmp_path)
    assert (tmp_path / "again" / "mesh.ply").stat().st_size > 1_000_000


@pytest.mark.timeout(1800)
def test_tests_of_files_and_lenses_pass(programs):
    run(programs / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", *TESTS, cwd=ROOT)
