"""The parts of a rig, in the figures of data sheets, and where its camera and projector look.

With a baseline B across the stripes and both axes meeting at the distance D, the projector sees a point of the camera's
axis at the depth z under the angle atan(B / z) to that axis, and its own axis is at atan(B / D). Its picture's row (or
column) u px from the middle is therefore at

    z(u) = B / tan(atan(B / D) + atan(u / f)),     dz / dphi = p (B^2 + D^2) / (2 pi f B)  where u = 0,

f its focal length in px and p the period. All else is projected by the calibration that the rig would have.
"""

from dataclasses import dataclass
from math import atan, atan2, degrees, inf, pi, tan
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from pipeline.calibration import Calibration, Lens, Pattern
from pipeline.calibration.model import DEFAULT_CODE, DEFAULT_PROJECTOR_PX, Geometry
from pipeline.errors import FootageError
from pipeline.limits import check_size
from pipeline.models import CodeName, FloatArray, Model, Positive
from pipeline.planning.motion_cost import USUAL_SPEED_MM_S

# Nothing that is sold for such a rig lies outside these bounds, in the unit of the field's name.
_Side = Annotated[int, Field(ge=64, lt=2**20)]
_Distance = Annotated[float, Field(ge=10, le=1e5)]
_Pixel = Annotated[float, Field(ge=0.5, le=100)]
_Focal = Annotated[float, Field(ge=0.5, le=2000)]
_Throw = Annotated[float, Field(ge=0.1, le=50)]
_Share = Annotated[float, Field(ge=0.01, le=1)]
_Noise = Annotated[float, Field(ge=0, le=255)]
_Speed = Annotated[float, Field(ge=0, le=1e6)]
_Time = Annotated[float, Field(ge=1e-6, le=3600)]
# Points along either side of the camera's picture that are searched for in the projector's: to a hundredth of its area.
_GRID = 101


class RigChoice(Model):
    """A camera and a projector that are both turned to one point; by default about the demo's rig.

    The baseline runs across the stripes: with horizontal ones the projector is above or below the camera, with vertical
    ones to its left or right.
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    distance_mm: _Distance = 900.0
    """From the camera's lens to the object, mm."""
    baseline_mm: _Distance = 180.0
    """From the camera's lens to the projector's, mm: across the stripes, so above or below for horizontal ones."""
    camera_px: tuple[_Side, _Side] = (640, 480)
    """The camera's width and height in px."""
    sensor: Literal["bayer", "rgb"] = "bayer"
    """One colour per pixel, as in nearly all cameras, or all three."""
    pixel_um: _Pixel = 4.8
    """The side of a pixel on its sensor, um."""
    lens_mm: _Focal = 6.0
    """The focal length of its lens, mm."""
    projector_px: tuple[_Side, _Side] = DEFAULT_PROJECTOR_PX
    """The projector's own width and height in px."""
    throw_ratio: _Throw = 1.75
    """Its throw ratio: distance over the width of the picture."""
    stripes: Literal["horizontal", "vertical"] = "horizontal"
    """The direction of the stripes."""
    period_px: Positive | None = None
    """Projector px per cycle; left out, the recommended one."""
    surface: Literal["skin", "white"] = "skin"
    """The surface that is measured."""
    brightness: _Share = 0.7
    """The camera's brightest channel where the fringe is brightest on the surface, 0..1 of full scale."""
    contrast: _Share = 0.9
    """The part of the fringe's contrast that ambient light and blur leave, 0..1."""
    noise_levels: _Noise = 1.5
    """The camera's noise, one standard deviation, in 1/255 of full scale."""
    bits: Literal[8, 10, 12, 16] = 8
    """The camera's."""
    speed_mm_s: _Speed = USUAL_SPEED_MM_S
    """The speed at which the object comes nearer or goes away, mm/s; 0: it holds still."""
    exposure_s: _Time | None = None
    """The camera's, s; left out, the longest that motion allows."""
    colour_cycle_s: _Time | None = None
    """The time of red, green and blue together where the projector shows them one after another, s; left out, all at
    once."""

    @model_validator(mode="after")
    def _check(self) -> "RigChoice":
        try:
            check_size("the camera's picture", *self.camera_px)
            check_size("the projector's picture", *self.projector_px)
        except FootageError as error:
            raise ValueError(str(error)) from None
        distance = self.distance_mm
        if self.baseline_mm >= distance:
            raise ValueError(
                f"a baseline of {self.baseline_mm:g} mm is as long as the distance of {distance:g} mm or longer: "
                f"projector and camera would look at two sides of the object; a fifth is usual, {distance / 5:.3g} mm"
            )
        if self.lens_mm >= distance / 2:
            raise ValueError(
                f"a lens of {self.lens_mm:g} mm cannot show an object {distance:g} mm away smaller than it is: give "
                "the focal length and the distance, both in mm"
            )
        return self

    @property
    def phase_axis(self) -> int:
        """The axis of camera and projector along which the phase changes: 1 (rows) for horizontal stripes."""
        return 1 if self.stripes == "horizontal" else 0

    @property
    def camera_focal_px(self) -> float:
        """The distance from the camera's lens to its picture when it is focused on the object, px.

        By the thin lens's equation 1 / image + 1 / distance = 1 / focal length.
        """
        return 1e3 * self.lens_mm / (1 - self.lens_mm / self.distance_mm) / self.pixel_um

    @property
    def projector_focal_px(self) -> float:
        """The same of the projector: the throw ratio is its distance over the width of its picture."""
        return self.throw_ratio * self.projector_px[0]

    def calibration(self, period_px: float, code: CodeName | None = DEFAULT_CODE) -> Calibration:
        """Return the calibration of this rig, built without a fault.

        Parameters
        ----------
        period_px : float
            Projector px per cycle.
        code : {"contrast", "contrast2"}, optional
            The pattern's.
        """
        # The projector is across the stripes, and its axis meets the camera's at the object.
        toe = np.arctan2(self.baseline_mm, self.distance_mm)
        c, s = np.cos(toe), np.sin(toe)
        if self.stripes == "horizontal":
            centre, rotation = np.array([0.0, -self.baseline_mm, 0.0]), np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        else:
            centre, rotation = np.array([-self.baseline_mm, 0.0, 0.0]), np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        return Calibration(
            camera=_lens(self.camera_px, self.camera_focal_px),
            projector=_lens(self.projector_px, self.projector_focal_px),
            rotation=rotation,
            translation_mm=-rotation @ centre,
            pattern=Pattern(period_px=period_px, stripes=self.stripes),
        ).with_pattern(code=code)


def _lens(size_px: tuple[int, int], focal_px: float) -> Lens:
    width, height = size_px
    matrix = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    return Lens(size_px=size_px, matrix=matrix)


@dataclass(frozen=True)
class SeenFields:
    """Fields of camera and projector on a plane across the camera's axis, at the object's distance."""

    camera_mm: tuple[float, float]  # width, height
    projector_mm: tuple[float, float]  # through the middle of its picture
    overlap_mm: tuple[float, float]  # of both
    lit_share: float  # how much of the camera's picture the projector lights, 0..1
    picture_over_needed: float  # how many times as wide as it needs to be the projector's picture is
    mm_per_px: float  # of the camera


@dataclass(frozen=True)
class FringeGeometry:
    """The fringe on that plane, and the depths that it shows, along the camera's axis."""

    pitch_mm: float  # of a cycle, across the stripes
    period_camera_px: float
    depth_per_rad_mm: float
    depth_per_cycle_mm: float  # about the object
    lit_range_mm: tuple[float, float]  # nearest and farthest depth that the projector's picture reaches, or infinity


def seen_fields(choice: RigChoice) -> SeenFields:
    """Return what camera and projector see at the object's distance."""
    geometry = choice.calibration(choice.projector_px[choice.phase_axis]).geometry()
    width, height = choice.camera_px
    mm_per_px = choice.distance_mm / choice.camera_focal_px
    camera = np.array([[-0.5, 0.5]]).T * np.array([width, height]) * mm_per_px  # (2, 2): least and most; x, y
    columns, rows = choice.projector_px
    ends = np.array([[-0.5, (rows - 1) / 2], [columns - 0.5, (rows - 1) / 2]])
    sides = _on_the_plane(geometry, ends, choice.distance_mm)[:, 0]
    ends = np.array([[(columns - 1) / 2, -0.5], [(columns - 1) / 2, rows - 0.5]])
    heights = _on_the_plane(geometry, ends, choice.distance_mm)[:, 1]
    projector = np.stack([sides, heights], axis=-1)
    overlap = np.minimum(camera[1], projector[1]) - np.maximum(camera[0], projector[0])
    x, y = (np.linspace(camera[0, axis], camera[1, axis], _GRID) for axis in (0, 1))
    points = np.stack(np.meshgrid(x, y, choice.distance_mm), axis=-1).reshape(-1, 3)
    pixels = geometry.projector_px(points)
    lit = np.all((pixels >= -0.5) & (pixels <= np.array(choice.projector_px) - 0.5), axis=1)
    middle = (np.array(choice.projector_px) - 1) / 2
    reached = np.abs(pixels - middle) / (np.array(choice.projector_px) / 2)
    return SeenFields(
        camera_mm=_pair(np.ptp(camera, axis=0)),
        projector_mm=_pair(np.ptp(projector, axis=0)),
        overlap_mm=_pair(overlap),
        lit_share=float(lit.mean()),
        picture_over_needed=float(1 / reached.max()),
        mm_per_px=mm_per_px,
    )


def fringe_geometry(choice: RigChoice, period_px: float) -> FringeGeometry:
    """Return how a fringe of this period (projector px) lies on the object, and the depths that it shows."""
    geometry = choice.calibration(period_px).geometry()
    mm_per_px = choice.distance_mm / choice.camera_focal_px
    points = np.zeros((2, 3))
    points[:, 2] = choice.distance_mm
    points[:, choice.phase_axis] = (-mm_per_px, mm_per_px)
    pitch = 2 * mm_per_px / float(np.ptp(geometry.pattern_cycles(points)))
    baseline, distance, focal = choice.baseline_mm, choice.distance_mm, choice.projector_focal_px
    per_rad = period_px * (baseline**2 + distance**2) / (2 * pi * focal * baseline)
    half = choice.projector_px[choice.phase_axis] / 2
    near, far = (_depth_mm(choice, sign * period_px / 2) for sign in (1, -1))
    return FringeGeometry(
        pitch_mm=pitch,
        period_camera_px=pitch / mm_per_px,
        depth_per_rad_mm=per_rad,
        depth_per_cycle_mm=far - near,
        lit_range_mm=(_depth_mm(choice, half), _depth_mm(choice, -half)),
    )


def angle_deg(choice: RigChoice) -> float:
    """Return the angle between the two axes, where they meet."""
    return degrees(atan2(choice.baseline_mm, choice.distance_mm))


def _depth_mm(choice: RigChoice, offset_px: float) -> float:
    """Return the depth at which the camera's axis is lit by a row (or column) so far from the picture's middle."""
    angle = atan2(choice.baseline_mm, choice.distance_mm) + atan(offset_px / choice.projector_focal_px)
    return choice.baseline_mm / tan(angle) if angle > 0 else inf


def _on_the_plane(geometry: Geometry, pixels: FloatArray, distance_mm: float) -> FloatArray:
    """Return where projector pixels (N, 2) land on the plane z = distance, (N, 2) mm."""
    matrix = geometry.projector.matrix
    rays = np.column_stack([(pixels - matrix[:2, 2]) / np.diag(matrix)[:2], np.ones(len(pixels))]) @ geometry.rotation
    centre = -geometry.rotation.T @ geometry.translation_mm
    return np.asarray(centre[:2] + rays[:, :2] * ((distance_mm - centre[2]) / rays[:, 2:]))


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])
