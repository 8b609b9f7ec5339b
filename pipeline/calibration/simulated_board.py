"""Captures of a flat board under any pictures, by tracing camera rays to its plane: a rig to practise calibration on.

Written apart from the library's renderer, in NumPy and OpenCV alone, so that what is measured in them is no check of
that renderer against itself.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration.board import Board
from pipeline.calibration.lens import Lens
from pipeline.calibration.model import Calibration
from pipeline.models import FloatArray

FloatImage = npt.NDArray[np.float32]
_Place = tuple[float, float]

# Texels of a drawn square: three times what the camera resolves of one of 26 px.
_TEXELS = 80
# What the board's black and white ink send back.
_BLACK, _WHITE = 0.05, 0.8
# Steps from a plane to a bent board: each leaves a hundredth of what the one before did.
_BEND_STEPS = 3
# Ambient light, over the projector's white.
_AMBIENT = 0.02


@dataclass(frozen=True)
class CaptureLight:
    """The path of light and grey levels from a picture to its capture."""

    gamma: float = 2.0  # the projector's response: light = code ** gamma
    crosstalk: FloatArray | None = None  # (3, 3) camera = matrix @ projector in linear light; None: none
    camera_shift: FloatArray | None = None  # (3, 2) px, lateral colour: x, y of R, G, B; None: none
    projector_shift: FloatArray | None = None
    blur_px: float = 0.0  # sigma of the camera's lens
    noise: float = 1.0  # standard deviation, of 255 levels


_LIGHT = CaptureLight()


class View(ABC):
    """A thing as a camera sees it under any picture.

    Parameters
    ----------
    rig : Calibration
        With a geometry.
    turn : (3,)
        The thing's rotation vector.
    place_mm : (3,)
        Place of its middle, in the camera's frame.
    light : CaptureLight
        Light on the way.
    samples : int
        Rays per pixel, along either side.
    """

    def __init__(
        self,
        rig: Calibration,
        turn: FloatArray | tuple[float, float, float],
        place_mm: FloatArray | tuple[float, float, float],
        light: CaptureLight,
        samples: int,
    ) -> None:
        self.turn, self.place_mm = np.asarray(turn, np.float64), np.asarray(place_mm, np.float64)
        self.light, self.samples = light, samples
        self.crosstalk = np.eye(3) if light.crosstalk is None else np.asarray(light.crosstalk)
        nowhere = np.zeros((3, 2))
        self.camera_shift = nowhere if light.camera_shift is None else np.asarray(light.camera_shift)
        self.projector_shift = nowhere if light.projector_shift is None else np.asarray(light.projector_shift)
        self.geometry = geometry = rig.geometry()
        self.size = geometry.camera.size_px
        self.rotation = cv2.Rodrigues(self.turn)[0]
        # Of each of the camera's lateral shifts: what is seen, and the projector pixel that lights it.
        self._views: dict[_Place, tuple[FloatImage, FloatImage]] = {}
        lens = geometry.camera.model_dump_json()
        for shift in {_place(row) for row in self.camera_shift}:
            reflectance, points = self._look(_rays(lens, samples, shift))
            in_projector = points.reshape(-1, 3) @ geometry.rotation.T + geometry.translation_mm
            pixels = _seen_by(geometry.projector, in_projector).reshape(*reflectance.shape, 2)
            self._views[shift] = reflectance, pixels

    @abstractmethod
    def _look(self, rays: FloatArray) -> tuple[FloatImage, FloatArray]:
        """Return what rays (H, W, 3) of unit depth meet: its reflectance (H, W), and where it is, (H, W, 3) mm."""

    def arrives(self, codes: npt.NDArray[np.floating]) -> FloatImage:
        """Return the light that the camera's pixels see, (H, W, 3), 1 at full scale.

        Parameters
        ----------
        codes : (height, width, 3)
            The projector's, 0..1.
        """
        is_grey = codes.strides[2] == 0  # one plane, broadcast to three
        gamma = self.light.gamma
        planes = [np.power(codes[..., k], gamma, dtype=np.float32) for k in range(1 if is_grey else 3)]
        width, height = self.size
        channels = np.zeros((height, width, 3), np.float32)
        landed: dict[tuple[_Place, _Place, int], FloatImage] = {}  # a plane's light where a camera channel looks
        for i in range(3):
            place = _place(self.camera_shift[i])
            reflectance, position = self._views[place]
            for k in range(3):
                if self.crosstalk[i, k] == 0:
                    continue
                # A channel whose light lands off its place shows there what belongs elsewhere.
                offset, plane = _place(self.projector_shift[k]), 0 if is_grey else k
                if (place, offset, plane) not in landed:
                    at = position - np.array(offset, np.float32)
                    light = cv2.remap(planes[plane], at[..., 0], at[..., 1], cv2.INTER_LINEAR)
                    landed[place, offset, plane] = self._averaged(reflectance * light)
                channels[..., i] += np.float32(self.crosstalk[i, k]) * landed[place, offset, plane]
            channels[..., i] += _AMBIENT * self._averaged(reflectance)
        if self.light.blur_px:
            channels = np.asarray(cv2.GaussianBlur(channels, (0, 0), self.light.blur_px), np.float32)
        return channels

    def photograph(self, codes: npt.NDArray[np.floating], rng: np.random.Generator) -> npt.NDArray[np.uint8]:
        """Return a frame, (H, W, 3), under a picture."""
        channels = self.arrives(codes)
        levels = 255 * channels + self.light.noise * rng.standard_normal(channels.shape, dtype=np.float32)
        return np.clip(np.rint(levels), 0, 255).astype(np.uint8)

    def _averaged(self, fine: FloatImage) -> FloatImage:
        """Return the mean of each pixel's samples."""
        return np.asarray(cv2.resize(fine, self.size, interpolation=cv2.INTER_AREA), np.float32)


class BoardView(View):
    """A board, as `View` describes it.

    Parameters
    ----------
    board : Board
        With a margin of one square of white around it; beyond it is nothing.
    bow_mm : float
        Distance by which its left and right edges are bent away from the camera.
    """

    def __init__(
        self,
        rig: Calibration,
        board: Board,
        turn: FloatArray | tuple[float, float, float],
        place_mm: FloatArray | tuple[float, float, float],
        light: CaptureLight = _LIGHT,
        *,
        samples: int = 2,
        bow_mm: float = 0.0,
    ) -> None:
        self.board, self.bow_mm = board, bow_mm
        super().__init__(rig, turn, place_mm, light, samples)
        self.corners_camera = board.corners_mm() @ self.rotation.T + self._origin_mm()  # (N, 3) mm

    def drawing(self) -> npt.NDArray[np.uint8]:
        """Return what is printed, without margin."""
        return self.board.draw(_TEXELS)

    def _origin_mm(self) -> FloatArray:
        """Return where the outer corner of the board's first square lies."""
        return np.asarray(
            self.place_mm - self.rotation @ (np.array([*self.board.squares, 0]) / 2) * self.board.square_mm
        )

    def _look(self, rays: FloatArray) -> tuple[FloatImage, FloatArray]:
        side_mm, origin, normal = self.board.square_mm, self._origin_mm(), self.rotation[:, 2]
        half_mm = self.board.squares[0] * side_mm / 2
        bend: FloatArray | float = 0.0
        for _ in range(_BEND_STEPS if self.bow_mm else 1):
            points = rays * ((origin @ normal + bend) / (rays @ normal))[..., None]
            on_board = (points - origin) @ self.rotation
            bend = self.bow_mm * (on_board[..., 0] / half_mm - 1) ** 2
        ink = _BLACK + (_WHITE - _BLACK) * np.pad(self.drawing() / np.float32(255), _TEXELS, constant_values=1.0)
        # The texture has a margin of one square.
        place = (on_board[..., :2] * (_TEXELS / side_mm) + _TEXELS - 0.5).astype(np.float32)
        nothing = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 0}
        seen = cv2.remap(np.asarray(ink, np.float32), place[..., 0], place[..., 1], cv2.INTER_LINEAR, **nothing)
        return np.asarray(seen, np.float32), points


class BoardCaptures(BoardView, Mapping[str, npt.NDArray[np.uint8]]):
    """The captures of one pose, rendered on demand.

    Parameters
    ----------
    rig, board, turn, place_mm, light, samples
        As for `BoardView`.
    names : sequence of str
        The pictures, in order.
    codes : callable
        From a name to (height, width, 3) projector codes, 0..1.
    seed : int
        Of the noise.
    """

    def __init__(
        self,
        rig: Calibration,
        board: Board,
        turn: FloatArray | tuple[float, float, float],
        place_mm: FloatArray | tuple[float, float, float],
        names: tuple[str, ...],
        codes: Callable[[str], FloatArray],
        light: CaptureLight = _LIGHT,
        *,
        seed: int = 0,
        samples: int = 2,
    ) -> None:
        super().__init__(rig, board, turn, place_mm, light, samples=samples)
        self.names, self.codes, self.seed = names, codes, seed
        self._pictures: dict[str, npt.NDArray[np.uint8]] = {}

    def __getitem__(self, name: str) -> npt.NDArray[np.uint8]:
        """Return one capture, (H, W, 3) uint8."""
        if name not in self._pictures:
            self._pictures[name] = self._photograph(name)
        return self._pictures[name]

    def _photograph(self, name: str) -> npt.NDArray[np.uint8]:
        return self.photograph(self.codes(name), np.random.default_rng([self.seed, self.names.index(name)]))

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names in order."""
        return iter(self.names)

    def __len__(self) -> int:
        """Return how many captures there are."""
        return len(self.names)


def board_turns(count: int = 10, seed: int = 1) -> tuple[list[FloatArray], FloatArray]:
    """Return rotation vectors of boards tilted by 15 to 35 degrees every way, and places around (0, 0, 900) mm."""
    rng = np.random.default_rng(seed)
    around = 2 * np.pi * (np.arange(count) + 0.3) / count
    tilt = np.radians(rng.uniform(15, 35, count))
    turns = [
        cv2.Rodrigues(
            cv2.Rodrigues(t * np.array([np.cos(a), np.sin(a), 0.0]))[0] @ cv2.Rodrigues(np.array([0, 0, s]))[0]
        )[0].ravel()
        for a, t, s in zip(around, tilt, rng.uniform(-0.2, 0.2, count), strict=True)
    ]
    places = np.stack([rng.uniform(-25, 25, count), rng.uniform(-20, 20, count), rng.uniform(840, 960, count)], axis=1)
    return turns, places


@lru_cache(maxsize=4)  # of a thing that moves and one at rest
def _rays(lens: str, samples: int, shift: _Place) -> FloatArray:
    """Return the rays of unit depth, (H, W, 3), of so many samples along either side of every pixel."""
    camera = Lens.model_validate_json(lens)
    step = (np.arange(samples) + 0.5) / samples - 0.5
    x, y = ((np.arange(side)[:, None] + step).ravel() for side in camera.size_px)
    rays = camera.rays_through(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) - np.array(shift))
    return np.insert(rays, 2, 1.0, axis=1).reshape(len(y), len(x), 3)


def _place(shift: FloatArray) -> _Place:
    return float(shift[0]), float(shift[1])


def _seen_by(lens: Lens, points: FloatArray) -> FloatImage:
    """Return the pixels at which a lens sees points in its frame, (N, 2); cv2.projectPoints takes ten times as long."""
    if len(lens.distortion) > 5:
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
        return np.asarray(pixels[:, 0], np.float32)
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    k1, k2, p1, p2, k3 = lens.distortion
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    bent_y = y * radial + 2 * p2 * x * y + p1 * (square + 2 * y * y)
    bent = np.stack([bent_x, bent_y], axis=-1)
    return np.asarray(bent * lens.matrix[[0, 1], [0, 1]] + lens.matrix[:2, 2], np.float32)
