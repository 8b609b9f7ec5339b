"""Three words for how good a calibration is."""

from typing import Literal

#: "good": a frame's noise limits a measurement; "usable": the calibration does; "poor": calibrate again.
Grade = Literal["good", "usable", "poor"]


def grade_of(error: float, good: float, usable: float) -> Grade:
    """Return the grade of an error, given the largest that is good and the largest that is usable; NaN is poor.

    >>> grade_of(0.2, 0.3, 1.0), grade_of(0.5, 0.3, 1.0), grade_of(2.0, 0.3, 1.0)
    ('good', 'usable', 'poor')
    """
    if error <= good:
        return "good"
    return "usable" if error <= usable else "poor"
