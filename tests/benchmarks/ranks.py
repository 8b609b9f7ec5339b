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
from pathlib import Path
from types import FrameType
from typing import Any

import _tests_path  # noqa: F401 - puts support on the path
import cv2
import numpy as np
from support.import_graph import circles, imported_modules, module_paths, ranks_of, rooms_of
from support.room_figure import draw_rooms

ROOT = Path(__file__).resolve().parents[2]


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


def main() -> None:
    """Print ranks and the frame's way, and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path, default=ROOT / "docs" / "ranks.svg")
    figure = parser.parse_args().figure
    modules = module_paths(ROOT)
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
    draw_rooms(figure, rooms, ranks)
    print(f"\n{figure} shows the rooms")


if __name__ == "__main__":
    main()
