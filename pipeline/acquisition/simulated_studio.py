"""A rig of which nothing is there, before which somebody holds a sheet and a board; its time passes as fast as it can.

The projector shows a picture some frames after it was sent, the camera runs freely, and every frame has noise of its
own. The calibration is to be found from the pictures alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from zlib import crc32

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.acquisition.simulated_camera import CameraFaults, SimulatedCamera
from pipeline.acquisition.studio import FRAMES, Guidance
from pipeline.calibration import Calibration
from pipeline.calibration.board import Board
from pipeline.calibration.simulated_board import BoardView, CaptureLight, View
from pipeline.diagnosis.artefacts import BallBar, Plate, Relief
from pipeline.diagnosis.lateral_resolution import relief
from pipeline.models import FloatArray, ImageArray, SensorPart
from pipeline.simulation import TYPICAL_CROSSTALK, simulated_truth

#: The camera's frames.
FRAME_S = 1 / 30
# A picture is on the screen this long after it was sent: two frames of the computer and one of the projector, more or
# less.
_LATENCY_S, _LATENCY_JITTER_S = 0.06, 0.02
# Rays per pixel, along either side, at a board that is at rest: with two, their places move its corners by .026 px,
# with three by no more than corners are found to, .014 px.
_SAMPLES = 3
# Somebody brings a board to its place in this time, in steps, and is off it by so much: deg, mm, part of the distance.
_MOVE_S, _MOVE_STEPS = 8.0, 4
_HAND_DEG, _HAND_MM, _HAND_PART = 4.0, 6.0, 0.02
# Where the board is held at first: (6,) rotation vector and place.
_START = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1100.0])
# What is not seen whole is held nearer to the middle and farther away, by this part of its distance at most.
_HAND_TRIES, _AWAY = 20, 0.3
# The least distance from a view's rim, px, at which a board is seen whole.
_RIM_PX = 3.0
# The sheet is larger than what the camera sees.
_SHEET = Board(kind="chessboard", squares=(11, 8), square_mm=60.0)
_SHEET_TURN, _SHEET_MM = (0.05, 0.1, 0.0), (0.0, 0.0, 900.0)
# Behind a ball bar is a wall; the bar's rod is this part as thick as its balls; bar, or corrugated plate, and wall send
# back these parts of the light. A point is in the shadow of what the projector's light meets before this part of its
# way is left.
_WALL_MM, _ROD, _BAR, _WALL, _SHADOW = 1400.0, 0.25, 0.8, 0.2, 1e-4
# Steps from a plane to its relief: slopes of 0.7 under rays 15 degrees off leave 0.2 of the error in each.
_RELIEF_STEPS = 5


@dataclass(frozen=True)
class StudioFaults:
    """Faults of the simulated rig."""

    mirrored: bool = False  # the projector's picture
    scale: float = 1.0  # of its picture, about its middle
    keystone: float = 0.0  # how much narrower its top is, as a part of its width
    swapped: bool = False  # the camera sends B, G, R
    colour_cycle_s: float | None = None  # the projector's light repeats after this time; None: it is constant
    at_once: bool = False  # in a cycle all colours are lit together, and then none is; else one after another
    shown: FloatArray | None = None  # (3, 2) cycles, when red, green and blue go on and off; None: a third each
    row_s: float = 0.0  # from one row's exposure to the next one's
    jitter_s: float = 0.0  # standard deviation of the times that the camera reports
    focus_px: float = 0.0  # sigma of the projector's blur, of its own px
    light: float = 1.0  # part of the projector's light that the exposure at the start sees
    room: float = 0.0  # room light, of full scale at the exposure at the start; it flickers at 100 Hz
    camera: CameraFaults = field(default_factory=CameraFaults)
    bow_mm: float = 0.0  # of the board
    moved_from: int | None = None  # from which pose on the camera's lens has another focal length, by three thousandths


_NO_FAULTS = StudioFaults()
# Part of a cycle in which colours are lit that come together; and frequency and depth of the room light's flicker.
_LIT_PART, _ROOM_HZ, _ROOM_DEPTH = 0.8, 100.0, 0.6
# Shortest exposure of the simulated camera.
_SHORTEST_S = 2e-5
#: The path of light of the simulated rig.
LIGHT = CaptureLight(gamma=2.0, crosstalk=np.array(TYPICAL_CROSSTALK), blur_px=0.5, noise=1.5)


class SheetView(BoardView):
    """A white sheet, larger than what the camera sees."""

    def __init__(
        self, rig: Calibration, turn: FloatArray, place_mm: FloatArray, light: CaptureLight, samples: int
    ) -> None:
        super().__init__(rig, _SHEET, turn, place_mm, light, samples=samples)

    def drawing(self) -> npt.NDArray[np.uint8]:
        """Return what is printed: nothing."""
        return np.full_like(super().drawing(), 255)


class BarView(View):
    """A ball bar, white and matt, before a grey wall, with the shadows that they cast."""

    def __init__(
        self, rig: Calibration, bar: BallBar, turn: FloatArray, place_mm: FloatArray, light: CaptureLight, samples: int
    ) -> None:
        self._bar = bar
        super().__init__(rig, turn, place_mm, light, samples)

    def _look(self, rays: FloatArray) -> tuple[npt.NDArray[np.float32], FloatArray]:
        lamp = -self.geometry.rotation.T @ self.geometry.translation_mm
        depth, normal = self._meets(np.zeros(3), rays)
        points = rays * depth[..., None]
        path = points - lamp
        distance = np.linalg.norm(path, axis=-1)
        faces = -(normal * path).sum(axis=-1) / distance
        lit = (faces > 0) & (self._meets(lamp, path)[0] > 1 - _SHADOW)
        ink = np.where(points[..., 2] < _WALL_MM - 1, _BAR, _WALL)
        return np.asarray(ink * lit * faces * (self.place_mm[2] / distance) ** 2, np.float32), points

    def _meets(self, origin: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return after how many of themselves rays (.., 3) meet something, and the normals (.., 3) there."""
        radius, along = self._bar.diameter_mm / 2, self.rotation[:, 0]
        half_mm = self._bar.spacing_mm / 2
        nearest = (_WALL_MM - origin[2]) / rays[..., 2]
        normal = np.broadcast_to([0.0, 0.0, -1.0], rays.shape).copy()
        across = np.eye(3) - np.outer(along, along)  # of a rod the direction along it does not count
        for middle, size, flat in (
            (self.place_mm, _ROD * radius, across),
            (self.place_mm - half_mm * along, radius, np.eye(3)),
            (self.place_mm + half_mm * along, radius, np.eye(3)),
        ):
            start, way = (origin - middle) @ flat, rays @ flat
            a, b = np.einsum("...i,...i", way, way), way @ start
            square = b * b - a * (start @ start - size * size)
            near = np.nonzero(square > 0)
            t = (-b[near] - np.sqrt(square[near])) / a[near]
            beyond_mm = np.abs((origin - middle + rays[near] * t[:, None]) @ along) - half_mm
            hit = (t > 0) & (t < nearest[near]) & (beyond_mm < 0)  # no ball reaches so far along the rod
            near = tuple(places[hit] for places in near)
            nearest[near] = t[hit]
            normal[near] = (start + way[near] * t[hit, None]) / size
        return nearest, normal


class ReliefView(View):
    """A corrugated plate, white and matt, before nothing."""

    def __init__(
        self, rig: Calibration, plate: Relief, turn: FloatArray, place_mm: FloatArray, light: CaptureLight, samples: int
    ) -> None:
        self._plate = plate
        super().__init__(rig, turn, place_mm, light, samples)

    def _look(self, rays: FloatArray) -> tuple[npt.NDArray[np.float32], FloatArray]:
        profile, _, normal = self.rotation.T
        points = rays * (self.place_mm @ normal / (rays @ normal))[..., None]
        there = (np.abs((points - self.place_mm) @ self.rotation)[..., :2] < self._plate.size_mm / 2).all(axis=-1)
        for _ in range(_RELIEF_STEPS):
            height, slope = relief((points[there] - self.place_mm) @ profile)
            points[there] = rays[there] * ((self.place_mm @ normal - height) / (rays[there] @ normal))[..., None]
        path = points[there] + self.geometry.rotation.T @ self.geometry.translation_mm
        faces = (normal + slope[..., None] * profile) / np.sqrt(1 + slope**2)[..., None]  # away from the camera
        seen = np.zeros(there.shape, np.float32)
        seen[there] = _BAR * np.maximum(np.sum(faces * path, axis=-1) / np.linalg.norm(path, axis=-1), 0)
        return seen, points


class SimulatedStudio:
    """A `Studio` that is simulated.

    Parameters
    ----------
    held : Board, BallBar, Plate or Relief, optional
        Object that is held before it; None: a white sheet.
    exposure_s : float
        The camera's.
    notify : callable, optional
        Called with the line of every guidance.
    truth : Calibration, optional
        The rig's geometry; None: `simulated_truth`.
    light : CaptureLight
        Light between the projector's codes and the camera's levels.
    faults : StudioFaults
        Faults of the rig.
    seed : int, optional
        Of its noise and its operator's hands; None: fresh ones.

    Attributes
    ----------
    n_acts : int
        Number of its operator's actions.
    """

    def __init__(
        self,
        held: Board | BallBar | Plate | None,
        exposure_s: float = 1 / 60,
        notify: Callable[[str], None] = lambda line: None,
        *,
        truth: Calibration | None = None,
        light: CaptureLight = LIGHT,
        faults: StudioFaults = _NO_FAULTS,
        seed: int | None = None,
    ) -> None:
        self.n_acts = 0 if held is not None else 1
        self._held, self._exposure_s, self._notify, self._faults, self._seed = held, exposure_s, notify, faults, seed
        self._truth, self._path = simulated_truth() if truth is None else truth, light
        self._rng = np.random.default_rng(seed)
        self._camera = SimulatedCamera(faults.camera, light.noise, self._rng)
        self._first_exposure_s, self._gain, self._phase_s = exposure_s, 1.0, 0.0
        self._time_s = 0.0
        self._starts_s: list[float] = []  # of the last exposures
        self._sent: list[tuple[float, npt.NDArray[np.uint8]]] = []  # when each picture comes on, newest last
        self._pose = ""
        self._way: tuple[FloatArray, FloatArray, float] = (_START, _START, -_MOVE_S)  # from, to, since
        self._view_of = lru_cache(maxsize=1)(self._look)
        self._light_of: tuple[tuple[object, ...], npt.NDArray[np.float32]] | None = None

    @property
    def projector_px(self) -> tuple[int, int]:
        """Width and height of the projector's pictures."""
        return self._truth.geometry().projector.size_px

    @property
    def exposures_s(self) -> tuple[float, float]:
        """Shortest and longest exposure; see `Studio`."""
        return _SHORTEST_S, FRAME_S

    @property
    def sensor(self) -> SensorPart | None:
        """The part of the sensor; see `Studio`."""
        return None

    @property
    def taken_s(self) -> list[float]:
        """Times of the last frames' exposures; see `Studio`."""
        return [start_s + self._faults.jitter_s * self._rng.standard_normal() for start_s in self._starts_s]

    @property
    def is_mosaic(self) -> bool:
        """Return False: frames come from no mosaic."""
        return False

    def set_camera(self, exposure_s: float, gain_db: float) -> float:
        """Have the camera start afresh with an exposure and a gain; see `Studio`."""
        self._exposure_s, self._gain = exposure_s, 10 ** (gain_db / 20)
        self._phase_s = float(self._rng.uniform(0, FRAME_S))
        return exposure_s

    def now_s(self) -> float:
        """Return the time."""
        return self._time_s

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self._time_s += seconds

    def show(self, picture: npt.NDArray[np.uint8]) -> None:
        """Send a picture to the projector; see `Studio`."""
        latency_s = _LATENCY_S + _LATENCY_JITTER_S * self._rng.uniform(-1, 1)
        self._sent = [*self._sent[-1:], (self._time_s + latency_s, self._projected(picture))]

    def take(self) -> list[ImageArray]:
        """Return frames; see `Studio`."""
        # The camera runs freely: an exposure begins with every whole frame.
        number = int(np.ceil((self._time_s - self._phase_s) / FRAME_S))
        self._starts_s = (self._phase_s + FRAME_S * (number + np.arange(FRAMES))).tolist()
        frames = []
        for start_s in self._starts_s:
            frames.append(self._exposed(start_s))
            self._time_s = start_s + FRAME_S
        return frames

    def guide(self, guidance: Guidance) -> None:
        """Have the operator go where the guidance leads; see `Studio`."""
        self._notify(guidance.line)
        pose = guidance.line.partition(":")[0]
        if guidance.outline_px is None or pose == self._pose:
            return
        self.n_acts += 1
        self._pose = pose
        self._way = (self._stands(self._time_s)[0], self._hands(pose, guidance.outline_px), self._time_s)

    def key_pressed(self) -> bool:
        """Return False: this operator holds things still."""
        return False

    def close(self) -> None:
        """Do nothing: nothing is there."""

    def _projected(self, picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return a picture as the projector shows it."""
        faults = self._faults
        if faults.mirrored:
            picture = np.ascontiguousarray(picture[:, ::-1])
        if faults.scale != 1 or faults.keystone:
            picture = self._resampled(picture)
        if faults.focus_px:
            light = cv2.GaussianBlur((picture / np.float32(255)) ** self._path.gamma, (0, 0), faults.focus_px)
            picture = np.rint(255 * light ** (1 / self._path.gamma)).astype(np.uint8)
        return picture

    def _resampled(self, picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return a picture that is scaled, or has the form of a trapezium."""
        faults = self._faults
        height, width = picture.shape[:2]
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
        middle = np.array([width, height], np.float32) / 2
        places = middle + faults.scale * (corners - middle)
        places[:2, 0] += np.float32(faults.keystone * width / 2) * np.array([1, -1], np.float32)
        return np.asarray(cv2.warpPerspective(picture, cv2.getPerspectiveTransform(corners, places), (width, height)))

    def _hands(self, pose: str, outline: FloatArray) -> FloatArray:
        """Return where a board is held, (6,) rotation vector and mm, that is to fill an outline."""
        lens = self._truth.geometry().camera
        found = cv2.solvePnP(self._outline_mm(), outline, lens.matrix, lens.distortion)
        turn, place = (each.ravel() for each in found[1:])
        # The same hands at the same pose: a capture that was stopped finds the board where it was.
        rng = np.random.default_rng([self._seed or 0, crc32(pose.encode())])
        for inwards in np.linspace(1.0, 0.0, _HAND_TRIES):
            stands = np.concatenate([turn, place * (inwards, inwards, 1 + _AWAY * (1 - inwards))])
            stands[:3] += np.radians(_HAND_DEG) * rng.standard_normal(3)
            stands[3:] *= 1 + _HAND_PART * rng.standard_normal()
            stands[3:] += _HAND_MM * rng.standard_normal(3)
            if self._is_seen(stands):
                break
        return stands

    def _is_seen(self, stands: FloatArray) -> bool:
        """Return whether camera and projector see a whole board."""
        geometry = self._truth.geometry()
        outline = self._outline_mm() @ cv2.Rodrigues(stands[:3])[0].T + stands[3:]
        here, there = (np.zeros(3), np.zeros(3)), (cv2.Rodrigues(geometry.rotation)[0], geometry.translation_mm)
        for lens, (turn, place) in ((geometry.camera, here), (geometry.projector, there)):
            pixels, _ = cv2.projectPoints(outline, turn, place, lens.matrix, lens.distortion)
            if (pixels < _RIM_PX).any() or (pixels > np.array(lens.size_px) - 1 - _RIM_PX).any():
                return False
        return True

    def _outline_mm(self) -> FloatArray:
        return (_SHEET if self._held is None else self._held).outline_mm()

    def _stands(self, time_s: float) -> tuple[FloatArray, bool]:
        """Return where the board is, (6,), and whether it is at rest."""
        before, to, since_s = self._way
        step = min(1 + int(_MOVE_STEPS * (time_s - since_s) / _MOVE_S), _MOVE_STEPS)
        return before + (to - before) * step / _MOVE_STEPS, step == _MOVE_STEPS

    def _look(self, stands: tuple[float, ...], samples: int, zoom: float) -> View:
        rig = self._truth
        if zoom != 1 and rig.camera is not None:
            matrix = rig.camera.matrix * np.array([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]])
            rig = rig.replace(camera=rig.camera.replace(matrix=matrix))
        turn, place = np.array(stands[:3]), np.array(stands[3:])
        if isinstance(self._held, BallBar):
            return BarView(rig, self._held, turn, place, self._path, samples)
        if isinstance(self._held, Relief):
            return ReliefView(rig, self._held, turn, place, self._path, samples)
        if isinstance(self._held, Board):
            return BoardView(rig, self._held, turn, place, self._path, samples=samples, bow_mm=self._faults.bow_mm)
        return SheetView(rig, turn, place, self._path, samples)

    def _light(self, time_s: float, picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        """Return the light that the camera sees of a picture, (H, W, 3)."""
        stands, at_rest = (np.array([*_SHEET_TURN, *_SHEET_MM]), True) if self._held is None else self._stands(time_s)
        faults = self._faults
        moved = faults.moved_from is not None and self.n_acts >= faults.moved_from
        key = (*stands, at_rest, moved, id(picture))
        if self._light_of is None or self._light_of[0] != key:
            view = self._view_of(tuple(stands.tolist()), _SAMPLES if at_rest else 1, 1.003 if moved else 1.0)
            codes = picture.astype(np.float32) / 255
            if (picture == picture[..., :1]).all():
                codes = np.broadcast_to(codes[..., :1], codes.shape)
            self._light_of = key, view.arrives(codes)
        return self._light_of[1]

    def _exposed(self, start_s: float) -> ImageArray:
        """Return the frame of one exposure; a picture that comes on meanwhile is seen for the rest of it."""
        light = np.zeros(1, np.float32)
        since_s = start_s
        for n, (_, picture) in enumerate(self._sent):
            ends_s = self._sent[n + 1][0] if n + 1 < len(self._sent) else np.inf
            share = (min(ends_s, start_s + self._exposure_s) - since_s) / self._exposure_s
            if share >= 1:
                light = self._light(start_s, picture)
                break
            if share > 0:
                light = light + np.float32(share) * self._light(start_s, picture)
                since_s = ends_s
        width, height = self._truth.geometry().camera.size_px
        faults = self._faults
        seen = self._exposure_s / self._first_exposure_s * self._gain  # compared with the start
        rows_s = np.asarray(start_s + faults.row_s * np.arange(height if faults.row_s else 1))[:, None, None]
        parts = seen * faults.light * self._shares_of_cycle(rows_s)
        light = np.broadcast_to(light, (height, width, 3)) * parts.astype(np.float32)
        if faults.room:
            light += (seen * faults.room * self._room(rows_s)).astype(np.float32)
        levels = self._camera.develop(light, start_s)
        return np.ascontiguousarray(levels[..., ::-1]) if faults.swapped else levels

    def _room(self, start_s: FloatArray) -> FloatArray:
        """Return the room light during exposures, 1 in the mean."""
        turn = 2 * np.pi * _ROOM_HZ
        swing = np.cos(turn * start_s) - np.cos(turn * (start_s + self._exposure_s))
        return np.asarray(1 + _ROOM_DEPTH * swing / (turn * self._exposure_s))

    def _shares_of_cycle(self, start_s: FloatArray) -> FloatArray:
        """Return how much of each colour exposures see, (.., 3), 1 where they are a whole number of cycles."""
        cycle_s = self._faults.colour_cycle_s
        if cycle_s is None:
            return np.ones(3)
        if self._faults.at_once:
            shown = np.array([[0, _LIT_PART]] * 3)
        elif self._faults.shown is not None:
            shown = self._faults.shown
        else:
            shown = np.arange(3)[:, None] / 3 + np.array([0, 1 / 3])
        begins_s, lasts_s = cycle_s * shown[:, 0], cycle_s * np.diff(shown)[:, 0]

        def lit_s(until_s: FloatArray) -> FloatArray:
            whole, rest_s = np.divmod(until_s - begins_s, cycle_s)
            return np.asarray(whole * lasts_s + np.minimum(rest_s, lasts_s))

        lit = (lit_s(start_s + self._exposure_s) - lit_s(start_s)) / (lasts_s * self._exposure_s / cycle_s)
        return np.asarray(lit)
