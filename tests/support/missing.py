"""What becomes of a test that needs what this machine lacks."""

import importlib
import os
from typing import Any, NoReturn

import pytest


def skip_but_fail_in_ci(reason: str) -> NoReturn:
    """Skip the test; CI installs all that tests need, so there it fails."""
    if os.environ.get("CI") == "true":
        pytest.fail(f"{reason}, and CI must not skip it")
    pytest.skip(reason, allow_module_level=True)


def import_but_fail_in_ci(module: str) -> Any:
    """Return a module of the extra `test`; where it is not installed, skip the test, and in CI fail it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        skip_but_fail_in_ci(f"{module} is not installed: pip install 'colorphase[test]'")
