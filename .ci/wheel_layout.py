"""How the wheel is put together, for Hatchling."""

from typing import Any

from hatchling.builders.config import BuilderConfig
from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class WheelLayout(BuildHookInterface[BuilderConfig]):
    """Makes a package of `colorphase.py`: type checkers find `py.typed` beside a package only, not beside a module.

    Editable installs go without: a copy in there would be found in place of the file that is edited.
    """

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Put both into a wheel that is not an editable one."""
        if version == "standard":
            build_data["force_include"] = {
                "colorphase.py": "colorphase/__init__.py",
                ".ci/py.typed": "colorphase/py.typed",
            }
