"""The package as it is installed, next to files of other people with the same names."""

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

import colorphase

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Install the wheel into an empty environment, which finds the dependencies where this one has them."""
    folder = tmp_path_factory.mktemp("installed")
    build = f"from hatchling.build import build_wheel; print(build_wheel({str(folder)!r}))"
    wheel = run([sys.executable, "-c", build], ROOT).stdout.split()[-1]
    venv.create(folder / "environment", with_pip=False)
    base = str(folder / "environment")
    packages = Path(sysconfig.get_path("purelib", "venv", vars={"base": base, "platbase": base}))
    theirs = [entry for entry in sys.path if Path(entry).name in ("site-packages", "dist-packages")]
    (packages / "theirs.pth").write_text("\n".join(theirs), encoding="utf-8")
    programs = folder / "environment" / ("Scripts" if os.name == "nt" else "bin")
    python = programs / "python"
    install = ["install", "--quiet", "--no-deps", "--no-index", "--disable-pip-version-check", "--ignore-installed"]
    run([str(python), "-m", "pip", *install, str(folder / wheel)], folder)
    assert sorted(file.name for file in (packages / "colorphase").glob("*.*")) == [
        "__init__.py",
        "__main__.py",
        "py.typed",
    ]
    return programs


def run(command, folder):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    quiet = {"capture_output": True, "text": True, "timeout": 240, "check": False}
    done = subprocess.run(command, cwd=folder, env=environment, **quiet)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture
def crowded(tmp_path):
    """Return a folder whose scripts are called as our packages are, and must not be run."""
    for name in ("pipeline.py", "hardware.py"):
        (tmp_path / name).write_text("raise SystemExit('a file of the current folder is run')", encoding="utf-8")
    return tmp_path


def test_the_command_works_in_a_folder_with_our_names(installed, crowded):
    assert run([str(installed / "colorphase"), "--version"], crowded).stdout == f"{colorphase.__version__}\n"
    assert "decode" in run([str(installed / "colorphase"), "--help"], crowded).stdout
    assert "cpu" in run([str(installed / "colorphase"), "devices"], crowded).stdout


def test_the_package_runs_as_a_module(installed, tmp_path):
    """In the wheel, and in a clone or an editable install, where it is a single file."""
    for folder, python in ((tmp_path, installed / "python"), (ROOT, sys.executable)):
        module = [str(python), "-m", "colorphase"]
        assert run([*module, "--version"], folder).stdout == f"{colorphase.__version__}\n"
        assert "Usage: colorphase COMMAND" in run([*module, "--help"], folder).stdout
    program = "from colorphase import *; import colorphase; print(Decoder.__name__, colorphase.__version__)"
    assert run([str(installed / "python"), "-c", program], tmp_path).stdout == f"Decoder {colorphase.__version__}\n"


def test_the_import_works_or_one_line_names_the_file_in_its_way(installed, crowded):
    where = "import colorphase, os; print(os.path.dirname(colorphase.__file__))"
    elsewhere = crowded / "elsewhere"
    elsewhere.mkdir()
    found = run([str(installed / "python"), "-c", where], elsewhere).stdout.strip()
    assert Path(found).is_relative_to(installed.parent)
    # `-P` keeps the current folder off the path.
    assert run([str(installed / "python"), "-P", "-c", where], crowded).stdout.strip() == found
    tried = "try: import colorphase\nexcept ImportError as error: print(error)"
    for name in ("pipeline.py", "hardware.py"):
        said = run([str(installed / "python"), "-c", tried], crowded).stdout
        package = name.removesuffix(".py")
        assert said == f"{crowded / name} is in the way of colorphase's own package {package}: rename it\n"
        (crowded / name).unlink()
    assert run([str(installed / "python"), "-c", where], crowded).stdout.strip() == found


def test_a_package_and_a_module_that_is_loaded_are_named_too(installed, tmp_path):
    (tmp_path / "hardware").mkdir()
    (tmp_path / "hardware" / "__init__.py").write_text("", encoding="utf-8")
    tried = "import hardware\ntry: import colorphase\nexcept ImportError as error: print(error)"
    said = run([str(installed / "python"), "-c", tried], tmp_path).stdout
    file = tmp_path / "hardware" / "__init__.py"
    assert said == f"{file} is in the way of colorphase's own package hardware: rename it\n"


def test_type_checkers_see_the_public_names(installed, tmp_path):
    """The checker follows the names into the installed packages: what they are is known, and a mistake is found.

    A strict one finds nothing else wrong with a program that uses them.
    """
    pytest.importorskip("mypy")
    names = sorted(colorphase.__all__)
    program = (Path(__file__).parent / "typed_program.py").read_text(encoding="utf-8")
    lines = [program, *(f"reveal_type(colorphase.{name})" for name in names), "colorphase.init(1)"]
    (tmp_path / "program.py").write_text("\n".join(lines), encoding="utf-8")
    mypy = [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(installed / "python")]
    quiet = {"capture_output": True, "text": True, "timeout": 240, "check": False}
    said = subprocess.run([*mypy, "--no-incremental", "program.py"], cwd=tmp_path, **quiet).stdout.splitlines()
    told = [line.partition("Revealed type is ")[2] for line in said if "Revealed type is" in line]
    assert len(told) == len(names) and '"Any"' not in told, said
    errors = [line for line in said if ": error:" in line]
    assert len(errors) == 1 and "incompatible type" in errors[0], errors


def test_an_editable_install_has_it_too(tmp_path):
    """What such an install adds to the path is the project's folder, where the file is."""
    build = f"from hatchling.build import build_editable; print(build_editable({str(tmp_path)!r}))"
    wheel = run([sys.executable, "-c", build], ROOT).stdout.split()[-1]
    run([sys.executable, "-m", "zipfile", "-e", str(tmp_path / wheel), str(tmp_path / "unpacked")], tmp_path)
    (added,) = (tmp_path / "unpacked").glob("*.pth")
    assert added.read_text(encoding="utf-8").split() == [str(ROOT)]
    assert (ROOT / "colorphase.py").exists()
    assert not list((tmp_path / "unpacked").glob("colorphase/*"))
