"""Which module imports which, read from the sources: ranks, circles, and rooms (sub-packages, modules beside them)."""

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

PACKAGES = ("tikernels", "pipeline", "hardware")

Graph = Mapping[str, set[str]]


def module_paths(root: Path) -> dict[str, Path]:
    """Return the file of every module of the three packages, which lie in a folder."""
    found = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def tree(path: Path) -> ast.Module:
    """Return what a file is parsed to."""
    return ast.parse(path.read_text(encoding="utf-8"))


def statements(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """Yield the imports of a file that are carried out, inside functions too."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            yield from (found for part in node.orelse for found in statements(part))
        else:
            yield from statements(node)


@cache
def _imports(path: Path) -> tuple[ast.Import | ast.ImportFrom, ...]:
    return tuple(statements(tree(path)))


def imported_modules(name: str, path: Path, modules: Mapping[str, Path]) -> set[str]:
    """Return which of our modules a module imports."""
    found = set()
    for node in _imports(path):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            above = name.split(".")[: len(name.split(".")) - node.level + (path.stem == "__init__")]
            base = ".".join([*(above if node.level else []), *([node.module] if node.module else [])])
            names = [f"{base}.{a.name}" if f"{base}.{a.name}" in modules else base for a in node.names]
        found |= {imported for imported in names if imported in modules and imported != name}
    return found


def room_of(name: str, modules: Mapping[str, Path]) -> str:
    """Return the sub-package of a module, or the module itself where it lies beside them."""
    room = ".".join(name.split(".")[:2])
    return room if room in modules else name


def rooms_of(graph: Graph, modules: Mapping[str, Path]) -> dict[str, set[str]]:
    """Return which rooms each room imports from."""
    rooms: dict[str, set[str]] = {room_of(name, modules): set() for name in graph}
    for name, imported in graph.items():
        here = room_of(name, modules)
        rooms[here] |= {room_of(other, modules) for other in imported} - {here}
    return rooms


def circles(graph: Graph) -> list[set[str]]:
    """Return the sets of nodes that can be reached from each other, those of a single node left out."""
    reached = {node: below(graph, node) for node in graph}
    sets = {frozenset(other for other in reached[node] if node in reached[other]) for node in graph}
    return [set(nodes) for nodes in sorted(sets, key=sorted) if len(nodes) > 1]


def below(graph: Graph, node: str) -> set[str]:
    """Return all that can be reached from a node."""
    found: set[str] = set()
    waiting = [node]
    while waiting:
        new = graph[waiting.pop()] - found
        found |= new
        waiting += new
    return found


def ranks_of(graph: Graph) -> dict[str, int]:
    """Return the longest chain below every node; the nodes of a circle count as one."""
    circle_of = {node: circle for circle in circles(graph) for node in circle}

    @cache
    def rank(node: str) -> int:
        circle = circle_of.get(node, {node})
        return max((1 + rank(to) for member in circle for to in graph[member] - circle), default=0)

    return {node: rank(node) for node in graph}
