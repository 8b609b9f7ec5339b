"""The backends that kernels run on, and what every host function must refuse."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from support.missing import skip_but_fail_in_ci

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # Taichi's own, once, while it is imported
    from support.array_forms import every_second, on_device, read_only

    import tikernels


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run what needs no GPU first: starting another device drops all buffers and compiled kernels."""

    def on_gpu(item: pytest.Item) -> bool:
        callspec = getattr(item, "callspec", None)
        return callspec is not None and callspec.params.get("arch") == "vulkan"

    items.sort(key=on_gpu)


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
