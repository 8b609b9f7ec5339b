"""Ball bar and plate, and the seven positions in the measuring volume that each is measured in; and a corrugated plate.

VDI/VDE 2634 Part 2 requires a bar of two balls in seven positions, which differ in place and direction, and a plane
in six or more.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.calibration.model import Geometry
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray

# Parts of the distance: those of a calibration board's poses.
_NEAR, _MIDDLE, _FAR = 0.92, 1.0, 1.1
# An artefact ends this part of the view's width away from its rim: it is held by hand. What does not is moved inwards.
_RIM, _INWARDS = 0.05, np.linspace(1.0, 0.0, 21)
# The plate's sides, as parts of the field where it is nearest.
_PLATE = 0.7
# A side of the corrugated plate, mm: twelve of its longest periods.
_RELIEF_MM = 120.0
# What leans does so by this angle: of lengths in depth it shows half.
_LEAN = np.radians(30)
_SLANT = np.array([np.cos(_LEAN) / np.sqrt(2)] * 2)  # a diagonal's x and y
# How a bar is held: in words, its direction, which way it is aside, and the part of the distance.
_BARS = (
    ("level, at the top of the picture, far", (1, 0, 0), (0, -1), _FAR),
    ("level, at the bottom of the picture, near", (1, 0, 0), (0, 1), _NEAR),
    ("upright, on the left, near", (0, 1, 0), (-1, 0), _NEAR),
    ("upright, on the right, far", (0, 1, 0), (1, 0), _FAR),
    ("rising to the right, its right end 30 deg nearer", (_SLANT[0], -_SLANT[1], -np.sin(_LEAN)), (0, 0), _MIDDLE),
    ("falling to the right, its right end 30 deg farther", (_SLANT[0], _SLANT[1], np.sin(_LEAN)), (0, 0), _MIDDLE),
    ("level, in the middle, its right end 45 deg farther", (np.sqrt(0.5), 0, np.sqrt(0.5)), (0, 0), _MIDDLE),
)
# How a plate is held: in words, the rotation vector, and the part of the distance.
_PLATES = (
    ("facing the camera, at the middle distance", (0, 0, 0), _MIDDLE),
    ("facing the camera, near", (0, 0, 0), _NEAR),
    ("facing the camera, far", (0, 0, 0), _FAR),
    ("its right edge 30 deg nearer", (0, _LEAN, 0), _MIDDLE),
    ("its left edge 30 deg nearer", (0, -_LEAN, 0), _MIDDLE),
    ("its upper edge 30 deg nearer", (_LEAN, 0, 0), _MIDDLE),
    ("its lower edge 30 deg nearer", (-_LEAN, 0, 0), _MIDDLE),
)
# How a corrugated plate is held, in words.
_RELIEFS = tuple(f"facing the camera, its ridges {way} the stripes" for way in ("along", "at right angles to"))
_Way = tuple[str, tuple[float, float, float], float]


@dataclass(frozen=True)
class Volume:
    """The measuring volume: what the camera sees from 0.92 to 1.1 of a distance."""

    geometry: Geometry
    distance_mm: float

    @classmethod
    def before(cls, geometry: Geometry, distance_mm: float | None) -> "Volume":
        """Return the volume about a distance; None: about the place where the axes of camera and projector meet.

        Raises
        ------
        CalibrationError
            They do not meet.
        """
        distance_mm = distance_mm or geometry.working_distance_mm()
        if distance_mm is None:
            raise CalibrationError(
                "camera and projector look past each other: give the distance of the measuring volume"
            )
        return cls(geometry, distance_mm)

    def middle_mm(self, part: float) -> FloatArray:
        """Return its middle at a part of the distance, (3,)."""
        ((x, y),) = self.geometry.camera.rays_through((np.array([self.geometry.camera.size_px]) - 1) / 2)
        return part * self.distance_mm * np.array([x, y, 1.0])

    def half_field_mm(self, part: float) -> FloatArray:
        """Return half its width and height at a part of the distance, (2,)."""
        lens = self.geometry.camera
        return np.asarray(lens.size_px / lens.matrix[[0, 1], [0, 1]] / 2 * part * self.distance_mm)

    def outline_px(self, corners_mm: FloatArray) -> FloatArray:
        """Return where the camera sees points (N, 3), px."""
        lens = self.geometry.camera
        return np.asarray(
            cv2.projectPoints(corners_mm, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)[0][:, 0]
        )

    def holds(self, corners_mm: FloatArray) -> bool:
        """Return whether camera and projector see all of some points (N, 3)."""
        for lens, pixels in (
            (self.geometry.camera, self.outline_px(corners_mm)),
            (self.geometry.projector, self.geometry.projector_px(corners_mm)),
        ):
            rim = _RIM * lens.size_px[0]
            if (pixels < rim).any() or (pixels > np.array(lens.size_px) - 1 - rim).any():
                return False
        return True


@dataclass(frozen=True, eq=False)
class Position:
    """A place where an artefact is to be held."""

    name: str
    words: str
    turn: FloatArray  # (3,) rotation vector
    place_mm: FloatArray  # (3,) its middle, in the camera's frame
    outline_px: FloatArray  # (4, 2) in the camera's picture

    @property
    def line(self) -> str:
        """The instruction to the operator: how to hold it, and how far away."""
        return f"hold it {self.words}, {self.place_mm[2]:.0f} mm away"


@dataclass(frozen=True)
class BallBar:
    """Two matt balls of one diameter, joined by a rod along the artefact's x axis."""

    diameter_mm: float
    spacing_mm: float  # of their centres

    def outline_mm(self) -> FloatArray:
        """Return the corners around it, about its middle, (4, 3) mm."""
        return _rectangle(self.spacing_mm + self.diameter_mm, self.diameter_mm)

    def centres_mm(self, position: Position) -> FloatArray:
        """Return where the balls' centres are, (2, 3) mm."""
        half = cv2.Rodrigues(position.turn)[0][:, 0] * self.spacing_mm / 2
        return np.stack([position.place_mm - half, position.place_mm + half])

    def positions(self, volume: Volume) -> Iterator[Position]:
        """Yield the seven positions of the bar.

        Raises
        ------
        CalibrationError
            The bar does not fit into the measuring volume.
        """
        for k, (words, direction, aside, part) in enumerate(_BARS, start=1):
            x = np.array(direction, np.float64)
            z = np.array([0.0, 0, 1]) - x[2] * x
            z /= np.linalg.norm(z)
            rotation = np.column_stack([x, np.cross(z, x), z])
            for inwards in _INWARDS:
                place = volume.middle_mm(part)
                place[:2] += inwards * np.array(aside) * volume.half_field_mm(part)
                corners = self.outline_mm() @ rotation.T + place
                if volume.holds(corners):
                    break
            else:
                raise CalibrationError(
                    f"a bar {self.spacing_mm + self.diameter_mm:g} mm long is not seen whole by camera and projector "
                    f"{place[2]:.0f} mm away: take a shorter one"
                )
            yield Position(f"bar-{k}", words, cv2.Rodrigues(rotation)[0].ravel(), place, volume.outline_px(corners))


@dataclass(frozen=True)
class Plate:
    """A matt plane that fills the measuring volume."""

    size_mm: FloatArray  # (2,) width, height

    @classmethod
    def within(cls, volume: Volume) -> "Plate":
        """Return one that camera and projector see whole."""
        return cls(2 * _PLATE * volume.half_field_mm(_NEAR))

    def outline_mm(self) -> FloatArray:
        """Return its corners about its middle, (4, 3) mm."""
        return _rectangle(*self.size_mm)

    def positions(self, volume: Volume) -> Iterator[Position]:
        """Yield the seven positions of the plate."""
        return self._held(volume, "plane", _PLATES)

    def _held(self, volume: Volume, name: str, ways: Sequence[_Way]) -> Iterator[Position]:
        for k, (words, turns, part) in enumerate(ways, start=1):
            turn, place = np.array(turns, np.float64), volume.middle_mm(part)
            corners = self.outline_mm() @ cv2.Rodrigues(turn)[0].T + place
            yield Position(f"{name}-{k}", words, turn, place, volume.outline_px(corners))


class Relief(Plate):
    """A square plate whose height changes along its x axis; see `lateral_resolution`."""

    @classmethod
    def within(cls, volume: Volume) -> "Relief":
        """Return the usual one, or as much of it as camera and projector see."""
        side_mm = min(_RELIEF_MM, *Plate.within(volume).size_mm)
        return cls(np.array([side_mm, side_mm]))

    def positions(self, volume: Volume) -> Iterator[Position]:
        """Yield the two positions of the plate: its height changes across the stripes, and along them."""
        turns = [(0, 0, np.pi / 2), (0, 0, 0)]
        ways = zip(_RELIEFS, turns if volume.geometry.phase_axis == 1 else turns[::-1], strict=True)
        return self._held(volume, "relief", [(words, turn, _MIDDLE) for words, turn in ways])


def positions_in(volume: Volume, bar: BallBar, *, relief: bool = False) -> list[Position]:
    """Return the positions of a bar, then those of the plate, and of the corrugated plate if there is one."""
    reliefs = Relief.within(volume).positions(volume) if relief else ()
    return [*bar.positions(volume), *Plate.within(volume).positions(volume), *reliefs]


def _rectangle(width: float, height: float) -> FloatArray:
    return np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * (width / 2, height / 2, 0)
