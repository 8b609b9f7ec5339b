"""What a rig is to be made of, in the figures of data sheets, and the calibration that such a rig would have."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from pipeline.calibration import Calibration, Lens, Pattern
from pipeline.calibration.model import DEFAULT_PROJECTOR_PX
from pipeline.errors import FootageError
from pipeline.limits import check_size
from pipeline.models import Model, Positive

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


class RigChoice(Model):
    """A camera and a projector that are both turned to one point; by default about the demo's rig.

    The baseline stands across the stripes: with horizontal ones the projector is above or below the camera, with
    vertical ones beside it.
    """

    distance_mm: _Distance = 900.0  # from the camera's lens to the object
    baseline_mm: _Distance = 180.0  # from the camera's lens to the projector's
    camera_px: tuple[_Side, _Side] = (640, 480)
    sensor: Literal["bayer", "rgb"] = "bayer"  # one colour a pixel, as nearly all have, or all three
    pixel_um: _Pixel = 4.8  # side of a pixel of the camera's sensor
    lens_mm: _Focal = 6.0  # focal length of the camera's lens
    projector_px: tuple[_Side, _Side] = DEFAULT_PROJECTOR_PX
    throw_ratio: _Throw = 1.75  # the projector's distance over the width of its picture there
    stripes: Literal["horizontal", "vertical"] = "horizontal"
    period_px: Positive | None = None  # projector px a cycle; None: as recommended
    surface: Literal["skin", "white"] = "skin"
    brightness: _Share = 0.7  # of full scale: the brightest channel where the fringe is brightest
    contrast: _Share = 0.9  # what ambient light and blur leave of the fringe's own
    noise_levels: _Noise = 1.5  # standard deviation, in 1/255 of full scale
    bits: Literal[8, 10, 12, 16] = 8
    speed_mm_s: _Speed = 100.0  # how fast the object comes nearer or goes away
    exposure_s: _Time | None = None
    colour_cycle_s: _Time | None = None  # of a projector that shows its colours in turn; None: all at once

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

    def calibration(self, period_px: float, code: Literal["contrast"] | None = "contrast") -> Calibration:
        """Return the calibration of this rig, built without a fault.

        Parameters
        ----------
        period_px : float
            Projector px a cycle.
        code : {"contrast"}, optional
            The pattern's.
        """
        # The projector stands across the stripes, and its axis meets the camera's at the object.
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
            pattern=Pattern(period_px=period_px, stripes=self.stripes, code=code),
        )


def _lens(size_px: tuple[int, int], focal_px: float) -> Lens:
    width, height = size_px
    matrix = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    return Lens(size_px=size_px, matrix=matrix)
