"""Who may import whom, and that importing does nothing else."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from support.import_graph import circles, imported_modules, module_paths, room_of, tree

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("tikernels", "pipeline", "hardware")
#: The rooms of each package, from the ground up: one imports those to the left of it, and what lies in it.
FLOORS = {
    "tikernels": (
        "errors lazy_names _front_end _taichi traffic launching arrays lanes file_lock compiled_kernels "
        "runtime checks strips transposing raw phase depth unwrapping order_evidence scene"
    ),
    "pipeline": (
        "errors text causes showing limits linear_algebra models settings robust files locking processes zarr_chunks "
        "footage recording calibration contrast_code pattern decoding orders decoder simulation planning output "
        "diagnosis batch acquisition view verification cli"
    ),
    "hardware": (
        "errors models plugins drivers settings pulses protocols link display colour_cycle run_start pairing pulse_run "
        "alternating_pictures timing simulated camera trigger projector instruments rig"
    ),
}
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
    "matplotlib",
    "xarray",
    "jinja2",
)


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree(path)))


@cache
def sources(package: str) -> list[Path]:
    found = sorted((ROOT / package).rglob("*.py"))
    assert found, f"{package} has no sources"
    return found


@cache
def imports(path: Path) -> tuple[str, ...]:
    """Return the full name of every module that a file imports, inside functions too."""
    return tuple(named_in(path))


def named_in(path: Path) -> Iterator[str]:
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__"):
            # A name that is not spelled out could be any; only the file that chooses the language may, the one that
            # imports drivers by the names in its table and in rig.toml, and the one that imports a package's names.
            if isinstance(node.args[0], ast.Constant):
                yield node.args[0].value
            elif path.name not in ("plugins.py", "lazy_names.py"):
                yield "taichi"


def imported(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


@pytest.mark.parametrize("package", PACKAGES)
def test_two_files_take_the_kernel_language(package):
    takers = {path.relative_to(ROOT).as_posix() for path in sources(package) if imported(path) & LANGUAGES}
    assert takers == ({"tikernels/_front_end.py", "tikernels/_taichi.py"} if package == "tikernels" else set())


@pytest.mark.parametrize(
    "package, allowed",
    [
        ("tikernels", {"tikernels"}),
        ("hardware", {"hardware", "tikernels"}),
        ("pipeline", {"tikernels", "hardware", "pipeline"}),
    ],
)
def test_imports_run_one_way(package, allowed):
    for path in sources(package):
        assert imported(path) & {*PACKAGES, "tests"} <= allowed, path


def test_the_rig_takes_errors_and_lazy_names_from_the_kernels_and_nothing_else():
    ours = {name for path in sources("hardware") for name in imports(path) if name.split(".")[0] == "tikernels"}
    assert ours == {"tikernels.errors", "tikernels.lazy_names"}
    for name in ours:  # which import nothing of ours
        assert not imported(ROOT / f"{name.replace('.', '/')}.py") & {*PACKAGES}


@pytest.mark.parametrize("package", PACKAGES)
def test_no_import_runs_up(package):
    """From room to room; a package's own face imports from all of them."""
    modules = module_paths(ROOT)
    floors = {f"{package}.{room}": floor for floor, room in enumerate(FLOORS[package].split())}
    rooms = {room_of(name, modules) for name in modules if name.startswith(f"{package}.")}
    assert rooms == floors.keys()
    for name in modules:
        here = room_of(name, modules)
        for other in imported_modules(name, modules[name], modules):
            there = room_of(other, modules)
            if here in floors and there in floors:
                assert floors[there] <= floors[here], f"{name} imports {other}, which lies above it"


def test_no_imports_run_in_a_circle():
    modules = module_paths(ROOT)
    assert circles({name: imported_modules(name, path, modules) for name, path in modules.items()}) == []


def test_the_kernel_language_stays_in_its_package():
    """Outside `tikernels` nobody takes `ti` through the back door."""
    for package in ("pipeline", "hardware"):
        for path in sources(package):
            assert "tikernels._taichi" not in set(imports(path)), path


def test_only_host_functions_launch_kernels():
    """They check their arguments, which kernels do not."""
    for package in ("pipeline", "hardware"):
        for path in sources(package):
            for node in nodes(path):
                if isinstance(node, ast.ImportFrom):
                    assert not [name.name for name in node.names if name.name.endswith("_kernel")], path


def levels_below(node: ast.AST) -> int:
    """Return how deep loops and conditions are nested in a function, those of functions inside it left out."""
    nested = (ast.For, ast.While, ast.If, ast.With, ast.Try)
    inside = [child for child in ast.iter_child_nodes(node) if not isinstance(child, ast.FunctionDef | ast.Lambda)]
    return max((levels_below(child) + isinstance(child, nested) for child in inside), default=0)


def test_kernels_are_held_in_the_head():
    """None is longer than 80 lines or nested deeper than five levels."""
    for path in sources("tikernels"):
        for node in nodes(path):
            decorators = {ast.unparse(name) for name in getattr(node, "decorator_list", [])}
            if isinstance(node, ast.FunctionDef) and decorators & {"kernel", "ti.func"}:
                assert (node.end_lineno or 0) - node.lineno < 80, (path, node.name)
                assert levels_below(node) <= 5, (path, node.name)


def test_peers_are_no_dependencies():
    """SciPy and scikit-image stand beside us in tests and benchmarks only."""
    for package in PACKAGES:
        for path in sources(package):
            assert not imported(path) & {"scipy", "skimage"}, path


def test_two_files_start_processes():
    """One for all, and one that imports none of ours; both leave the working folder out of Python's path."""
    starting = ("subprocess.", "os.system", "os.popen", "os.spawn", "os.exec", "os.fork")
    takers = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in sources(package)
        for node in nodes(path)
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith(starting)
    }
    assert takers == {"pipeline/processes.py", "hardware/display.py"}
    spawning = {path.name for package in PACKAGES for path in sources(package) if "multiprocessing" in imported(path)}
    assert spawning == {"processes.py", "live.py"}
    assert '"-P"' in (ROOT / "hardware" / "display.py").read_text(encoding="utf-8")


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


def test_only_who_looks_imports_the_viewer():
    commands = [path.stem for path in sources("pipeline") if path.parent.name == "cli" and path.stem != "view"]
    source = "import sys, colorphase\n" + "".join(f"import pipeline.cli.{name}\n" for name in commands)
    source += "assert not [name for name in sys.modules if name.startswith('pipeline.view')]"
    done = subprocess.run([sys.executable, "-c", source], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
