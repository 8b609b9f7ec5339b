"""Drivers and formats that installed packages announce by entry points; nothing is imported until it is chosen."""

import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from importlib.metadata import entry_points
from operator import attrgetter
from typing import Any

from tikernels.errors import Error


@dataclass(frozen=True)
class Plugin:
    """An object that a package announces."""

    place: str  # module:name
    package: str | None = None  # its name and version; None: a module that the user has named

    def __str__(self) -> str:
        return self.place if self.package is None else f"{self.place} of the package {self.package}"


def announced(group: str) -> Mapping[str, tuple[Plugin, ...]]:
    """Return what installed packages announce in a group of entry points, by name; several may have the same one."""
    return _announced(group, tuple(sys.path))


@lru_cache(maxsize=8)  # reading takes about 10 ms for hundreds of packages
def _announced(group: str, _path: tuple[str, ...]) -> Mapping[str, tuple[Plugin, ...]]:
    found: dict[str, tuple[Plugin, ...]] = {}
    # Folders are read in any order.
    for entry in sorted(entry_points(group=group), key=lambda entry: (entry.name, entry.value)):
        package = "unknown" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
        found[entry.name] = (*found.get(entry.name, ()), Plugin(entry.value, package))
    return found


def plugin_of(group: str, name: str, built_in: Collection[str], error: type[Error]) -> Plugin | None:
    """Return what is announced under a name; None where nothing is.

    Raises
    ------
    Error
        Of the given type: several packages announce the name, or it is one of the built-in ones.
    """
    found = announced(group).get(name, ())
    packages = " and ".join(sorted(str(plugin.package) for plugin in found))
    if found and name in built_in:
        raise error(f"{packages} announces {name!r} in {group}, which is a built-in name: uninstall that package")
    if len(found) > 1:
        raise error(f"{packages} both announce {name!r} in {group}: uninstall one of them")
    return found[0] if found else None


def load(key: str, plugin: Plugin, error: type[Error]) -> Any:
    """Import an object; `key` is what messages name as its source.

    Raises
    ------
    Error
        Of the given type: it cannot be imported, or is not there.
    """
    module_name, _, name = plugin.place.partition(":")
    source = module_name if plugin.package is None else f"{module_name} of the package {plugin.package}"
    cure = "correct it" if plugin.package is None else "update that package, or uninstall it"
    try:
        module = import_module(module_name)
    except Exception as fault:  # a user's module may raise anything
        if isinstance(fault, ModuleNotFoundError) and plugin.package is None:
            cure = "install it, or put its folder on PYTHONPATH"
        raise error(f"{key}: {source} cannot be imported ({described(fault)}): {cure}") from fault
    try:
        return attrgetter(name)(module)
    except AttributeError:
        file = getattr(module, "__file__", "built in")
        raise error(f"{key}: {source} ({file}) has no {name or 'name after a colon'}: {cure}") from None


def described(error: Exception) -> str:
    """Return an error's type and message in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split()) or 'it does not say why'}"
