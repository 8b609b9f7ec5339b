"""Scenes before a drawn rig: bodies in drawn places and colours, all in mm in the camera's frame, y down."""

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt
from drawn_rigs import DrawnRig
from ray_caster import BALL, BOX, CAPSULE, RELIEF, Bodies
from spectra import WAVELENGTHS, bell, edge, reflectance

F64 = npt.NDArray[np.float64]
_GRID, _MAP = 900, 1200


@dataclass
class Scene:
    """What stands before the camera."""

    name: str
    bodies: list["Body"]
    paints: list[F64]  # (wavelengths,) reflectances
    names: list[str]  # of the paints
    scatter_mm: dict[int, tuple[float, float, float]] = field(default_factory=dict)  # by paint, of the primaries
    bounces: bool = False  # whether surfaces light each other enough to matter

    def packed(self) -> Bodies:
        """Return the bodies as kernels read them."""
        kinds, numbers, reliefs, maps = [], [], [np.full((_GRID, _GRID), -1e4)], []
        for body in self.bodies:
            grid = 0
            if body.relief is not None:
                grid = len(reliefs)
                reliefs.append(body.relief)
            painted = np.full((_MAP, _MAP), body.paint, np.uint8) if body.painted is None else body.painted
            kinds.append([body.kind, grid, len(maps)])
            maps.append(painted)
            cells = (_GRID - 1) / (2 * max(body.sizes[:2]))
            numbers.append([*body.turn.ravel(), *body.origin, *body.sizes, cells, body.gloss, body.shininess])
        return Bodies(np.array(kinds, np.int32), np.array(numbers, np.float64), np.array(reliefs), np.array(maps))


@dataclass
class Body:
    """One body; its -z looks at the camera where it is not turned."""

    kind: int
    origin: F64
    sizes: tuple[float, float, float]
    paint: int = 0
    turn: F64 = field(default_factory=lambda: np.eye(3))  # from the world to the body
    relief: F64 | None = None  # (_GRID, _GRID) mm
    painted: npt.NDArray[np.uint8] | None = None  # (_MAP, _MAP)
    gloss: float = 0.0
    shininess: float = 200.0


def turned(x_deg: float, y_deg: float, z_deg: float = 0.0) -> F64:
    """Return the turn from the world to a body that is turned about these axes."""
    return (
        cv2.Rodrigues(np.radians([x_deg, 0, 0]))[0]
        @ cv2.Rodrigues(np.radians([0, y_deg, 0]))[0]
        @ cv2.Rodrigues(np.radians([0, 0, z_deg]))[0]
    )


def _mesh(size: int, half: float) -> tuple[F64, F64]:
    at = (np.arange(size) - 0.5 * (size - 1)) / (0.5 * (size - 1)) * half
    x, y = np.meshgrid(at, at)
    return x, y


# --- paints --------------------------------------------------------------------------------------------------------


def _flat(albedo: float) -> F64:
    return np.full(len(WAVELENGTHS), albedo)


def _skin(rng: np.random.Generator, dark: float) -> F64:
    """Return skin: light at 0, dark at 1; melanin takes more of the blue."""
    melanin = np.exp(-(0.2 + 3.2 * dark) * (WAVELENGTHS / 500.0) ** -3.3 * 0.55)
    return np.clip(1.25 * reflectance("skin") * melanin * rng.uniform(0.9, 1.1), 0.02, 0.9)


def _saturated(rng: np.random.Generator, hue: str) -> F64:
    low, high = rng.uniform(0.03, 0.10), rng.uniform(0.35, 0.65)
    width = rng.uniform(9, 20)
    shapes = {
        "red": lambda: edge(rng.uniform(595, 618), width),
        "orange": lambda: edge(rng.uniform(570, 590), width),
        "yellow": lambda: edge(rng.uniform(500, 525), width),
        "green": lambda: bell(rng.uniform(518, 545), rng.uniform(30, 45)),
        "teal": lambda: bell(rng.uniform(485, 508), rng.uniform(32, 48)),
        "blue": lambda: bell(rng.uniform(448, 470), rng.uniform(28, 45)),
        "purple": lambda: 0.7 * bell(440, 30) + edge(rng.uniform(620, 640), width),
    }
    return low + high * shapes[hue]()


HUES = ("red", "orange", "yellow", "green", "teal", "blue", "purple")


def _pale(rng: np.random.Generator) -> F64:
    """Return the paint of a wall: some light colour."""
    center, width = rng.uniform(450, 620), rng.uniform(20, 50) * rng.choice([-1, 1])
    return rng.uniform(0.3, 0.55) + rng.uniform(0.05, 0.3) * edge(center, width)


# --- bodies --------------------------------------------------------------------------------------------------------


def _wall(rng: np.random.Generator, distance: float, paint: int, tilt: float = 8.0) -> Body:
    turn = turned(rng.uniform(-tilt, tilt), rng.uniform(-tilt, tilt))
    return Body(BOX, np.array([0, 0, distance + 20.0]), (distance, distance, 20.0), paint, turn)


def _face(rng: np.random.Generator, distance: float, paints: dict[str, int]) -> Body:
    """Return a painted face: an ellipsoid's front with a nose, eye sockets, brows, cheeks, lips and a chin."""
    size = 120.0
    scale = distance / 880.0
    x, y = _mesh(_GRID, size)
    wide, high, deep = rng.uniform(70, 80), rng.uniform(98, 112), rng.uniform(76, 92)
    inside = 1 - (x / wide) ** 2 - (y / high) ** 2
    height = deep * np.sqrt(np.clip(inside, 0, None))
    facing = np.clip(inside, 0, 1) ** 0.4

    def hill(at_x, across, at_y, along, power=2):
        return np.exp(-(np.abs((x - at_x) / across) ** power) - ((y - at_y) / along) ** 2)

    rise = np.clip((y + 28) / 50, 0, 1)
    relief = rng.uniform(18, 26) * rise**1.4 / (1 + np.exp((y - 25) / 2.5)) * np.exp(-((x / (6 + 6 * rise)) ** 2))
    for side in (-1, 1):
        relief += 4 * hill(side * 11, 6, 20, 6) - 9 * hill(side * 30, 17, -20, 11) + 6 * hill(side * 30, 11, -19, 8)
        relief += 3.5 * hill(side * 26, 22, -38, 7) + 4 * hill(side * 40, 17, 12, 18)
    relief += 6 * hill(0, 24, 52, 10, 4) - 3 * hill(0, 22, 52, 2.0, 4) + 8 * hill(0, 22, 86, 13)
    height = np.where(inside > 0, height + facing * relief, -1e4)
    px, py = _mesh(_MAP, size)
    painted = np.full((_MAP, _MAP), paints["skin"], np.uint8)
    for at_x, at_y, radius in rng.uniform((-60, -70, 0.8), (60, 80, 2.2), (35, 3)):
        painted[(px - at_x) ** 2 + (py - at_y) ** 2 < radius**2] = paints["spot"]
    painted[(px / 25) ** 2 + ((py - 52) / 7.5) ** 2 < 1] = paints["lips"]
    beside = np.abs(px) - 30
    painted[(np.abs(beside) < 17) & (np.abs(py + 38 - 0.012 * beside**2) < 3.2)] = paints["hair"]
    painted[py < -76 + 4 * np.abs((px / 9 + 100) % 2 - 1)] = paints["hair"]
    painted[(beside / 12) ** 2 + ((py + 19) / 5) ** 2 < 1] = paints["sclera"]
    painted[beside**2 + (py + 19) ** 2 < 4.6**2] = paints["hair"]
    half = size * scale
    return Body(RELIEF, np.array([rng.uniform(-15, 15), rng.uniform(-10, 10), distance + 30 * scale]),
                (half, half, (deep + 45) * scale), 0,
                turned(rng.uniform(-6, 6), rng.uniform(-15, 15), rng.uniform(-8, 8)),
                np.where(height > -1e3, height * scale, -1e4), painted)  # fmt: skip


def _face_scene(name: str, rng: np.random.Generator, rig: DrawnRig, dark: float, scatters: bool = False) -> Scene:
    skin = _skin(rng, dark)
    lips = skin * (0.45 + 0.45 * edge(610, 15))
    paints = [_pale(rng), skin, lips, 0.03 + 0.05 * edge(620, 40), skin * (0.4 + 0.4 * edge(630, 25)),
              0.62 + 0.10 * edge(520, 40)]  # fmt: skip
    names = ["wall", "skin", "lips", "hair", "spot", "sclera"]
    numbers = {name: k for k, name in enumerate(names)}
    d = rig.distance_mm
    scene = Scene(name, [_face(rng, d - 60 * d / 880, numbers), _wall(rng, d + rng.uniform(30, 80), 0)], paints, names)
    if scatters:
        scene.scatter_mm = dict.fromkeys((1, 2, 4), (1.2, 0.6, 0.3))
    return scene


def _plane(rng: np.random.Generator, rig: DrawnRig) -> Scene:
    return Scene("plane", [_wall(rng, rig.distance_mm, 0)], [_flat(0.85)], ["white"])


def _hand(rng: np.random.Generator, rig: DrawnRig) -> Scene:
    d = rig.distance_mm
    s = d / 800
    z = d - 70 * s
    bodies = [_wall(rng, d + rng.uniform(0, 40), 0)]
    palm = turned(0, 0, rng.uniform(-20, 20))
    for k in range(5):
        spread = (k - 2) * rng.uniform(17, 21) * s
        turn = turned(0, rng.uniform(-14, 14), 90 + (k - 2) * 9 + rng.uniform(-3, 3)) @ palm
        along = turn.T @ np.array([-(52 + 12 * (k in (1, 2, 3))) * s, 0, 0])
        origin = np.array([spread, 5 * s, z + rng.uniform(-6, 6)]) + along
        bodies.append(Body(CAPSULE, origin, (rng.uniform(8, 10) * s, rng.uniform(30, 42) * s, 0.0), 1, turn))
    for k in range(3):
        bodies.append(
            Body(CAPSULE, np.array([(k - 1) * 24 * s, 30 * s, z + 3]), (19 * s, 30 * s, 0.0), 1, turned(0, 0, 90))
        )
    return Scene("hand", bodies, [_pale(rng), _skin(rng, rng.uniform(0, 0.6))], ["wall", "skin"])


def printed(half: float, width: float, angle: float, stripes: bool = False) -> npt.NDArray[np.uint8]:
    """Return a map of 0 and 1 in checks, or stripes, of so many mm, turned by an angle."""
    px, py = _mesh(_MAP, half)
    along, across = px * np.cos(angle) + py * np.sin(angle), py * np.cos(angle) - px * np.sin(angle)
    number = np.floor(along / width) + (0 if stripes else np.floor(across / width))
    return (number % 2).astype(np.uint8)


def _cloth(name: str, cycles: float, stripes: bool, rng: np.random.Generator, rig: DrawnRig) -> Scene:
    """Return cloth that waves, printed with checks or stripes of so many cycles' width."""
    d = rig.distance_mm
    half = 0.6 * d
    x, y = _mesh(_GRID, half)
    height = np.zeros_like(x)
    for _ in range(3):
        length, angle = rng.uniform(0.12, 0.3) * d, rng.uniform(0, np.pi)
        height += (
            0.025 * length * np.sin(2 * np.pi / length * (x * np.cos(angle) + y * np.sin(angle)) + rng.uniform(0, 6))
        )
    painted = printed(half, cycles * mm_per_cycle(rig), rng.uniform(-0.4, 0.4), stripes)
    hues = rng.choice(HUES, 2, replace=False)
    paints = [_saturated(rng, hues[0]), 0.5 * _saturated(rng, hues[1]) + 0.5 * _pale(rng)]
    body = Body(
        RELIEF,
        np.array([0, 0, d + height.max()]),
        (half, half, np.ptp(height) + 2),
        0,
        np.eye(3),
        height - height.min(),
        painted,
    )
    return Scene(name, [body], paints, ["first", "second"])


def _objects(rng: np.random.Generator, rig: DrawnRig) -> Scene:
    d = rig.distance_mm
    s = d / 880
    hues = ["red", "blue", *rng.choice(["orange", "yellow", "green", "teal", "purple"], 3, replace=False)]
    places = [(-110, -65), (105, -65), (0, 10), (-105, 75), (110, 75)]
    bodies = []
    for k, (x, y) in enumerate(places):
        origin = np.array([x * s, y * s, d - rng.uniform(20, 70) * s])
        if rng.random() < 0.5:
            bodies.append(Body(BALL, origin, (rng.uniform(34, 46) * s, 46 * s, 0.0), k + 1))
        else:
            half = rng.uniform(28, 38) * s
            turn = turned(rng.uniform(-35, 35), rng.uniform(-40, 40), rng.uniform(0, 90))
            bodies.append(Body(BOX, origin, (half, half, half), k + 1, turn))
    paints = [_pale(rng), *(_saturated(rng, hue) for hue in hues)]
    return Scene("objects", [*bodies, _wall(rng, d + 70 * s, 0)], paints, ["wall", *hues])


def _parcel(rng: np.random.Generator, rig: DrawnRig) -> Scene:
    """Return a cardboard box with printed letters, labels and tape before a coloured wall."""
    d = rig.distance_mm
    s = d / 800
    painted = np.full((_MAP, _MAP), 1, np.uint8)
    for _ in range(5):  # labels and tape
        i, j = rng.integers(60, _MAP - 400, 2)
        painted[i : i + rng.integers(60, 260), j : j + rng.integers(120, 380)] = rng.integers(2, 5)
    for row in range(90, _MAP - 120, 85):  # lines of letters
        column = 80
        while column < _MAP - 120:
            width = int(rng.integers(8, 40))
            if rng.random() < 0.75:
                painted[row : row + int(rng.integers(18, 50)), column : column + width] = 5
            column += width + int(rng.integers(8, 26))
    box = Body(BOX, np.array([rng.uniform(-20, 20), 0, d - 30 * s]), (105 * s, 80 * s, 60 * s), 1,
               turned(rng.uniform(-20, 20), rng.uniform(15, 35), rng.uniform(-8, 8)), None, painted)  # fmt: skip
    cardboard = 0.18 + 0.38 * edge(560, 45)
    paints = [
        _saturated(rng, "teal"),
        cardboard,
        _flat(0.75),
        _saturated(rng, "red"),
        _saturated(rng, "yellow"),
        _flat(0.07),
    ]
    return Scene("parcel", [box, _wall(rng, d + 60 * s, 0)], paints, ["wall", "card", "label", "red", "tape", "ink"])


def _wood(rng: np.random.Generator, rig: DrawnRig) -> Scene:
    px, py = _mesh(_MAP, 1.0)
    grain = np.sin(140 * py + 4 * np.sin(7 * px + rng.uniform(0, 6)) + 2 * np.sin(20 * px))
    grain += 0.6 * np.sin(400 * py + 5 * np.sin(12 * px))
    painted = np.clip((grain + 1.6) / 3.2 * 6, 0, 5).astype(np.uint8)
    base = 0.10 + 0.45 * edge(570, 55)
    paints = [base * (0.7 + 0.09 * k) + 0.004 * k * edge(600, 30) for k in range(6)]
    wall = _wall(rng, rig.distance_mm, 0)
    wall.painted = painted
    return Scene("wood", [wall], paints, [f"grain {k}" for k in range(6)])


def _balls(rng: np.random.Generator, rig: DrawnRig) -> Scene:
    d = rig.distance_mm
    s = d / 880
    shiny = Body(BALL, np.array([75 * s, rng.uniform(-20, 20), d - 20 * s]), (60 * s, 60 * s, 0.0), 2, gloss=0.04)
    matte = Body(BALL, np.array([-75 * s, rng.uniform(-20, 20), d - 20 * s]), (62 * s, 62 * s, 0.0), 1)
    hues = rng.choice(HUES, 2, replace=False)
    paints = [_pale(rng), 0.4 * _saturated(rng, hues[0]) + 0.35, _saturated(rng, hues[1])]
    return Scene("balls", [matte, shiny, _wall(rng, d + 60 * s, 0)], paints, ["wall", "matte ball", "glossy ball"])


def _bars(rng: np.random.Generator, rig: DrawnRig) -> Scene:
    """Return bars of 3 to 10 mm, .3 to 2.3 cycles before a wall."""
    d = rig.distance_mm
    wall = _wall(rng, d, 0, 3.0)
    bodies, seen = [], d * rig.calibration.camera.size_px[0] / rig.calibration.camera.matrix[0, 0]
    depth = mm_per_cycle_of_depth(rig)
    upright = rig.calibration.pattern.stripes == "horizontal"  # bars across the stripes
    for k, x in enumerate(np.linspace(-0.38, 0.38, 7) * seen * (1.0 if upright else 0.75)):
        before = rng.uniform(0.3, 2.3) * depth
        half = rng.uniform(1.5, 5.0)
        sizes = (half, 0.3 * seen, 1.5) if upright else (0.3 * seen, half, 1.5)
        origin = np.array([x, 0.0, d - before]) if upright else np.array([0.0, x, d - before])
        bodies.append(Body(BOX, origin, sizes, 1 + k % 2, turned(0, 0, rng.uniform(-6, 6))))
    paints = [_pale(rng), _flat(rng.uniform(0.4, 0.8)), _saturated(rng, str(rng.choice(HUES)))]
    return Scene("bars", [*bodies, wall], paints, ["wall", "grey bars", "coloured bars"])


def _corner(rng: np.random.Generator, rig: DrawnRig) -> Scene:
    """Return two walls that meet at 90 degrees, the edge across the stripes or along them."""
    d, lying = rig.distance_mm, bool(rng.integers(2))
    half, bodies = 0.45 * d, []
    for paint, side in enumerate((-1, 1)):
        turn = turned(side * 45, 0) if lying else turned(0, -side * 45)
        middle = np.array([0, side * half, 0]) if lying else np.array([side * half, 0, 0])
        inward = turn.T @ np.array([0, 0, 1.0])
        origin = (
            np.array([0, 0, d + 0.04 * d]) + np.array([0, 0, -half]) / np.sqrt(2) + middle / np.sqrt(2) + 5 * inward
        )
        bodies.append(Body(BOX, origin, (half, half, 5.0), paint, turn))
    return Scene("corner", bodies, [_pale(rng), _pale(rng)], ["first wall", "second wall"], bounces=True)


def mm_per_cycle(rig: DrawnRig) -> float:
    """Return how wide a cycle is on a surface at the rig's distance, mm."""
    axis = rig.calibration.geometry().phase_axis
    return rig.calibration.pattern.period_px * rig.distance_mm / rig.calibration.projector.matrix[axis, axis]


def mm_per_cycle_of_depth(rig: DrawnRig) -> float:
    """Return by how much the depth differs from one cycle to the next along a ray of the camera, mm."""
    return 2 * np.pi / rig.calibration.geometry().rad_per_mm(rig.distance_mm)


SCENES: dict[str, Callable[[np.random.Generator, DrawnRig], Scene]] = {
    "plane": _plane,
    "light face": lambda rng, rig: _face_scene("light face", rng, rig, rng.uniform(0, 0.25)),
    "dark face": lambda rng, rig: _face_scene("dark face", rng, rig, rng.uniform(0.7, 1.0)),
    "scattering face": lambda rng, rig: _face_scene("scattering face", rng, rig, rng.uniform(0, 0.4), scatters=True),
    "hand": _hand,
    "checks": lambda rng, rig: _cloth("checks", rng.uniform(4, 6), False, rng, rig),
    "fine checks": lambda rng, rig: _cloth("fine checks", rng.uniform(2, 3), False, rng, rig),
    "stripes": lambda rng, rig: _cloth("stripes", rng.uniform(2, 6), True, rng, rig),
    "objects": _objects,
    "parcel": _parcel,
    "wood": _wood,
    "balls": _balls,
    "bars": _bars,
    "corner": _corner,
}


def draw_scene(name: str, rig: DrawnRig, seed: int) -> Scene:
    """Return a scene before a rig, in drawn colours."""
    return SCENES[name](np.random.default_rng([45, seed, list(SCENES).index(name)]), rig)
