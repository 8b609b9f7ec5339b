"""The figure of rooms by rank, packages side by side, with an arrow for every import that no longer way implies."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from support.import_graph import Graph, below, ranks_of

# A line of text, a box's width, the gaps between boxes and between packages, and a box's margin, in inches.
_LINE, _WIDTH, _GAP_X, _GAP_Y, _GAP_PACKAGES, _MARGIN = 0.16, 1.68, 0.14, 0.32, 0.5, 0.06
_COLOURS = {"hardware": "#e3f1df", "pipeline": "#fdebd0", "tikernels": "#dbe9f6"}  # from left to right
# Down an import within a package, down one to another package, and where an import does not go down.
_INSIDE, _BETWEEN, _NOT_DOWN = "#333333", "#b0b0b0", "#cc0000"

Box = tuple[float, float, float]  # left, bottom, height


def draw_rooms(path: Path, rooms: Graph, ranks: Mapping[str, int]) -> None:
    """Draw the rooms by rank.

    Parameters
    ----------
    path : Path
        The picture; its suffix says which kind.
    rooms : dict
        The rooms that each room imports from.
    ranks : dict
        The rank of every module.
    """
    drawn = {room for room in rooms if rooms[room] or any(room in others for others in rooms.values())}
    rooms = {room: others for room, others in rooms.items() if room in drawn}
    heights = ranks_of(rooms)
    lines = {room: [n for n in ranks if n.startswith(room + ".")] if room.count(".") else [] for room in rooms}
    boxes, size, left = placed(arranged(rooms, heights), lines)
    figure = plt.figure(figsize=size)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-0.1, size[0] - 0.1), ylim=(-0.1, size[1] - 0.1))
    axes.set_axis_off()
    for room, box in boxes.items():
        draw_room(axes, room, box, sorted(lines[room], key=lambda name: (-ranks[name], name)), ranks)
        for to in needed(rooms, room):
            draw_arrow(axes, boxes[room], boxes[to], arrow_colour(room, to, heights))
    for package, x in left.items():
        axes.text(x, size[1] - 0.35, package, fontsize=11, fontweight="bold", va="bottom")
    with matplotlib.rc_context({"svg.hashsalt": "rooms", "svg.fonttype": "none"}):
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


def needed(rooms: Graph, room: str) -> set[str]:
    """Return the rooms that a room imports from and that it does not reach through others anyway."""
    return {to for to in rooms[room] if not any(to in below(rooms, via) for via in rooms[room] - {to})}


def arranged(rooms: Graph, heights: Mapping[str, int]) -> dict[tuple[str, int], list[str]]:
    """Return the rooms of each package and row, from left to right, so that arrows seldom cross."""
    places: dict[tuple[str, int], list[str]] = {}
    for room in sorted(rooms):
        places.setdefault((room.split(".")[0], heights[room]), []).append(room)
    around = {room: needed(rooms, room) | {other for other in rooms if room in needed(rooms, other)} for room in rooms}
    for _ in range(12):  # rooms move to the middle of those that they are joined to; that settles after a few times
        spot = {room: (number + 0.5) / len(row) for row in places.values() for number, room in enumerate(row)}
        for (package, _), row in places.items():
            middle = {}
            for room in row:
                near = [spot[other] for other in around[room] if other.split(".")[0] == package]
                middle[room] = sum(near) / len(near) if near else spot[room]
            row.sort(key=middle.__getitem__)
    return places


def placed(
    places: Mapping[tuple[str, int], list[str]], lines: Mapping[str, list[str]]
) -> tuple[dict[str, Box], tuple[float, float], dict[str, float]]:
    """Return every room's box, the figure's size, and where each package begins, in inches."""
    columns = {package: max(len(row) for (p, _), row in places.items() if p == package) for package in _COLOURS}
    left, x = {}, 0.0
    for package, count in columns.items():
        left[package] = x
        x += count * (_WIDTH + _GAP_X) - _GAP_X + _GAP_PACKAGES
    boxes: dict[str, Box] = {}
    y = 0.0
    for height in sorted({height for _, height in places}):
        tallest = y
        for package, count in columns.items():
            row = places.get((package, height), [])
            start = left[package] + (count - len(row)) * (_WIDTH + _GAP_X) / 2
            for column, room in enumerate(row):
                boxes[room] = start + column * (_WIDTH + _GAP_X), y, (1 + len(lines[room])) * _LINE + 2 * _MARGIN
                tallest = max(tallest, y + boxes[room][2])
        y = tallest + _GAP_Y
    return boxes, (x - _GAP_PACKAGES + 0.2, y + 0.3), left


def draw_room(axes: Any, room: str, box: Box, names: list[str], ranks: Mapping[str, int]) -> None:
    """Draw a room's box with its name, and its modules with their ranks."""
    x, y, height = box
    shape = FancyBboxPatch((x, y), _WIDTH, height, boxstyle=f"round,pad=0,rounding_size={_MARGIN}", zorder=3)
    shape.set(facecolor=_COLOURS[room.split(".")[0]], edgecolor="#555555", linewidth=0.7)
    axes.add_patch(shape)
    title = room.split(".", 1)[-1] + ("/" if names else "")
    style = {"va": "center", "zorder": 4, "fontsize": 8}
    for number, (name, shown) in enumerate([(room, title), *((n, n.removeprefix(room + ".")) for n in names)]):
        place = y + height - _MARGIN - (number + 0.5) * _LINE
        axes.text(x + _MARGIN, place, shown, fontweight="normal" if number else "bold", **style)
        if number or not names:
            axes.text(x + _WIDTH - _MARGIN, place, ranks[name], ha="right", **style)


def arrow_colour(room: str, to: str, heights: Mapping[str, int]) -> str:
    """Return the colour of an arrow from a room to one that it imports from."""
    if heights[to] >= heights[room]:
        return _NOT_DOWN
    return _INSIDE if room.split(".")[0] == to.split(".")[0] else _BETWEEN


def draw_arrow(axes: Any, start: Box, end: Box, colour: str) -> None:
    """Draw an arrow from the lower edge of a box to the upper one of another."""
    ends = (start[0] + _WIDTH / 2, start[1]), (end[0] + _WIDTH / 2, end[1] + end[2])
    shape = FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=7, shrinkA=0, shrinkB=0)
    shape.set(color=colour, linewidth=0.5 if colour == _BETWEEN else 0.8, zorder=1 if colour == _BETWEEN else 2)
    axes.add_patch(shape)
