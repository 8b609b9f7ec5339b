"""The backends that kernels run on, and what every host function must refuse."""

import os
import signal
import warnings
from collections.abc import Callable
from typing import Any

# Before NumPy comes: its BLAS splits even small matrices over threads that wait for each other, which takes many times
# as long as one thread does, most of all on a busy machine. Processes that tests start inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import numpy.typing as npt
import pytest
from support.missing import skip_but_fail_in_ci

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # Taichi's own, once, while it is imported
    from support.array_forms import every_second, on_device, read_only
    from support.kernel_cache import write_kernels

    import tikernels


def pytest_configure() -> None:
    """Hear Ctrl-C even where a shell has started the tests in its background: what they start inherits that it does."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


#: Tests that run on Vulkan, too, without `long`, after the first one of each file in `tests/unit/tikernels`: a frame.
ON_VULKAN = {"test_accuracy_on_every_scene"}


def on_vulkan(item: pytest.Item) -> bool:
    """Whether a test asks for Vulkan."""
    callspec = getattr(item, "callspec", None)
    return callspec is not None and callspec.params.get("arch") == "vulkan"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run what needs no GPU first: starting another device drops all buffers and compiled kernels.

    Software Vulkan compiles and computes many times slower than the CPU, so all but a core set of its tests is long.
    """
    seen = set()
    for item in filter(on_vulkan, items):
        file, _, test = item.nodeid.partition("[")[0].partition("::")
        if file in seen or not (file.startswith("tests/unit/tikernels") or test in ON_VULKAN):
            item.add_marker("long")
        else:
            seen.add(file)
    items.sort(key=on_vulkan)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Start the CPU again for what does not say where it runs, if a test on another device was the last one here."""
    if "arch" not in getattr(item, "fixturenames", ()) and tikernels.runtime.is_started():
        tikernels.init("cpu")


@pytest.fixture(scope="session")
def cpu() -> str:
    """Start the CPU; `arch` is for what runs on every backend."""
    return tikernels.init("cpu")


@pytest.fixture(scope="session")
def kernels_on_disk() -> None:
    """Write the kernels that decode to the disk, where processes that a test starts find them."""
    write_kernels()


@pytest.fixture(params=["cpu", "vulkan"])
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
