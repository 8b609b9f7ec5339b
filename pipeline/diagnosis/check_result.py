"""What a check of a calibration finds: figures beside what they should be, and what the check cannot show."""

from dataclasses import dataclass

# A measured figure may exceed the predicted one by this factor before the calibration is doubted.
_TOLERANCE = 2.0

#: What each kind of check cannot show.
BLIND_SPOTS = {
    "plane": "a plane stays flat, or nearly, whatever the baseline's length and however the projector turns about the "
    "stripes' direction: a ball of known radius shows that, the captures of calibrate geometry every other turn",
    "ball": "a ball of unknown radius shows no wrong scale: give its radius",
    "epipolar": "epipolar lines do not show the baseline's length, nor a turn of the projector towards the camera or "
    "away from it: a ball of known radius does",
}


@dataclass(frozen=True)
class Measure:
    """One figure of a check."""

    name: str
    measured: float
    predicted: float  # what the calibration and the frame's noise lead one to expect
    unit: str

    @property
    def fine(self) -> bool:
        """Whether it is within twice the prediction."""
        return self.measured <= _TOLERANCE * self.predicted


@dataclass(frozen=True)
class CheckResult:
    """What a check found."""

    measures: tuple[Measure, ...]
    position_mm: tuple[float, float, float] | None  # a ball's centre, or the plane's point on the camera's axis
    radius_mm: float | None  # a ball's
    blind_spot: str = ""  # what this shape cannot show, and what does

    @property
    def fine(self) -> bool:
        """Whether every figure is within twice its prediction; if not, calibrate again."""
        return all(measure.fine for measure in self.measures)
