"""The devices that kernels run on, and what every host function must refuse."""

import os
import signal
import sys
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

from support.kernel_cache import fill_kernel_cache, kernel_settings

# Before NumPy is imported: its BLAS splits even small matrices over threads that wait for each other, which takes many
# times as long as one thread does, most of all on a busy machine. Processes that tests start inherit all this.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Software Vulkan compiles kernels in half the time for narrower vectors and without optimising; each runs a few times.
os.environ.setdefault("LP_NATIVE_VECTOR_WIDTH", "128")
os.environ.setdefault("GALLIVM_PERF", "nopt")
# Without bytecode each process compiles the project's Python anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ.update({name: os.environ.get(name, value) for name, value in kernel_settings().items()})

import numpy as np
import numpy.typing as npt
import pytest
from support.missing import skip_but_fail_in_ci

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # Taichi's own, once, while it is imported
    from support.array_forms import every_second, on_device, read_only

    import tikernels
    from tikernels import runtime

#: What runs on Vulkan without --every-arch, next to the first test of each folder in `tests/unit/tikernels`: a frame.
ON_VULKAN = {"test_accuracy_on_every_scene"}


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that tests every kernel on Vulkan."""
    parser.addoption(
        "--every-arch", action="store_true", help="run all tests of kernels on Vulkan, and on CUDA or Metal if present"
    )


def pytest_configure() -> None:
    """Hear Ctrl-C even where a shell has started the tests in its background; children inherit this."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.dont_write_bytecode = False


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels that decode before several processes begin, which otherwise all do it."""
    if session.config.getoption("numprocesses", None) and not session.config.getoption("collectonly"):
        fill_kernel_cache()


def pytest_collection_finish(session: pytest.Session) -> None:
    """Compile them before the first test whose processes need them, so that no test's limit of time includes it."""
    if any("kernels_on_disk" in getattr(item, "fixturenames", ()) for item in session.items):
        if not session.config.getoption("collectonly"):
            fill_kernel_cache()


def pytest_sessionfinish() -> None:
    """Write the kernels that this process has compiled, for the next run."""
    runtime.stop()


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run tests of kernels on the CPU, on Vulkan, and on what else there is here, unless they choose themselves."""
    chosen = (mark.args[0] for mark in metafunc.definition.iter_markers("parametrize"))
    if "arch" in metafunc.fixturenames and "arch" not in chosen:
        metafunc.parametrize("arch", tested_archs(metafunc.config.getoption("every_arch")), indirect=True)


@cache
def tested_archs(every: bool) -> list[str]:
    """Return what tests of kernels run on; what there is here takes long to tell."""
    others = {"cuda", "metal"}.intersection(tikernels.supported_archs()) if every else ()
    return ["cpu", "vulkan", *sorted(others)]


def on_gpu(item: pytest.Item) -> str:
    """Return the arch that a test runs on if it is not the CPU, or nothing."""
    callspec = getattr(item, "callspec", None)
    arch = callspec.params.get("arch", "cpu") if callspec is not None else "cpu"
    return "" if arch == "cpu" else str(arch)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run what needs no GPU first: starting another device drops all buffers and compiled kernels.

    Software Vulkan compiles and computes many times slower than the CPU: all but a core set of its tests is optional.
    """
    chosen, omitted, seen = [], [], set()
    for item in items:
        file, _, test = item.nodeid.partition("[")[0].partition("::")
        room = file.rpartition("/")[0]
        first = room not in seen and (room.startswith("tests/unit/tikernels") or test in ON_VULKAN)
        if not on_gpu(item) or config.getoption("every_arch") or first:
            chosen.append(item)
        else:
            omitted.append(item)
        if on_gpu(item):
            item.add_marker(pytest.mark.timeout(1500))  # software Vulkan compiles a frame's kernels for minutes
            if first:
                seen.add(room)
    config.hook.pytest_deselected(items=omitted)
    items[:] = sorted(chosen, key=on_gpu)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give each process whole files, whose tests share frames and kernels, and one of them what little is Vulkan's.

    Acceptance tests are long, and share little; so are all those of Vulkan together.
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file, _, test = nodeid.partition("::")
            if "vulkan" in test.partition("[")[2]:
                return nodeid if config.getoption("every_arch") else "vulkan"
            return nodeid if file.startswith("tests/acceptance") else file

    return ByFile(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Start the CPU again for what does not say where it runs, if a test on another device was the last one here."""
    if "arch" not in getattr(item, "fixturenames", ()) and runtime.is_started():
        tikernels.init("cpu")


@pytest.fixture(scope="session")
def cpu() -> str:
    """Start the CPU; `arch` is for what runs on every backend."""
    return tikernels.init("cpu")


@pytest.fixture(scope="session")
def kernels_on_disk() -> None:
    """Have the kernels that decode on disk, for processes that a test starts; the session compiles them."""


@pytest.fixture
def arch(request: pytest.FixtureRequest) -> str:
    """Start a backend. CI installs a software Vulkan, so there a missing one is a failure and never skipped."""
    name = str(request.param)
    if name not in tikernels.supported_archs():
        skip_but_fail_in_ci(f"this machine has no {name} driver")
    return tikernels.init(name)


@pytest.fixture
def menu(arch: str) -> Callable[..., None]:
    """Return the check that every host function passes: what it must take, and what it must refuse."""

    def check(call: Callable[..., Any], out: npt.NDArray[Any] | None = None, /, **inputs: npt.NDArray[Any]) -> None:
        expected = np.array(call(**inputs))
        for name, array in inputs.items():
            before = array.copy()
            for variant in (every_second(array), read_only(array), on_device(array)):
                np.testing.assert_array_equal(call(**{**inputs, name: variant}), expected, err_msg=name)
            np.testing.assert_array_equal(array, before, err_msg=f"{name} was written to")
            for bad in (array.astype(np.complex64), array[None], array[..., :-1], array[:0], array.tolist()):
                with pytest.raises(tikernels.ShapeError, match=r"has shape|is .*, expected|is empty|is a "):
                    call(**{**inputs, name: bad})
        if out is not None:
            assert call(**inputs, out=out) is out
            np.testing.assert_array_equal(out, expected)
            for bad in (out.astype(np.float64), out[:-1], out[None], every_second(out), read_only(out), out.tolist()):
                with pytest.raises(tikernels.ShapeError):
                    call(**inputs, out=bad)

    return check
