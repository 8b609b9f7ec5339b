"""The ranks of all modules, and how often the way of one frame to its mesh goes from a lower rank to a higher one.

python tests/benchmarks/ranks.py [--figure docs/ranks.svg]

A module's rank is its longest chain of imports below it, those inside functions included, those for type checkers only
not. One simulated frame is then followed from `Decoder.decode` to a written mesh, and through the command. A call
climbs if it goes from a module to one of higher rank; library code between two of our modules is passed over. Kernels
are not seen: what they call is compiled into them. The figure shows the rooms (sub-packages, and modules beside them)
by rank.
"""

import argparse
import ast
import contextlib
import importlib
import io
import sys
import tempfile
import threading
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import matplotlib
import numpy as np

matplotlib.use("svg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("tikernels", "pipeline", "hardware")

Graph = Mapping[str, set[str]]


def module_paths() -> dict[str, Path]:
    """Return the file of every module of the three packages."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def statements(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """Yield the imports of a file that are carried out, inside functions too."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            yield from (found for part in node.orelse for found in statements(part))
        else:
            yield from statements(node)


def imported_modules(name: str, path: Path, modules: Mapping[str, Path]) -> set[str]:
    """Return which of our modules a module imports."""
    found = set()
    for node in statements(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            above = name.split(".")[: len(name.split(".")) - node.level + (path.stem == "__init__")]
            base = ".".join([*(above if node.level else []), *([node.module] if node.module else [])])
            names = [f"{base}.{a.name}" if f"{base}.{a.name}" in modules else base for a in node.names]
        found |= {imported for imported in names if imported in modules and imported != name}
    return found


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


class Route:
    """The calls between our modules, as Python's profiler sees them."""

    def __init__(self, ranks: Mapping[str, int]) -> None:
        self._ranks = ranks
        #: Modules in the order in which they are entered.
        self.entered: dict[str, None] = {}
        #: How often one function calls another of another module: (caller, callee) by module and name.
        self.calls: Counter[tuple[tuple[str, str], tuple[str, str]]] = Counter()

    def watch(self, frame: FrameType, event: str, _: object) -> None:
        """Note a call; for `sys.setprofile`."""
        here = self._place(frame)
        if event != "call" or here is None:
            return
        self.entered.setdefault(here[0])
        caller = frame.f_back
        while caller is not None:
            there = self._place(caller)
            if there is not None:
                if there[0] != here[0]:
                    self.calls[there, here] += 1
                return
            caller = caller.f_back

    def climbs(self) -> list[tuple[tuple[str, str], tuple[str, str], int]]:
        """Return the calls to a higher rank, and how often each happens."""
        rank = self._ranks
        return [(a, b, count) for (a, b), count in self.calls.items() if rank[a[0]] < rank[b[0]]]

    def _place(self, frame: FrameType) -> tuple[str, str] | None:
        name = frame.f_globals.get("__name__")
        return (name, frame.f_code.co_qualname) if name in self._ranks else None


def defined(name: str, modules: Mapping[str, Path]) -> Any:
    """Return the function or constant of this name, wherever it is defined."""
    for module, path in modules.items():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            targets = node.targets if isinstance(node, ast.Assign) else []
            if getattr(node, "name", None) == name or any(ast.unparse(target) == name for target in targets):
                return getattr(importlib.import_module(module), name)
    raise SystemExit(f"no module defines {name}: tell this program what it is called now")


def watched(call: Callable[[], object], ranks: Mapping[str, int]) -> Route:
    """Return the route of a call that has been made before: kernels are compiled then, and late imports loaded."""
    call()
    route = Route(ranks)
    sys.setprofile(route.watch)
    threading.setprofile(route.watch)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return route


def follow_frames(modules: Mapping[str, Path], ranks: Mapping[str, int]) -> Iterator[tuple[str, Route]]:
    """Yield the routes of a simulated frame: from `Decoder.decode` to its mesh, and through the command."""
    from pipeline import Decoder, DecodeSettings

    simulated_rig, simulate_frame = defined("simulated_rig", modules), defined("simulate_frame", modules)
    frame_mesh, write_mesh = defined("frame_mesh", modules), defined("write_mesh", modules)
    matrix = defined("TYPICAL_CROSSTALK", modules)
    rig = simulated_rig().model_copy(update={"crosstalk_matrix": np.array(matrix)})
    decoder = Decoder(DecodeSettings(), rig, arch="cpu")
    image = simulate_frame(rig).image
    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / "mesh.ply"
        yield "Decoder.decode to mesh", watched(lambda: write_mesh(frame_mesh(decoder.decode(image)), mesh), ranks)
        picture, calibration = Path(folder) / "picture.png", Path(folder) / "calibration.json"
        cv2.imwrite(str(picture), image[..., ::-1])
        rig.write(calibration)
        arguments = ["decode", picture, "--out", Path(folder) / "out", "--calibration", calibration, "--arch", "cpu"]
        yield "the command `colorphase decode`", watched(lambda: run_command(*map(str, arguments)), ranks)


def run_command(*arguments: str) -> None:
    """Run the command line in this process, silently."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    module, _, name = scripts["colorphase"].partition(":")
    before, sys.argv = sys.argv, ["colorphase", *arguments]
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
            getattr(importlib.import_module(module), name)()
    finally:
        sys.argv = before


def print_route(name: str, route: Route, ranks: Mapping[str, int]) -> None:
    """Print the modules that a frame goes through, and the calls that climb."""
    print(f"\n{name}: {len(route.entered)} modules entered")
    for module in route.entered:
        print(f"  {ranks[module]:3d}  {module}")
    climbs = route.climbs()
    print(f"calls from module to module: {route.calls.total()}")
    print(f"calls to a higher rank: {sum(count for *_, count in climbs)}, between {len(climbs)} pairs of functions")
    for (caller, function), (callee, called), count in climbs:
        print(f"  {ranks[caller]:3d} {caller}.{function} -> {ranks[callee]} {callee}.{called}, {count} times")


# The figure's columns, one a package; a line of text, a box's width and the gaps, in inches.
_LINE, _BOX, _GAP_X, _GAP_Y = 0.16, 1.68, 0.14, 0.32
_COLOURS = {"tikernels": "#dbe9f6", "pipeline": "#fdebd0", "hardware": "#e3f1df"}


def draw(path: Path, modules: Mapping[str, Path], ranks: Mapping[str, int], rooms: Graph) -> None:
    """Draw the rooms by rank, packages side by side, with an arrow for every import that no longer way implies."""
    alone = {room for room in rooms if not rooms[room] and not any(room in others for others in rooms.values())}
    rooms = {room: others for room, others in rooms.items() if room not in alone}
    heights = ranks_of(rooms)
    inside = {
        room: sorted((n for n in modules if room_of(n, modules) == room), key=lambda n: (-ranks[n], n))
        for room in rooms
    }
    lines = {room: 1 + sum(name != room for name in inside[room]) for room in rooms}
    rows = sorted(set(heights.values()))
    places = arranged(rooms, heights)
    widths = {p: max([len(places[p, row]) for row in rows if (p, row) in places]) for p in PACKAGES}
    left = {}
    x = 0.0
    for package in sorted(PACKAGES, key=["hardware", "pipeline", "tikernels"].index):
        left[package] = x
        x += widths[package] * (_BOX + _GAP_X) + 0.5
    boxes: dict[str, tuple[float, float, float]] = {}  # left, bottom, height
    y = 0.0
    for row in rows:
        tall = max(lines[room] for room in rooms if heights[room] == row) * _LINE + 0.1
        for package in PACKAGES:
            here = places.get((package, row), [])
            start = left[package] + (widths[package] - len(here)) * (_BOX + _GAP_X) / 2
            for column, room in enumerate(here):
                height = lines[room] * _LINE + 0.1
                boxes[room] = (start + column * (_BOX + _GAP_X), y + (tall - height) / 2, height)
        y += tall + _GAP_Y
    figure = plt.figure(figsize=(x, y + 0.3))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-0.15, x - 0.15), ylim=(-0.15, y + 0.15))
    axes.set_axis_off()
    for room, (box_x, box_y, height) in boxes.items():
        package = room.split(".")[0]
        shape = FancyBboxPatch((box_x, box_y), _BOX, height, boxstyle="round,pad=0,rounding_size=0.06", zorder=3)
        shape.set(facecolor=_COLOURS[package], edgecolor="#555555", linewidth=0.7)
        axes.add_patch(shape)
        title = {"fontsize": 9, "fontweight": "bold", "va": "center", "zorder": 4}
        text_y = box_y + height - 0.05 - _LINE / 2
        single = inside[room] == [room]
        axes.text(box_x + 0.06, text_y, room.split(".", 1)[-1] + (f"  {ranks[room]}" if single else "/"), **title)
        for number, name in enumerate([n for n in inside[room] if n != room], 1):
            short = name.removeprefix(room + ".")
            axes.text(box_x + 0.06, text_y - number * _LINE, short, fontsize=8, va="center", zorder=4)
            axes.text(
                box_x + _BOX - 0.06, text_y - number * _LINE, ranks[name], fontsize=8, ha="right", va="center", zorder=4
            )
    for room in rooms:
        for to in needed(rooms, room):
            arrow(axes, boxes, room, to, heights)
    for package in PACKAGES:
        axes.text(left[package], y - 0.1, package, fontsize=11, fontweight="bold", va="bottom")
    with matplotlib.rc_context({"svg.hashsalt": "ranks", "svg.fonttype": "none"}):
        figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def needed(rooms: Graph, room: str) -> set[str]:
    """Return the rooms that a room imports from and that it does not reach through others anyway."""
    return {to for to in rooms[room] if not any(to in below(rooms, via) for via in rooms[room] - {to})}


def arranged(rooms: Graph, heights: Mapping[str, int]) -> dict[tuple[str, int], list[str]]:
    """Return the rooms of each package and row, from left to right, so that arrows cross seldom."""
    places: dict[tuple[str, int], list[str]] = {}
    for room in sorted(rooms):
        places.setdefault((room.split(".")[0], heights[room]), []).append(room)
    around: dict[str, set[str]] = {room: needed(rooms, room) for room in rooms}
    for room in rooms:
        for to in needed(rooms, room):
            around[to] = around[to] | {room}
    for _ in range(12):
        spot = {room: (number + 0.5) / len(row) for row in places.values() for number, room in enumerate(row)}
        for key, row in places.items():
            mean = {}
            for room in row:
                near = [spot[other] for other in around[room] if other.split(".")[0] == key[0]]
                mean[room] = sum(near) / len(near) if near else spot[room]
            row.sort(key=mean.__getitem__)
    return places


def arrow(
    axes: Any, boxes: Mapping[str, tuple[float, float, float]], room: str, to: str, heights: Mapping[str, int]
) -> None:
    """Draw an arrow from a room down to one that it imports from; red where it does not go down."""
    (x, y, _), (to_x, to_y, to_height) = boxes[room], boxes[to]
    same_package = room.split(".")[0] == to.split(".")[0]
    shape = FancyArrowPatch(
        (x + _BOX / 2, y), (to_x + _BOX / 2, to_y + to_height), arrowstyle="-|>", mutation_scale=7, shrinkA=0, shrinkB=0
    )
    colour = "#333333" if same_package else "#b0b0b0"
    shape.set(color="#cc0000" if heights[to] >= heights[room] else colour, linewidth=0.8 if same_package else 0.5)
    shape.set_zorder(2 if same_package else 1)
    axes.add_patch(shape)


def main() -> None:
    """Print ranks and the frame's way, and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path, default=ROOT / "docs" / "ranks.svg")
    figure = parser.parse_args().figure
    sys.path.insert(0, str(ROOT))
    modules = module_paths()
    graph = {name: imported_modules(name, path, modules) for name, path in modules.items()}
    ranks = ranks_of(graph)
    rooms = rooms_of(graph, modules)
    arrows = sum(map(len, rooms.values()))
    print(
        f"{len(modules)} modules on {1 + max(ranks.values())} ranks, {len(rooms)} rooms, {arrows} arrows between them"
    )
    for kind, drawn in (("modules", graph), ("rooms", rooms)):
        for circle in circles(drawn):
            print(f"a circle of {kind}: {', '.join(sorted(circle))}")
    for name, route in follow_frames(modules, ranks):
        print_route(name, route, ranks)
    draw(figure, modules, ranks, rooms)
    print(f"\n{figure} shows the rooms")


if __name__ == "__main__":
    main()
