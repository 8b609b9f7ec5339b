"""How the wheel is put together, for Hatchling."""

from typing import Any

from hatchling.builders.config import BuilderConfig
from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class WheelLayout(BuildHookInterface[BuilderConfig]):
    """Makes a package of `colorphase.py`: type checkers find `py.typed` in a package only, not next to a module.

    ``python -m colorphase`` then runs its `__main__`. Editable installs go without: a copy in there would be found in
    place of the file that is edited.
    """

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Put both into a wheel that is not an editable one."""
        if version == "standard":
            build_data["force_include"] = {
                "colorphase.py": "colorphase/__init__.py",
                ".ci/__main__.py": "colorphase/__main__.py",
                ".ci/py.typed": "colorphase/py.typed",
            }
