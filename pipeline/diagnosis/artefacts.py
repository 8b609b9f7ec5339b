"""Ball bar and plate, and the seven positions in the measuring volume that each is measured in.

VDI/VDE 2634 Part 2 asks for a bar of two balls in seven positions, which differ in place and direction, and for a plane
in six or more. The volume is what the camera sees from 0.92 to 1.1 of the working distance, where its axis and the
projector's come closest: the places of a calibration board.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.calibration.model import Geometry
from pipeline.errors import CalibrationError
from pipeline.models import FloatArray

# Parts of the working distance.
_NEAR, _MIDDLE, _FAR = 0.92, 1.0, 1.1
# An artefact ends this part of the view's width away from its rim: it is held by hand. What does not is moved inwards.
_RIM, _INWARDS = 0.05, np.linspace(1.0, 0.0, 21)
# The plate's sides, as parts of the field where it is nearest.
_PLATE = 0.7
# What leans does so by this angle: of lengths in depth it shows half.
_LEAN = np.radians(30)
_SLANT = np.array([np.cos(_LEAN) / np.sqrt(2)] * 2)  # a diagonal's x and y
# How a bar is held: in words, its direction, which way it is aside, and at which part of the working distance.
_BARS = (
    ("level, at the top of the picture, far", (1, 0, 0), (0, -1), _FAR),
    ("level, at the bottom of the picture, near", (1, 0, 0), (0, 1), _NEAR),
    ("upright, on the left, near", (0, 1, 0), (-1, 0), _NEAR),
    ("upright, on the right, far", (0, 1, 0), (1, 0), _FAR),
    ("rising to the right, its right end 30 deg nearer", (_SLANT[0], -_SLANT[1], -np.sin(_LEAN)), (0, 0), _MIDDLE),
    ("falling to the right, its right end 30 deg farther", (_SLANT[0], _SLANT[1], np.sin(_LEAN)), (0, 0), _MIDDLE),
    ("level, in the middle, its right end 45 deg farther", (np.sqrt(0.5), 0, np.sqrt(0.5)), (0, 0), _MIDDLE),
)
# How a plate is held: in words, the rotation vector, in units of the lean, and the part of the working distance.
_PLATES = (
    ("facing the camera, at the middle distance", (0, 0, 0), _MIDDLE),
    ("facing the camera, near", (0, 0, 0), _NEAR),
    ("facing the camera, far", (0, 0, 0), _FAR),
    ("its right edge 30 deg nearer", (0, 1, 0), _MIDDLE),
    ("its left edge 30 deg nearer", (0, -1, 0), _MIDDLE),
    ("its upper edge 30 deg nearer", (1, 0, 0), _MIDDLE),
    ("its lower edge 30 deg nearer", (-1, 0, 0), _MIDDLE),
)


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
        """What to do."""
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

    def positions(self, geometry: Geometry) -> Iterator[Position]:
        """Yield the seven positions of the bar before a rig.

        Raises
        ------
        CalibrationError
            The bar does not fit into the measuring volume, or there is none.
        """
        for k, (words, direction, aside, part) in enumerate(_BARS, start=1):
            x = np.array(direction, np.float64)
            z = np.array([0.0, 0, 1]) - x[2] * x
            z /= np.linalg.norm(z)
            turn = cv2.Rodrigues(np.column_stack([x, np.cross(z, x), z]))[0].ravel()
            middle, reach = _middle_mm(geometry, part), np.array([*aside * _half_field_mm(geometry, part), 0.0])
            held = (
                _position(f"bar-{k}", words, turn, middle + inwards * reach, self, geometry) for inwards in _INWARDS
            )
            found = next((position for position in held if _is_seen(position, self, geometry)), None)
            if found is None:
                raise CalibrationError(
                    f"a bar {self.spacing_mm + self.diameter_mm:g} mm long is not seen whole by camera and projector "
                    f"{middle[2]:.0f} mm away: take a shorter one"
                )
            yield found


@dataclass(frozen=True)
class Plate:
    """A matt plane that fills the measuring volume."""

    size_mm: FloatArray  # (2,) width, height

    @classmethod
    def before(cls, geometry: Geometry) -> "Plate":
        """Return one that camera and projector see whole."""
        return cls(2 * _PLATE * _half_field_mm(geometry, _NEAR))

    def outline_mm(self) -> FloatArray:
        """Return its corners about its middle, (4, 3) mm."""
        return _rectangle(*self.size_mm)

    def positions(self, geometry: Geometry) -> Iterator[Position]:
        """Yield the seven positions of the plate before a rig."""
        for k, (words, turn, part) in enumerate(_PLATES, start=1):
            place = _middle_mm(geometry, part)
            yield _position(f"plane-{k}", words, _LEAN * np.array(turn), place, self, geometry)


def _rectangle(width: float, height: float) -> FloatArray:
    return np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * (width / 2, height / 2, 0)


def _middle_mm(geometry: Geometry, part: float) -> FloatArray:
    """Return the middle of the measuring volume at a part of the working distance, (3,)."""
    depth_mm = geometry.working_distance_mm()
    if depth_mm is None:
        raise CalibrationError("camera and projector look past each other: turn both to where objects will be")
    ((x, y),) = geometry.camera.rays_through((np.array([geometry.camera.size_px]) - 1) / 2)
    return part * depth_mm * np.array([x, y, 1.0])


def _half_field_mm(geometry: Geometry, part: float) -> FloatArray:
    """Return half the width and height of what the camera sees at a part of the working distance, (2,)."""
    lens = geometry.camera
    return np.asarray(lens.size_px / lens.matrix[[0, 1], [0, 1]] / 2 * _middle_mm(geometry, part)[2])


def _position(
    name: str, words: str, turn: FloatArray, place: FloatArray, artefact: BallBar | Plate, geometry: Geometry
) -> Position:
    lens = geometry.camera
    pixels = cv2.projectPoints(artefact.outline_mm(), turn, place, lens.matrix, lens.distortion)[0]
    return Position(name, words, turn, place, pixels.reshape(-1, 2))


def _is_seen(position: Position, artefact: BallBar, geometry: Geometry) -> bool:
    """Return whether camera and projector see all of an artefact."""
    corners = artefact.outline_mm() @ cv2.Rodrigues(position.turn)[0].T + position.place_mm
    for lens, pixels in (
        (geometry.camera, position.outline_px),
        (geometry.projector, geometry.projector_px(corners)),
    ):
        rim = _RIM * lens.size_px[0]
        if (pixels < rim).any() or (pixels > np.array(lens.size_px) - 1 - rim).any():
            return False
    return True


def positions_before(geometry: Geometry, bar: BallBar) -> list[Position]:
    """Return the positions of a bar, and then those of the plate, before a rig."""
    return [*bar.positions(geometry), *Plate.before(geometry).positions(geometry)]
