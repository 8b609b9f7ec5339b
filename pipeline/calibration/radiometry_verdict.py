"""What measured light is worth: which ripple it leaves in a phase, in rad and in mm, and what would make it better.

A channel whose light is off by a small part e of its range leaves the three-step phase off by

    (2 / 3) sum_j e_j sin(phi_j) / (b / range),

the derivative of the arctangent by each channel, with the fringe's amplitude b: half of the range at full modulation.
Errors of three channels that know nothing of each other, each of RMS e, make sqrt(8 / 3) e rad RMS. The same holds for
noise.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.calibration.grades import Grade, grade_of
from pipeline.calibration.model import Geometry
from pipeline.calibration.radiometry import Radiometry
from pipeline.models import FloatArray

# rad a part of the channels' range, at full modulation.
_RAD_PER_PART = float(np.sqrt(8 / 3))
# rad RMS: what the noise of one frame leaves of a smoothed phase (0.007 to 0.014, docs/accuracy.md); and what the
# paper's chain leaves, which measures no response.
_GOOD_RAD, _USABLE_RAD = 0.01, 0.03
# Part of white by which grey may differ from red + green + blue where nothing but noise makes it: above, the projector
# mixes its colours a little, or the camera's transfer is another.
_USUAL_ADDITIVITY = 0.005
# Of full scale: a brighter target, or a longer exposure, then gives half the noise or less.
_DIM = 0.35
# Codes, of 255, from which on a response is a power of the code; below, black levels bend it.
_GAMMA_FROM = 64


@dataclass(frozen=True)
class RadiometryVerdict:
    """What a radiometry is worth."""

    grade: Grade
    ripple_rad: float  # RMS over a cycle, by what is uncertain of response and crosstalk
    noise_rad: float  # of one pixel, one frame as bright as the white capture, nothing smoothed
    mm_per_rad: float | None  # at the working distance, where the geometry is known
    gamma: tuple[float, float, float]  # of the projector's red, green and blue
    advice: tuple[str, ...]

    def in_words(self) -> str:
        """Return a line that says what it is worth."""

        def both(rad: float) -> str:
            return f"{rad:.4f} rad" + ("" if self.mm_per_rad is None else f" ({rad * self.mm_per_rad:.3f} mm)")

        gamma = ", ".join(f"{value:.2f}" for value in self.gamma)
        return (
            f"{self.grade}: response and crosstalk leave a ripple of {both(self.ripple_rad)} RMS; the camera's noise "
            f"makes {both(self.noise_rad)} of a pixel, unsmoothed; the projector's gamma is {gamma}"
        )


def judge_radiometry(found: Radiometry, geometry: Geometry | None) -> RadiometryVerdict:
    """Judge what was measured of the light.

    Parameters
    ----------
    found : Radiometry
        What was measured.
    geometry : Geometry, optional
        The rig's, which tells what a radian is in mm.
    """
    # Of light 0..1, RMS over codes and primaries; and of each channel's crosstalk, over all that it sees.
    response = float(np.sqrt((found.response_sigma**2).mean()))
    rows = found.crosstalk_matrix.sum(axis=1, keepdims=True)
    crosstalk = float(np.sqrt(((found.crosstalk_sigma / rows) ** 2).sum(axis=1).mean()))
    ripple = _RAD_PER_PART * float(np.hypot(response, crosstalk))
    noise = _RAD_PER_PART * float(np.sqrt(((found.noise / rows.ravel()) ** 2).mean()))
    gamma = tuple(_gamma(row) for row in found.response)
    advice = []
    if found.additivity > _USUAL_ADDITIVITY:
        advice.append(
            f"grey differs from red + green + blue by {found.additivity:.1%} of white: look for a colour mode of the "
            "projector, light that changes meanwhile, and black that the camera clips"
        )
    if rows.max() < _DIM:
        advice.append(f"white reaches {rows.max():.0%} of full scale only: expose longer")
    return RadiometryVerdict(
        grade_of(ripple, _GOOD_RAD, _USABLE_RAD),
        ripple,
        noise,
        None if geometry is None else _mm_per_rad(geometry),
        (gamma[0], gamma[1], gamma[2]),
        tuple(advice),
    )


def _gamma(response: FloatArray) -> float:
    """Return the power of the code that a response is nearest to, by least squares of logarithms."""
    codes = np.log(np.arange(_GAMMA_FROM, len(response)) / (len(response) - 1))
    light = np.log(np.maximum(response[_GAMMA_FROM:], 1e-6))
    return float((codes @ light) / (codes @ codes))


def _mm_per_rad(geometry: Geometry) -> float | None:
    """Return what a radian of phase is in depth, mm, where the two devices' axes meet; None where they do not."""
    distance = geometry.working_distance_mm()
    if distance is None:
        return None
    near, far = geometry.pattern_cycles(np.array([[0, 0, distance - 0.5], [0, 0, distance + 0.5]]))
    return float(1 / (2 * np.pi * abs(far - near)))
