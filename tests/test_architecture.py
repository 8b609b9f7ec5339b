"""Who may import whom, and that importing does nothing else."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("tikernels", "pipeline", "hardware")
LANGUAGES = {"taichi", "quadrants"}
#: Heavy, or only needed by some: taken where they are used.
LATE = (
    "pyvista",
    "vtkmodules",
    "zarr",
    "skimage",
    "scipy",
    "dask",
    "distributed",
    "fsspec",
    "numcodecs",
    "av",
    "pygame",
    "pypylon",
)


def sources(package: str) -> list[Path]:
    found = sorted((ROOT / package).rglob("*.py"))
    assert found, f"{package} has no sources"
    return found


def imports(path: Path) -> Iterator[str]:
    """Yield the full name of every module that a file imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__"):
            # A name that is not spelled out could be any; only the file that chooses the language may, and the one
            # that imports drivers by the names in its table and in rig.toml.
            if isinstance(node.args[0], ast.Constant):
                yield node.args[0].value
            elif path != ROOT / "hardware" / "drivers.py":
                yield "taichi"


def imported(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


@pytest.mark.parametrize("package", PACKAGES)
def test_one_file_takes_the_kernel_language(package):
    takers = {path.relative_to(ROOT).as_posix() for path in sources(package) if imported(path) & LANGUAGES}
    assert takers == ({"tikernels/_taichi.py"} if package == "tikernels" else set())


@pytest.mark.parametrize(
    "package, allowed",
    [("tikernels", {"tikernels"}), ("hardware", {"hardware"}), ("pipeline", {"tikernels", "hardware", "pipeline"})],
)
def test_imports_run_one_way(package, allowed):
    for path in sources(package):
        assert imported(path) & {*PACKAGES, "tests"} <= allowed, path


def test_the_kernel_language_stays_in_its_package():
    """Outside `tikernels` nobody takes `ti` through the back door."""
    for package in ("pipeline", "hardware"):
        for path in sources(package):
            assert "tikernels._taichi" not in set(imports(path)), path


def test_peers_are_no_dependencies():
    """SciPy and scikit-image stand beside us in tests and benchmarks only."""
    for package in PACKAGES:
        for path in sources(package):
            assert not imported(path) & {"scipy", "skimage"}, path


@pytest.mark.parametrize("module", ["colorphase", *PACKAGES, "pipeline.cli.main"])
def test_importing_does_nothing_else(module):
    """It prints nothing, starts no device and loads nothing heavy."""
    program = (
        f"import sys, {module}\n"
        f"late = sorted({set(LATE)!r} & {{name.split('.')[0] for name in sys.modules}})\n"
        "runtime = sys.modules.get('tikernels.runtime')\n"
        "if late: sys.exit(f'it loads {late}')\n"
        "if runtime and runtime.is_started(): sys.exit('it starts a device')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
