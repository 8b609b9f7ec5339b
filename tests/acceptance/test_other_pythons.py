"""The contract and one step of each room on other Pythons, and the kernels without Taichi."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
VERSIONS = ("3.14", "3.13", "3.12", "3.11")
KERNELS = (
    "tests/unit/tikernels/phase/test_crosstalk.py",
    "tests/unit/tikernels/phase/test_phase_fit.py",
    "tests/unit/tikernels/raw/test_linearization.py",
    "tests/unit/tikernels/unwrapping/test_unwrapper.py",
    "tests/unit/tikernels/depth/test_triangulation.py",
)
DECODER = ("tests/system/pipeline/test_decoder.py",)
CONTRACT = ("tests/unit/test_colorphase.py", "tests/unit/pipeline/test_settings.py")

pytestmark = pytest.mark.timeout(3600)


def interpreter(version: str) -> str | None:
    """Return the program of a Python, on the path or from pyenv; None where this machine has none."""
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    program = f"python{version}"
    for candidate in (shutil.which(program), *sorted(pyenv.glob(f"{version}.*/bin/python"), reverse=True)):
        # A shim of pyenv exists without its Python.
        if candidate is not None and subprocess.run([candidate, "--version"], capture_output=True).returncode == 0:
            return str(candidate)
    return None


OTHERS = [
    (version, program)
    for version in VERSIONS
    if version != "{}.{}".format(*sys.version_info) and (program := interpreter(version)) is not None
]


def run(*command: object, **environment: str) -> None:
    """Run a program in the project; its tests are on the CPU, since Vulkan's compiler takes minutes."""
    done = subprocess.run(
        [str(part) for part in command],
        cwd=ROOT,
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3000:]


def install_and_test(python: str, folder: Path) -> None:
    """Install the project into a new environment of a Python, and test it."""
    run(python, "-m", "venv", folder)
    run(folder / "bin" / "python", "-m", "pip", "install", "-q", f"{ROOT}[headless,test]")
    pytest_ = (folder / "bin" / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", "not vulkan")
    run(*pytest_, *CONTRACT, *KERNELS, *DECODER)


@pytest.mark.skipif(not OTHERS, reason="this machine has no other Python that is supported")
def test_the_newest_other_python(tmp_path):
    install_and_test(OTHERS[0][1], tmp_path / "environment")


@pytest.mark.parametrize("python", [program for _, program in OTHERS[1:]], ids=[version for version, _ in OTHERS[1:]])
def test_the_pythons_before(python, tmp_path):
    install_and_test(python, tmp_path / "environment")


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="Taichi has no wheel for this Python anyway")
def test_without_taichi(tmp_path):
    """As on a machine that cannot import it."""
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['taichi'] = None\n")
    tests = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", "not vulkan")
    run(*tests, "tests/unit/tikernels", *DECODER, PYTHONPATH=str(tmp_path))
