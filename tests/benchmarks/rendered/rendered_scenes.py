"""The scenes: bodies, where they stand, and how they are painted. All places are mm in the camera's frame, y down."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from spectra import CHART

Points = npt.NDArray[np.floating]
#: From (N, 3) places of a body at rest to the numbers of its paints.
Painter = Callable[[Points], npt.NDArray[np.uint8]]


@dataclass(frozen=True)
class Body:
    """One surface of a scene."""

    name: str
    shape: dict[str, Any]  # what Mitsuba makes of it; for a mesh, {"type": "mesh"} and its vertices and faces
    paints: tuple[str, ...]  # names in `spectra.PAINTS`
    painter: Painter | None = None  # which of them is where; None: the first everywhere
    moves: bool = False
    gloss: float = 0.0  # reflectance of a clear coat seen from above
    shininess: float = 200.0  # exponent of its highlight
    surfaces: tuple[str, ...] = ()  # names by paint, where each counts as a surface of its own


@dataclass(frozen=True)
class RenderedScene:
    """What stands before the camera, and what happens while it looks."""

    name: str
    bodies: tuple[Body, ...]
    bounces: int = 1  # of the light; more than one where surfaces light each other
    motion_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the bodies that move, during the exposure
    in_turns: bool = False  # red, green and blue one after another, a third of the exposure each
    start: float = 0.0  # how many exposures' motion lies between rest and this frame's middle
    focus_mm: float | None = None  # distance at which the projector is sharp; None: it is everywhere
    defocus_px: float = 0.0  # blur, projector px, at a distance of infinity
    notes: str = field(default="", compare=False)

    @property
    def surfaces(self) -> tuple[str, ...]:
        """Names of all surfaces that are judged apart, in the order of their numbers."""
        return tuple(name for body in self.bodies for name in (body.surfaces or (body.name,)))


def _transform(center: tuple[float, float, float], turn_deg: tuple[float, float], size: Any) -> Points:
    """Return the (4, 4) matrix of a standard shape's place: scaled, turned about x and then y, moved."""
    matrix = np.eye(4)
    tilt, turn = (
        cv2.Rodrigues(np.radians(angle) * axis)[0] for angle, axis in zip(turn_deg, np.eye(3)[:2], strict=True)
    )
    matrix[:3, :3] = turn @ tilt * np.asarray(size)
    matrix[:3, 3] = center
    return matrix


def wall(
    distance_mm: float,
    paint: str = "white",
    turn_deg: tuple[float, float] = (0.0, 0.0),
    painter: Painter | None = None,
    **more: Any,
) -> Body:
    """Return a plane before the camera, turned about x and y."""
    paints = more.pop("paints", (paint,))
    shape = {
        "type": "rectangle",
        "to_world": _transform((0, 0, distance_mm), (180 + turn_deg[0], turn_deg[1]), [500, 500, 1]),
    }
    return Body(more.pop("name", "wall"), shape, paints, painter, **more)


def ball(name: str, paint: str, center: tuple[float, float, float], radius_mm: float, **more: Any) -> Body:
    """Return a ball."""
    return Body(name, {"type": "sphere", "center": list(center), "radius": radius_mm}, (paint,), **more)


def box(name: str, paint: str, center: tuple[float, float, float], half_mm: float, turn_deg=(20.0, 30.0)) -> Body:
    """Return a cube that shows three of its sides."""
    return Body(name, {"type": "cube", "to_world": _transform(center, turn_deg, [half_mm] * 3)}, (paint,))


# Half axes of the head, and where its middle is, mm.
_HEAD_MM = np.array([76.0, 108.0, 84.0])
_HEAD_CENTER_MM = np.array([0.0, 0.0, 852.0])
_MESH_STEPS = 700


def _relief(x: Points, y: Points) -> Points:
    """Return by how much the face stands out from the ellipsoid, mm, by place from its middle (y down)."""

    def hill(across: Points, wide: float, along: Points, high: float, power: int = 2) -> Points:
        return np.exp(-(np.abs(across / wide) ** power) - (along / high) ** 2)

    # The nose rises from the bridge to its tip and falls quickly below it.
    rise = np.clip((y + 28) / 50, 0, 1)
    fall = 1 / (1 + np.exp((y - 25) / 2.2))
    height = 24 * rise**1.4 * fall * np.exp(-((x / (5.5 + 5.5 * rise)) ** 2))
    beside = np.abs(x) - 30
    height += 4 * hill(np.abs(x) - 11, 6, y - 20, 6)  # nostrils
    height -= 9 * hill(beside, 17, y + 20, 11)  # eye sockets
    height += 6 * hill(beside, 11, y + 19, 8)  # eyeballs
    height += 3.5 * hill(np.abs(x) - 26, 24, y + 38, 7)  # brows
    height += 4 * hill(np.abs(x) - 40, 17, y - 12, 18)  # cheeks
    height += 6 * hill(x, 24, y - 52, 10, 4) - 3 * hill(x, 22, y - 52, 1.8, 4)  # lips and the line between
    height += 8 * hill(x, 22, y - 86, 13)  # chin
    return height


@cache
def _head_mesh() -> tuple[Points, npt.NDArray[np.uint32]]:
    """Return vertices (N, 3) mm and faces of the head's front half, by angles about its middle."""
    side, down = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, _MESH_STEPS), np.linspace(-np.pi / 2, np.pi / 2, _MESH_STEPS)
    )
    normal = np.stack([np.sin(side) * np.cos(down), np.sin(down), -np.cos(side) * np.cos(down)], axis=-1)
    place = normal * _HEAD_MM
    facing = np.clip(-normal[..., 2:], 0, 1) ** 0.5  # the relief fades towards the outline
    place = place + normal * facing * _relief(place[..., :1], place[..., 1:2]) + _HEAD_CENTER_MM
    number = np.arange(_MESH_STEPS**2, dtype=np.uint32).reshape(_MESH_STEPS, _MESH_STEPS)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([b, d, c], axis=-1)]).reshape(-1, 3)
    return place.reshape(-1, 3), faces


_FACE_PAINTS = ("skin", "lips", "hair", "spot", "sclera", "iris")


def _painted_face(places: Points) -> npt.NDArray[np.uint8]:
    """Return the paint of each place: lips, hair and brows, spots, the white of the eyes, the iris; all sharp."""
    x, y = places[:, 0] - _HEAD_CENTER_MM[0], places[:, 1] - _HEAD_CENTER_MM[1]
    paint = np.zeros(len(places), np.uint8)
    spots = np.random.default_rng(5).uniform((-60, -70, 0.8), (60, 80, 2.0), (45, 3))
    for at_x, at_y, radius in spots:
        paint[(x - at_x) ** 2 + (y - at_y) ** 2 < radius**2] = 3
    beside = np.abs(x) - 30
    paint[(x / 25) ** 2 + ((y - 52) / 7.5) ** 2 < 1] = 1
    paint[(np.abs(beside - 1) < 17) & (np.abs(y + 38 - 0.012 * beside**2) < 3.2)] = 2
    paint[y < -78 + 4 * np.abs((x / 9 + 100) % 2 - 1)] = 2
    paint[(beside / 12) ** 2 + ((y + 19) / 5) ** 2 < 1] = 4
    paint[beside**2 + (y + 19) ** 2 < 4.6**2] = 5
    return paint


def _head(painted: bool, moves: bool = False) -> Body:
    if painted:
        return Body("face", {"type": "mesh"}, _FACE_PAINTS, _painted_face, moves)
    return Body("face", {"type": "mesh"}, ("grey",), None, moves)


def mesh_of(body: Body) -> tuple[Points, npt.NDArray[np.uint32]]:
    """Return the vertices, (N, 3) mm, and faces of a body that is a mesh."""
    return _head_mesh()


_BOARD = ("white", "skin", "orange", "yellow", "green", "blue")


def _six_fields(places: Points) -> npt.NDArray[np.uint8]:
    """Return three columns of two fields."""
    column = np.clip((places[:, 0] + 195) // 130, 0, 2)
    return (2 * column + (places[:, 1] > 0)).astype(np.uint8)


def _chart_patches(places: Points) -> npt.NDArray[np.uint8]:
    """Return four rows of six patches."""
    column = np.clip((places[:, 0] + 222) // 74, 0, 5)
    return (6 * np.clip((places[:, 1] + 148) // 74, 0, 3) + column).astype(np.uint8)


def _dark_beside_bright(places: Points) -> npt.NDArray[np.uint8]:
    """Return dark on the right, and a few dark bars of falling width on the left."""
    x, y = places[:, 0], places[:, 1]
    dark = x > 40
    for at, half in ((-60, 14), (-110, 6), (-150, 3)):
        dark |= np.abs(x - at) < half
    dark |= (x < -175) & (np.abs(y) < 25)
    return dark.astype(np.uint8)


_BACK = {"turn_deg": (4.0, -5.0)}


def _saturated(grey: bool) -> tuple[Body, ...]:
    def paint(name: str) -> str:
        return "grey" if grey else name

    return (
        ball("orange ball", paint("orange"), (-125, -72, 830), 46),
        ball("yellow ball", paint("yellow"), (0, 30, 800), 44),
        box("blue box", paint("blue"), (118, -70, 845), 38, (25, 35)),
        box("green box", paint("green"), (125, 82, 850), 36, (-20, -30)),
        box("skin box", paint("skin"), (-118, 80, 845), 38, (20, 25)),
        wall(960, paint("cream"), **_BACK),
    )


def _corner(first: str, second: str, lying: bool = False) -> tuple[Body, ...]:
    """Return two planes that meet at 90 degrees in an edge, upright or lying, open towards the camera."""
    half = 420.0
    at = half / np.sqrt(2)
    names = ("upper wall", "lower wall") if lying else ("left wall", "right wall")
    bodies = []
    for name, paint, sign in zip(names, (first, second), (-1, 1), strict=True):
        if lying:
            to_world = _transform((0, sign * at, 985 - at), (180 - sign * 45, 0), [500, half, 1])
        else:
            to_world = _transform((sign * at, 0, 985 - at), (180, sign * 45), [half, 500, 1])
        bodies.append(Body(name, {"type": "rectangle", "to_world": to_world}, (paint,)))
    return tuple(bodies)


def _deep() -> tuple[Body, ...]:
    """Return a stair of plates from 780 to 1010 mm."""
    places = ((-150, 780, 8), (-75, 835, -10), (0, 890, 6), (75, 950, -8))
    plates = []
    for number, (x, distance, turn) in enumerate(places):
        to_world = _transform((x, -10 + 5 * number, distance), (180 + 5, turn), [34, 120, 1])
        plates.append(Body(f"plate at {distance} mm", {"type": "rectangle", "to_world": to_world}, ("grey",)))
    return (*plates, wall(1010, "grey", **_BACK))


def _scenes() -> list[RenderedScene]:
    back = wall(930, "grey", **_BACK)
    wall_behind = wall(930, "light grey", **_BACK)
    moving = (_head(painted=True, moves=True), wall_behind)
    board = wall(890, turn_deg=(5, 6), painter=_six_fields, paints=_BOARD, surfaces=_BOARD)
    chart = wall(890, turn_deg=(3, -4), painter=_chart_patches, paints=CHART, surfaces=CHART)
    two_fields = wall(890, turn_deg=(5, 6), painter=_dark_beside_bright, paints=("bright", "dark"))
    two_fields = Body(**{**vars(two_fields), "surfaces": ("bright", "dark")})
    gloss = (ball("glossy ball", "blue", (0, 0, 850), 75, gloss=0.04), back)
    return [
        RenderedScene("plane", (wall(900, "white", (4, 6), name="plane"),), notes="a white plane, tilted"),
        RenderedScene("grey_face", (_head(painted=False), back), notes="a face and a wall in grey paint"),
        RenderedScene("face", (_head(painted=True), wall_behind), notes="a painted face before a light grey wall"),
        RenderedScene("face_alone", (_head(painted=True),), notes="the painted face with nothing behind it"),
        RenderedScene("objects", _saturated(grey=False), notes="saturated objects before a cream wall"),
        RenderedScene("grey_objects", _saturated(grey=True), notes="the same in grey paint"),
        RenderedScene("board", (board,), notes="one flat board of six colours"),
        RenderedScene("chart", (chart,), notes="a colour chart of 24 patches with known spectra"),
        RenderedScene(
            "corner",
            _corner("corner white", "corner white"),
            4,
            notes="90 degrees, its edge across the stripes, albedo .8",
        ),
        RenderedScene(
            "lying_corner",
            _corner("corner white", "corner white", lying=True),
            4,
            notes="90 degrees, its edge along the stripes, albedo .8",
        ),
        RenderedScene(
            "colored_corner",
            _corner("cream", "orange"),
            4,
            notes="90 degrees, its edge across the stripes, cream and orange",
        ),
        RenderedScene("gloss", gloss, notes="a glossy blue ball before a grey wall"),
        RenderedScene("dark_beside_bright", (two_fields,), notes="albedo .05 beside .9 on one plane"),
        RenderedScene("deep", _deep(), notes="plates from 780 to 1010 mm, all in focus"),
        RenderedScene(
            "deep_out_of_focus", _deep(), focus_mm=790, defocus_px=10.0, notes="the same, projector sharp at 790 mm"
        ),
        RenderedScene("moving", moving, motion_mm=(0, 0, 4), notes="the face recedes 4 mm during the exposure"),
        RenderedScene("in_turns_still", moving, in_turns=True, notes="colours in turns, nothing moves"),
        RenderedScene("in_turns", moving, motion_mm=(0, 0, 2), in_turns=True, notes="colours in turns, 2 mm"),
        RenderedScene(
            "in_turns_before", moving, motion_mm=(0, 0, 2), in_turns=True, start=-1.0, notes="the frame before that"
        ),
    ]


@cache
def scenes() -> dict[str, RenderedScene]:
    """Return every scene by its name."""
    return {scene.name: scene for scene in _scenes()}
