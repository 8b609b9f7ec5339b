"""Films of things that move before rigs as people have them: scenes at any time, and what a shutter makes of them.

Row r of H of frame n is exposed from n * frame_s + start_s + readout_s * r / H for exposure_s. The scene is drawn at
instants so close that nothing moves further than 1 mm from one to the next. Between two of them the light of each
primary is taken to change linearly; a row's light is the mean over the times at which it is exposed and the primary is
on. A moving edge is thus a sum of edges 1 mm apart rather than a ramp. A pixel's rays are spread over the instants.
Everything is a function of time and seed: a frame can be drawn without those before it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt
from drawn_figures import calibration_for, deeper
from drawn_frames import Photographer, sensed
from drawn_rigs import DrawnRig, draw_rig
from drawn_scenes import Body, Scene, draw_scene, mm_per_cycle, printed, turned
from ray_caster import BALL, BOX, F32, F64, NOTHING, RELIEF, Truth, rows_of_rays, true_at_centers

from pipeline import DecodeSettings

Mask = npt.NDArray[np.bool_]
_TRUTH = {
    "place": float,
    "depth_mm": np.float32,
    "lit": bool,
    "body": np.uint8,
    "paint": np.uint8,
    "mm_per_rad": np.float32,
}

#: The picture that the projector shows, of `drawn_frames.PATTERNS`.
PATTERN = "compensated coded"
#: Rays a pixel, of all instants of a frame together; at each two or more.
RAYS = 16
# Nothing moves further from one instant to the next, mm.
_STEP_MM = 1.0
# Times within an exposure at which it is looked which primary is on: as often in each of three fields.
_LOOKS = 96
# Inside a surface is what is further than this from its edges, besides half the way that the fastest things go while
# the frame's rows are exposed.
_RIM_PX, _EDGE_MM = 4.0, 4.0
_LIT_LEVELS = 20.0  # of 255, mean of the channels
# Seconds of the films' own time at which the exposure is chosen, so that nothing clips that comes near.
_EXPOSED_AT_S = (0.0, 0.4, 0.9, 1.5)


@dataclass(frozen=True)
class Shutter:
    """When a camera's rows are exposed, and when a projector shows its colours."""

    frame_s: float
    exposure_s: float
    readout_s: float = 0.0  # from the first row's start to the last one's; 0: a global shutter
    cycle_s: float | None = None  # red, green and blue one after another, a third of it each; None: all at once
    start_s: float = 0.0  # of the first exposure, after the start of a red field
    drift: float = 0.0  # by which part of itself a frame's time is longer by the projector's clock

    def settings(self, stripes: str, height: int) -> DecodeSettings:
        """Return what a rig file says of it."""
        fields: dict[str, object] | None = None
        if self.cycle_s is not None:
            thirds = [(k * self.cycle_s / 3, (k + 1) * self.cycle_s / 3) for k in range(3)]
            fields = {"cycle_s": self.cycle_s, "shown_s": thirds}
        return DecodeSettings(stripes=stripes, frame_s=self.frame_s, row_s=self.readout_s / height, fields=fields)

    def row_starts(self, number: int, height: int) -> F64:
        """Return when the rows of a frame begin to be exposed, s."""
        return number * self.frame_s * (1 + self.drift) + self.start_s + self.readout_s * np.arange(height) / height

    def weights(self, starts: F64, instants: F64) -> F64:
        """Return (instants, rows, 3): what each contributes to a row's light of each primary; sums of about 1."""
        at = starts[:, None] + self.exposure_s * (np.arange(_LOOKS) + 0.5) / _LOOKS
        if self.cycle_s is None:
            on = np.full((*at.shape, 3), 1 / _LOOKS)
        else:
            on = 3 / _LOOKS * (np.floor(3 * at / self.cycle_s)[..., None] % 3 == np.arange(3))
        if len(instants) == 1:
            return on.sum(axis=1)[None]
        place = (at - instants[0]) / (instants[1] - instants[0])
        hats = np.clip(1 - np.abs(place - np.arange(len(instants))[:, None, None]), 0, None)  # (instants, rows, looks)
        return np.einsum("krl,rlc->krc", hats, on)


@dataclass(frozen=True)
class Film:
    """Things that move at the speed of `speed_mm_s` if the film runs as fast as time."""

    speed_mm_s: float
    fastest_mm_s: float  # of all that moves then
    scene: Callable[[float], Scene]
    judged: int  # number of the body whose depth is measured
    still: int  # number of a body that stands still
    speeds_mm_s: tuple[float, ...]  # that are measured
    hides: Callable[[float], bool] = lambda _: False  # whether something is in front of the judged body


@dataclass(frozen=True)
class Drawn:
    """A frame and its truth at the middle of the middle row's exposure."""

    levels: npt.NDArray[np.uint8]  # (H, W), the sensor's mosaic
    place: F32  # (H, W) projector px along the phase
    depth_mm: F32  # (H, W) NaN where there is nothing
    mm_per_rad: F32  # (H, W) by how much the depth changes with the phase
    body: npt.NDArray[np.uint8]  # (H, W)
    lit: Mask  # (H, W) lit, bright enough and not clipped
    inside: Mask  # (H, W) further from every edge than things move in a frame


# --- rigs ----------------------------------------------------------------------------------------------------------

# All stand alike (seed 2: 870 mm away, 48 mm of depth a cycle): the industrial camera has 640x480 px, 12.4 a cycle, the
# webcams 1280x720, 24.8 a cycle, as MJPEG leaves of the colours of twelve less than anybody would use.
_STANDS = 2
_WEBCAM_PX = (1280, 720)


def _rig(light: int, **changes: object) -> DrawnRig:
    """Return the light and filters of a drawn rig where another one stands.

    Lenses have no lateral colour, and the camera's gains make the projector's white grey.
    """
    stands, lit, none = draw_rig(_STANDS), draw_rig(light), (1.0, 1.0, 1.0)
    gains = 1 / lit.matrix(1.0).sum(axis=1)
    return replace(
        lit, filters=gains[:, None] * lit.filters, calibration=stands.calibration, distance_mm=stands.distance_mm,
        bits=8, camera_magnified=none, projector_magnified=none, projector_blur_px=0.6, camera_blur_px=0.5,
        ambient=0.02, pedestal=0.01, **changes,
    )  # fmt: skip


def _webcam(light: int) -> DrawnRig:
    """Return a rig with a webcam that sees as wide as the other camera."""
    rig = _rig(light, delivery="mjpeg", full_well=6000.0, read_noise=4.0)
    camera, (width, height) = rig.calibration.camera, _WEBCAM_PX
    scale = width / camera.size_px[0]
    matrix = np.diag([scale, scale, 1.0]) @ camera.matrix
    matrix[:2, 2] += 0.5 * (scale - 1) + np.array([0, 0.5 * (height - scale * camera.size_px[1])])
    wide = camera.model_copy(update={"size_px": _WEBCAM_PX, "matrix": matrix})
    return replace(rig, calibration=rig.calibration.model_copy(update={"camera": wide}))


_LED, _LAMP = 21, 6  # seeds of `drawn_rigs` with such a projector
_ROLLING = {"frame_s": 1 / 30, "readout_s": 0.02}
# Clocks of webcams and projectors differ by some hundred millionths.
_DRIFT = 3e-4


def film_rigs(seed: int) -> dict[str, tuple[DrawnRig, Shutter]]:
    """Return kinds of rigs that people have; the seed draws when free-running cameras start."""
    start = np.random.default_rng([50, seed]).uniform(0, 1 / 60)
    free = {**_ROLLING, "exposure_s": 1 / 60, "start_s": start, "drift": _DRIFT}
    led = _rig(_LED, delivery="bayer", full_well=10000.0, read_noise=3.0)
    webcam = _webcam(_LAMP)
    return {
        "led": (led, Shutter(frame_s=0.01, exposure_s=0.005)),
        "three-chip webcam": (webcam, Shutter(exposure_s=0.01, **_ROLLING)),
        "single-chip webcam 180": (webcam, Shutter(cycle_s=1 / 60, **free)),
        "single-chip webcam 360": (webcam, Shutter(cycle_s=1 / 120, **free)),
    }


# --- films ---------------------------------------------------------------------------------------------------------


def _to_and_fro(way: float, reach: float) -> float:
    """Return the place, from -reach to reach at an even speed, after so many mm."""
    return reach - abs((way + 2 * reach) % (4 * reach) - 2 * reach)


def _open_mouth(face: Body, gap: float, scale: float, dark: int) -> Body:
    """Return a face whose lower lip and jaw are moved down by up to so many mm, with a dark hollow between the lips."""
    lips, chin = 52.0, 96.0  # see `drawn_scenes._face`

    def pulled(grid: npt.NDArray, interpolation: int) -> tuple[npt.NDArray, Mask, F64]:
        at = np.linspace(-120, 120, len(grid))
        x, y = np.meshgrid(at, at)
        opened = gap * np.exp(-((x / 26) ** 4))
        below = lips + (y - lips - opened) * (chin + 20 - lips) / (chin + 20 - lips - opened)
        source = np.where(y < lips, y, np.where(y < lips + opened, lips, np.where(y < chin + 20, below, y)))
        rows = ((source / 120 + 1) * 0.5 * (len(grid) - 1)).astype(np.float32)
        columns = np.broadcast_to(np.arange(len(grid), dtype=np.float32), rows.shape)
        hollow = 1 - ((y - lips - 0.5 * opened) / (0.5 * opened + 1e-9)) ** 2
        return cv2.remap(grid, columns, rows, interpolation), (hollow > 0) & (np.abs(x) < 25), hollow

    relief, within, hollow = pulled(face.relief, cv2.INTER_LINEAR)
    painted, dark_within, _ = pulled(face.painted, cv2.INTER_NEAREST)
    relief[within] -= 10 * scale * np.sqrt(hollow[within]) * min(gap, 1.0)
    painted[dark_within] = dark
    return replace(face, relief=relief, painted=painted)


def _talking_head(rig: DrawnRig, seed: int, name: str = "light face") -> Film:
    """Return a head that turns by 25 degrees, nods, moves at up to 100 mm/s and opens its mouth 2 to 4 times a s."""
    still, scale = draw_scene(name, rig, seed), rig.distance_mm / 880
    (face, wall), start = still.bodies, np.random.default_rng([51, seed]).uniform(0, 2 * np.pi, 4)

    def scene(t: float) -> Scene:
        way = np.array([40 * np.sin(2.5 * t + start[0]), 8 * np.sin(1.9 * t + start[1]), 15 * np.sin(1.3 * t)])
        turn = turned(8 * np.sin(2.2 * t + start[2]), 25 * np.sin(2.0 * t + start[3]), 4 * np.sin(1.1 * t))
        said = 0.5 - 0.5 * np.cos(2 * np.pi * (3 * t + np.sin(2 * np.pi * 0.3 * t) / (2 * np.pi * 0.3)))
        head = replace(
            _open_mouth(face, 9 * said, scale, still.names.index("hair")), origin=face.origin + way, turn=turn
        )
        return replace(still, bodies=[head, wall])

    return Film(100.0, 190.0, scene, judged=0, still=1, speeds_mm_s=(100.0,))


def _scattering_head(rig: DrawnRig, seed: int) -> Film:
    """Return a talking head whose skin spreads red light by 2 mm, green by 1 and blue by 0.5 (Gaussian sigmas)."""
    film = _talking_head(rig, seed)
    skin = dict.fromkeys((1, 2, 4), (2.0, 1.0, 0.5))  # skin, lips and spots
    return replace(film, scene=lambda t: replace(film.scene(t), scatter_mm=skin))


def _passing_hand(rig: DrawnRig, seed: int) -> Film:
    """Return a hand that sweeps at 300 mm/s in front of a talking head and back, 60 mm or more before it."""
    head, hand = _talking_head(rig, seed), draw_scene("hand", rig, seed)
    reach, hidden = 240.0, 160.0

    def scene(t: float) -> Scene:
        behind = head.scene(t)
        way = np.array([_to_and_fro(300 * t - reach, reach), 0.0, -150.0])
        skin = len(behind.paints)
        fingers = [replace(body, origin=body.origin + way, paint=skin) for body in hand.bodies[1:]]
        paints, names = [*behind.paints, hand.paints[1]], [*behind.names, "hand"]
        return replace(behind, bodies=[*behind.bodies, *fingers], paints=paints, names=names)

    def hides(t: float) -> bool:
        return abs(_to_and_fro(300 * t - reach, reach) - head.scene(t).bodies[0].origin[0]) < hidden

    return replace(head, speed_mm_s=300.0, fastest_mm_s=300.0, speeds_mm_s=(300.0,), scene=scene, hides=hides)


def _waving_cloth(rig: DrawnRig, seed: int, prints: bool = False) -> Film:
    """Return cloth in waves that travel over it, whose places move towards the camera at up to 100 mm/s."""
    still, half, d = draw_scene("checks", rig, seed), 115.0, rig.distance_mm
    wall = draw_scene("hand", rig, seed)
    at = np.linspace(-half, half, still.bodies[0].relief.shape[0])
    x, y = np.meshgrid(at, at)
    start = np.random.default_rng([52, seed]).uniform(0, 2 * np.pi, 2)
    painted = printed(half, 5 * mm_per_cycle(rig), 0.2) if prints else None
    cloth = Body(RELIEF, np.array([0, 0, d - 20.0]), (half, half, 30.0), 0, turned(6, -8), None, painted)

    def scene(t: float) -> Scene:
        waves = 7 * np.sin(2 * np.pi * (0.8 * x + 0.6 * y) / 130 - 11 * t + start[0])
        waves += 3 * np.sin(2 * np.pi * (0.5 * x - y) / 90 - 8 * t + start[1])
        bodies = [replace(cloth, relief=waves + 12), replace(wall.bodies[0], paint=2)]
        return Scene("cloth", bodies, [*still.paints, wall.paints[0]], [*still.names, "wall"])

    return Film(100.0, 100.0, scene, judged=0, still=1, speeds_mm_s=(100.0,))


def _rolling_ball(rig: DrawnRig, seed: int) -> Film:
    """Return a ball of 90 mm, of two colours, that rolls to and fro on a sloping board, across and up, at 100 mm/s."""
    pale, radius = draw_scene("balls", rig, seed), 45.0
    slope = turned(35, 0)
    above, across = slope.T @ np.array([0, 0, -1.0]), slope.T @ np.array([np.cos(0.6), np.sin(0.6), 0])
    foot = np.array([0, 0, rig.distance_mm + 20.0])
    board = Body(BOX, foot - 10 * above, (rig.distance_mm, rig.distance_mm, 10.0), 0, slope)
    ball = Body(BALL, foot, (radius, radius, 0.0), 1, painted=printed(radius, 45.0, 0.3))

    def scene(t: float) -> Scene:
        way = _to_and_fro(100 * t, 110.0)
        rolled = cv2.Rodrigues(np.cross(above, across) * way / radius)[0]
        bodies = [replace(ball, origin=foot + radius * above + way * across, turn=rolled.T), board]
        return Scene("ball", bodies, pale.paints, pale.names)

    return Film(100.0, 100.0, scene, judged=0, still=1, speeds_mm_s=(20.0, 100.0, 500.0))


FILMS: dict[str, Callable[[DrawnRig, int], Film]] = {
    "talking head": _talking_head,
    "scattering head": _scattering_head,
    "passing hand": _passing_hand,
    "waving cloth": _waving_cloth,
    "printed cloth": lambda rig, seed: _waving_cloth(rig, seed, prints=True),
    "rolling ball": _rolling_ball,
}


# --- the camera ----------------------------------------------------------------------------------------------------


class Filming:
    """Draws the frames of a film before a rig, at a speed; 0: at its own, but at rest while a frame is exposed."""

    def __init__(self, photographer: Photographer, shutter: Shutter, film: Film, speed_mm_s: float, seed: int) -> None:
        self.photographer, self.film, self.seed = photographer, film, seed
        self.frozen = speed_mm_s == 0
        self.shutter = replace(shutter, cycle_s=None) if self.frozen else shutter
        self.pace = 1.0 if self.frozen else speed_mm_s / film.speed_mm_s  # seconds of the film in one of the camera's
        self.calibration = calibration_for(photographer.calibration, PATTERN)
        rig, geometry = photographer.rig, photographer.geometry
        self.mm_per_px = rig.distance_mm / geometry.camera.matrix[0, 0]
        seen_s = shutter.exposure_s + shutter.readout_s
        self.rim_px = _RIM_PX + 0.5 * self.pace * film.fastest_mm_s * seen_s / self.mm_per_px

    @cached_property
    def _arriving(self) -> F32:
        return self.photographer.arriving(self.film.scene(0.0), [self.photographer.codes(PATTERN)])

    @cached_property
    def exposure(self) -> float:
        """By what light is multiplied: the least that one would choose during the film."""
        scenes = [self.film.scene(t) for t in _EXPOSED_AT_S]
        white = self.photographer.arriving(scenes[0], [np.ones_like(self.photographer.codes(PATTERN))])
        seen = (self.photographer.seen(scene, scene.packed(), white)[0] for scene in scenes)
        return min(self.photographer.exposure(film) for film in seen)

    def instants(self, starts: F64) -> F64:
        """Return when the scene is drawn for a frame, s."""
        first, last = starts[0], starts[-1] + self.shutter.exposure_s
        if self.frozen:
            return np.array([0.5 * (first + last)])
        return np.linspace(first, last, 2 + int(self.pace * self.film.fastest_mm_s * (last - first) / _STEP_MM))

    def exposed(self, number: int) -> tuple[F32, Truth, Mask]:
        """Return the linear light (H, W, 3) of a frame, its truth, and what is inside a surface.

        The truth is linear between two instants that show the same body, and that of the nearer one elsewhere.
        """
        photographer, shutter = self.photographer, self.shutter
        width, height = photographer.geometry.camera.size_px
        starts = shutter.row_starts(number, height)
        instants = self.instants(starts)
        weights = shutter.weights(starts, instants)
        middle = np.full(height, starts.mean() + 0.5 * shutter.exposure_s)
        place = np.interp(middle, instants, np.arange(len(instants)))
        before = np.minimum(place.astype(int), max(len(instants) - 2, 0))
        light, pairs = np.zeros((height, width, 3), np.float32), photographer.pairs
        sides = [{key: np.zeros((height, width), kind) for key, kind in _TRUTH.items()} for _ in range(2)]
        for k, (time_s, weight) in enumerate(zip(instants, weights, strict=True)):
            scene = self.film.scene(self.pace * time_s)
            packed = scene.packed()
            if (rows := _span(weight.max(axis=1) > 0)) is not None:
                share = slice(k % pairs, None, min(len(instants), pairs))
                seen = photographer.seen(scene, packed, self._arriving, rows, shutter.cycle_s is not None, share)
                for primary, part in enumerate(seen):  # all primaries at once have the same weight
                    light[rows] += weight[rows, primary, None, None].astype(np.float32) * part
            if (rows := _span((before == k) | (before == k - 1))) is not None:
                truth = true_at_centers(photographer.geometry, packed, rows_of_rays(photographer.rays, rows))
                for side, own in zip(sides, (before[rows] == k, before[rows] == k - 1), strict=True):
                    for key, values in side.items():
                        values[rows][own] = getattr(truth, key)[own]
        return light, *self._between(*(sides if len(instants) > 1 else (sides[0], sides[0])), place - before)

    def _between(self, one: dict[str, F64], other: dict[str, F64], later: F64) -> tuple[Truth, Mask]:
        """Return the truth between two instants, and what is inside a surface."""
        same = (one["body"] == other["body"]) & (np.abs(one["depth_mm"] - other["depth_mm"]) < _EDGE_MM)
        nearer, later = np.rint(later)[:, None] > 0, later[:, None]
        found = {key: np.where(nearer, other[key], one[key]) for key in one}
        for key in ("place", "depth_mm", "mm_per_rad"):
            found[key] = np.where(same, (1 - later) * one[key] + later * other[key], found[key])
        truth = Truth(**{key: values.astype(_TRUTH[key]) for key, values in found.items()})
        edge = ~same | ~one["lit"] | ~other["lit"] | (truth.body == NOTHING)
        for axis in (0, 1):
            step = np.diff(truth.body.astype(int), axis=axis) != 0
            step |= ~(np.abs(np.diff(truth.depth_mm, axis=axis)) < _EDGE_MM)
            edge |= np.pad(step, [(0, 1), (0, 0)][:: 1 - 2 * axis]) | np.pad(step, [(1, 0), (0, 0)][:: 1 - 2 * axis])
        return truth, deeper(~edge, self.rim_px)

    def draw(self, number: int) -> Drawn:
        """Return a frame."""
        light, truth, inside = self.exposed(number)
        levels = sensed(self.photographer.rig, light, self.exposure, 100_000 * self.seed + number)
        signal = self.exposure * light
        lit = truth.lit & (255 * signal.mean(axis=2) > _LIT_LEVELS) & (signal.max(axis=2) < 1)
        place = truth.place.astype(np.float32)
        return Drawn(levels, place, truth.depth_mm, truth.mm_per_rad, truth.body, lit, inside & lit)


def _span(used: Mask) -> slice | None:
    """Return from the first to the last row that is used."""
    rows = np.flatnonzero(used)
    return slice(rows[0], rows[-1] + 1) if len(rows) else None
