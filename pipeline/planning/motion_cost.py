"""The cost of motion in depth, for rigs that are planned and for footage that is inspected."""

from math import sqrt
from typing import NamedTuple

from pipeline.settings import DecodeSettings

#: The speed that costs are given for by default, mm/s.
USUAL_SPEED_MM_S = 100.0


class MotionCost(NamedTuple):
    """One figure of what motion costs or allows."""

    topic: str
    value: float
    unit: str
    meaning: str


def longest_exposure_s(speed_mm_s: float, mm_per_px: float) -> float:
    """Return the exposure in which a surface moves by as many camera px as smoothing averages over."""
    return DecodeSettings().smoothing_px * mm_per_px / speed_mm_s


def ripple_mm(speed_mm_s: float, colour_cycle_s: float) -> float:
    """Return the RMS, at most, of the depth's ripple where colours come one after another; see `rig_plan`."""
    return speed_mm_s * colour_cycle_s / 3 / sqrt(6)


def motion_costs(
    speed_mm_s: float, mm_per_px: float | None, colour_cycle_s: float | None, readout_s: float = 0.0
) -> list[MotionCost]:
    """Return the costs of motion, without what the frame before takes off.

    Parameters
    ----------
    speed_mm_s : float
        At which a surface comes nearer or goes away, mm/s, above 0.
    mm_per_px : float or None
        Of the camera at the surface; None: not known.
    colour_cycle_s : float or None
        Of a projector that shows its colours one after another; None: all at once.
    readout_s : float
        From the first row's exposure to the last one's; 0: all rows at once.

    Examples
    --------
    >>> [f"{cost.topic}: {cost.value:.2g} {cost.unit}" for cost in motion_costs(100.0, 0.4, 1 / 60, 0.02)]
    ['longest exposure: 28 ms', 'colours in turn: 0.23 mm', 'rows in turn: 1 mm']
    """
    found, speed = [], f"at {speed_mm_s:.3g} mm/s"
    if mm_per_px is not None:
        exposure_ms = 1e3 * longest_exposure_s(speed_mm_s, mm_per_px)
        meaning = f"{speed} motion then takes as much detail as smoothing"
        found.append(MotionCost("longest exposure", exposure_ms, "ms", meaning))
    if colour_cycle_s is not None:
        ripple = ripple_mm(speed_mm_s, colour_cycle_s)
        meaning = f"RMS at most, a ripple {speed}: {ripple / speed_mm_s:.2g} mm per mm/s"
        found.append(MotionCost("colours in turn", ripple, "mm", meaning))
    if readout_s:
        shear = speed_mm_s * readout_s / 2
        meaning = f"in the first and the last row {speed}: {readout_s / 2:.2g} mm per mm/s"
        found.append(MotionCost("rows in turn", shear, "mm", meaning))
    return found
