"""Names of a package that are imported when they are first used (PEP 562)."""

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def lazily(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the `__getattr__` and `__dir__` of a package whose `__all__` is imported name by name.

    Where each name lies is written once: in the package's `if TYPE_CHECKING:` block, which type checkers read, too.
    """
    namespace = vars(sys.modules[package])
    origins: dict[str, str] = {}

    def get(name: str) -> Any:
        if name not in namespace["__all__"]:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if not origins:
            tree = ast.parse(Path(namespace["__file__"]).read_text(encoding="utf-8"))
            (block,) = (node for node in tree.body if isinstance(node, ast.If) and "CHECKING" in ast.unparse(node.test))
            imports = (node for node in block.body if isinstance(node, ast.ImportFrom))
            origins.update((alias.name, str(node.module)) for node in imports for alias in node.names)
        namespace[name] = found = getattr(import_module(origins[name]), name)
        return found

    def names() -> list[str]:
        return sorted({*namespace, *namespace["__all__"]})

    return get, names
