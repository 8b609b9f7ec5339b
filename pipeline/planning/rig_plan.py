"""Predict what a rig will measure, before it is bought.

The depth's standard deviation is the phase's times the depth of a radian (`tikernels/depth/point_uncertainty.py`).

**Noise.** A channel's light under the pattern is C_i = r_i sum_j M_ij code_j^gamma. Where its noise is sigma levels and
neither the phase phi nor the pixel's brightness is known, the bound of Cramer and Rao on the phase is

    var = sigma^2 / sum_i (dC_i / dphi)_across^2,

the derivative across the light C itself (`docs/accuracy.md`; S. M. Kay, Fundamentals of Statistical Signal Processing,
volume 1, 1993, section 3.7). The decoder's own noise model then gives what smoothing leaves of it
(`tikernels/phase/smoothing.py`) and that its model of the light, fitted to samples, adds a share of its own
(`tikernels/phase/uncertainty.py`). Smoothing weighs rows by their certainty, but not without bounds, so that it leaves
more than the harmonic mean of a cycle's variances and less than their mean: the geometric mean is between the two.

**Motion.** Colours that are all there at once are averaged over the exposure, and the phase is that of its middle. What
is lost is detail along the way that the object moves, as in smoothing: the longest exposure is that in which it moves
by as many camera px as smoothing averages over. Colours in turn, a third of the colour cycle T apart, see it at three
depths: red's and blue's phases are off by -w and w relative to green's, w being v T / 3 in rad, which puts a second
harmonic of w / sqrt(3) on the arctangent's phase, RMS w / sqrt(6), whatever the geometry; the decoder's model of the
light takes a part of it off (`docs/planning.md`).
"""

from dataclasses import dataclass, replace
from math import ceil, exp, floor, inf, log, nan, pi, radians, sin, sqrt
from typing import Any, Literal

import numpy as np

from hardware.colour_cycle import check_exposure
from pipeline.calibration.board import Board
from pipeline.calibration.model import DEFAULT_CODE
from pipeline.contrast_code import CYCLES, WORD_CELLS, ContrastCode
from pipeline.errors import SettingsError
from pipeline.models import CodeName, FloatArray, build
from pipeline.pattern import CHANNEL_PHASES
from pipeline.planning.expected_calibration import planned_bias_mm
from pipeline.planning.motion_cost import longest_exposure_s, ripple_mm
from pipeline.planning.rig_choice import FringeGeometry, RigChoice, SeenFields, angle_deg, fringe_geometry, seen_fields
from pipeline.settings import DecodeSettings
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, WHITE
from tikernels.phase.camera_blur import VARIANCE_PX
from tikernels.phase.smoothing import left_of_relief, left_of_variance
from tikernels.phase.uncertainty import OWN_ERROR

# Boards of fewer squares where the camera has few pixels; the first is what `colorphase pattern --board` draws.
_SQUARES = ((11, 8), (9, 7), (7, 5))
# The board's part of the field, by area: its corners then lie in most of the picture, and there is room to move it.
_PART = 0.5
#: Markers of smaller squares are not surely read. Of boards tilted by 15 to 35 degrees (blur 0.6 px, noise of 1.5
#: levels, 24 of each size) those with squares of 24 px all show nine corners of ten on average, of 20 px half, of 16 px
#: none.
LEAST_SQUARE_PX = 24.0
#: Ten poses tilted like that gave focal lengths to 0.02 % (`docs/calibration.md`).
TILTS_DEG = (15, 35)
# ISO 216, mm.
_SHEETS = (("A4", 210, 297), ("A3", 297, 420), ("A2", 420, 594), ("A1", 594, 841), ("A0", 841, 1189))
REFLECTANCES = {"skin": SKIN, "white": WHITE}
# How far red, green and blue travel in it before they come back, mm: the standard deviation of a Gaussian, of no real
# skin that was measured.
_SCATTER_MM = {"skin": (1.2, 0.6, 0.3), "white": (0.0, 0.0, 0.0)}
# With less of red's contrast the phase errs by 0.10 to 0.16 rad, with more by 0.03 to 0.06, whatever the period: faces
# before two drawn rigs, cycles of 4 and of 5.5 to 15 mm (`docs/studies.md`).
_LEAST_LEFT = 0.3
# A mosaic has a third of the samples, from which all three colours of a pixel are interpolated.
_VARIANCE = {"bayer": 3.0, "rgb": 1.0}
# It also makes the lateral period limit longer by this factor: 1.08 to 1.18 on corrugated plates in simulated frames.
_COARSER = {"bayer": 1.12, "rgb": 1.0}
# An ordinary projector's response, which codes are raised to.
_GAMMA = 2.0
# What decoding leaves of a smooth surface under the coded pattern without noise, rad, by the cycles in view: planes,
# skin and white, 640x480 and 1280x960, gamma 2, 12 bits, noise of 0.3 levels. It is the third harmonic: a frame of few
# cycles does not determine the projector's response well. With a response that is known and undone in the pattern 0.003
# to 0.005 rad are left.
_NOISELESS_CYCLES = (19.0, 23.5, 27.4, 33.0, 40.0)
_NOISELESS_RAD = (0.0115, 0.0066, 0.0048, 0.003, 0.0025)
# Of a cycle: four times as many change the result by less than 0.1 %.
_SAMPLES = 64
# Light of a phase this much before and after shows the slope, rad, to one part in a thousand.
_SHIFT = 0.02
#: Camera px per cycle: what most figures of `docs/accuracy.md` were measured at, and what they should lie between.
USUAL_CAMERA_PX, LEAST_CAMERA_PX, MOST_CAMERA_PX = 12.0, 10.0, 20.0
# The third harmonic, in which a projector's response shows, then has two pixels a cycle: in fewer it is not seen.
_SHORTEST_CAMERA_PX = 6.0
# The code's sequence was made for a projector of 1024 px at this many px per cycle.
_LEAST_PROJECTOR_PX = 8.0
# With fewer cycles in view a frame does not determine crosstalk and response at all (`docs/calibration.md`); with fewer
# than the other it leaves as much of the response as half of the usual noise (`_NOISELESS_RAD`).
_LEAST_CYCLES, _ENOUGH_CYCLES = 4.0, 28.0
# A surface of so many cycles of its own is placed by "contrast" under an ordinary projector; by "contrast2" one of so
# many cycles and cells (`docs/coded_pattern.md`: all of a hundred were).
_CODE_CYCLES = 9
_CODE_WINDOW = (5, 8)
# Orders are carried from frame to frame while the phase changes by less (`docs/accuracy.md`), cycles.
_CARRIED = 1 / 3
# Of baseline and distance. Beyond the one a step hides half of its height or more; below the other a cycle is 14 times
# as deep as it is wide, and what turns the phase a little moves the depth a lot.
_MOST_RATIO, _LEAST_RATIO = 0.5, 0.07
# What the projector leaves dark at the corners of a trapezoid is no reason to buy another one; a rig of which it lights
# less than a quarter was never meant.
_LIT_ENOUGH, _LIT_LEAST = 0.98, 0.25


@dataclass(frozen=True)
class BoardChoice:
    """A board that fills half of what camera and projector both see."""

    squares: tuple[int, int]  # columns, rows
    square_mm: float
    square_px: float  # of the camera, seen straight on
    sheet: str  # the smallest that takes it with its margin of one square
    sharp_mm: float  # how far before and behind the object the lenses must be sharp when it is tilted most

    def of_kind(self, kind: Literal["charuco", "chessboard"]) -> Board:
        """Return the board with or without markers."""
        return Board(kind=kind, squares=self.squares, square_mm=self.square_mm)


def choose_board(field_mm: tuple[float, float], mm_per_px: float) -> BoardChoice:
    """Return the board to calibrate with.

    Parameters
    ----------
    field_mm : (width, height)
        The field that camera and projector both see at the object's distance.
    mm_per_px : float
        Of the camera, there.
    """
    for squares in _SQUARES:
        fits = sqrt(_PART) * min(field_mm[0] / squares[0], field_mm[1] / squares[1])
        # Whole millimetres can be checked with a ruler; squares of less than 2 mm cannot.
        square_mm = float(floor(fits)) if fits >= 2 else fits
        if square_mm / mm_per_px >= LEAST_SQUARE_PX:
            break
    columns, rows = squares
    short, long = sorted(((columns + 2) * square_mm, (rows + 2) * square_mm))
    sheets = (*_SHEETS, ("more than A0", inf, inf))
    return BoardChoice(
        squares=squares,
        square_mm=square_mm,
        square_px=square_mm / mm_per_px,
        sheet=next(name for name, width, height in sheets if short <= width and long <= height),
        sharp_mm=columns * square_mm / 2 * sin(radians(TILTS_DEG[1])),
    )


def lateral_limit_px(smoothing_px: int) -> float:
    """Return the lateral period limit: the period at which decoding leaves half of a low relief, camera px.

    The window of smoothing leaves as much along the stripes as across them. The pixel's area and the lens leave
    exp(-2 pi^2 v / period^2), with the variance v that decoding takes a camera to have.

    Examples
    --------
    >>> round(lateral_limit_px(7), 1)
    5.8
    """
    periods_px = np.geomspace(100, 2, 4000)  # a thousandth apart
    left = left_of_relief(smoothing_px // 2, periods_px) * np.exp(-2 * pi**2 * VARIANCE_PX / periods_px**2)
    return float(periods_px[np.argmax(left < 0.5)])


def expected_phase_sigma(
    surface: Literal["skin", "white"],
    *,
    brightness: float,
    contrast: float,
    noise_levels: float,
    bits: int,
    sensor: Literal["bayer", "rgb"],
    cycles_in_view: float,
    code: CodeName = DEFAULT_CODE,
) -> float:
    """Return the standard deviation of a pixel's decoded phase on a smooth surface.

    Parameters
    ----------
    surface : {"skin", "white"}
        Its colour.
    brightness : float
        Level that the brightest channel reaches where the fringe is brightest, 0..1 of full scale.
    contrast : float
        Contrast of the fringe that ambient light and blur leave, 0..1.
    noise_levels : float
        Standard deviation of the camera's noise, in 1/255 of full scale.
    bits : int
        The camera's; rounding to whole levels has the variance of an even distribution over one.
    sensor : {"bayer", "rgb"}
        One colour per pixel, or all three.
    cycles_in_view : float
        Number of cycles of the fringe that the camera sees.
    code : {"contrast", "contrast2"}
        The pattern's.

    Returns
    -------
    float
        rad, RMS over the cycles of the pattern.

    Examples
    --------
    >>> camera = {"brightness": 0.7, "contrast": 0.9, "noise_levels": 1.5, "bits": 8, "sensor": "rgb"}
    >>> round(expected_phase_sigma("white", **camera, cycles_in_view=40), 4)
    0.0064
    """
    light, before, after = (_light(shift, surface, code) for shift in (0.0, -_SHIFT, _SHIFT))
    background = light.mean(axis=0)
    scale = 255 * brightness / (background + contrast * (light - background)).max()
    slope = scale * contrast * (after - before) / (2 * _SHIFT)
    direction = light / np.linalg.norm(light, axis=1, keepdims=True)
    across = slope - np.sum(slope * direction, axis=1, keepdims=True) * direction
    noise = (noise_levels**2 + (255 / (2**bits - 1)) ** 2 / 12) * _VARIANCE[sensor]
    variance = np.exp(np.mean(np.log(noise / np.sum(across**2, axis=1))))
    left = left_of_variance(DecodeSettings().smoothing_px // 2) + OWN_ERROR
    noiseless_rad = np.interp(cycles_in_view, _NOISELESS_CYCLES, _NOISELESS_RAD)
    return float(np.sqrt(left * variance + noiseless_rad**2))


def _light(shift: float, surface: str, code: CodeName) -> FloatArray:
    """Return what the camera's channels see all over the pattern, its phase shifted by this (rad), (N, 3)."""
    cycles = np.arange(CYCLES * _SAMPLES)[:, None] / _SAMPLES
    # Along the stripe no two samples of a cycle are alike, and all are evenly spread over the code's cells.
    cells = np.modf(cycles * _SAMPLES * (sqrt(5) - 1) / 2)[0] * WORD_CELLS
    modulation = ContrastCode.named(code, None if code == "contrast" else 1.0).modulation(cycles, cells)
    wave = np.cos(2 * np.pi * cycles + shift + np.array(CHANNEL_PHASES))
    primaries = (1 - modulation + modulation * wave) ** _GAMMA
    return np.asarray(primaries @ np.array(TYPICAL_CROSSTALK).T * np.array(REFLECTANCES[surface]))


@dataclass(frozen=True)
class RigPlan:
    """The figures that follow from a choice."""

    choice: RigChoice
    period_px: float  # projector px per cycle
    angle_deg: float  # between camera and projector, at the object
    fields: SeenFields
    fringe: FringeGeometry
    cycles_in_view: float  # by both
    phase_sigma_rad: float  # of a pixel, decoded as by default, as bright as chosen
    dark_phase_sigma_rad: float  # where it is half as bright
    longest_exposure_s: float  # motion then takes as much detail as smoothing; infinite where nothing moves
    exposure_s: float | None  # the one that was chosen, else the longest, in whole colour cycles; None: nothing moves
    colour_bias_mm: float  # RMS at most, what motion between colours in turn leaves
    least_rate_hz: float  # to carry orders from frame to frame under a plain pattern
    board: BoardChoice
    chessboard_bias_mm: float  # one standard deviation of depth that calibrating with a chessboard leaves, or infinite
    charuco_bias_mm: float  # the same with a ChArUco board
    warnings: tuple[str, ...]  # one line each, with the cure

    @property
    def depth_sigma_mm(self) -> float:
        """One standard deviation of a pixel's depth, as bright as chosen, mm."""
        return self.phase_sigma_rad * self.fringe.depth_per_rad_mm

    @property
    def dark_depth_sigma_mm(self) -> float:
        """The same where it is half as bright, mm."""
        return self.dark_phase_sigma_rad * self.fringe.depth_per_rad_mm

    @property
    def lateral_limit_mm(self) -> float:
        """The period of a relief of which half is seen, along and across the stripes, mm."""
        limit_px = lateral_limit_px(DecodeSettings().smoothing_px) * _COARSER[self.choice.sensor]
        return limit_px * self.fields.mm_per_px

    @property
    def contrast_left(self) -> tuple[float, float, float]:
        """Contrast of red, green and blue that light scattered under the surface leaves, 0..1."""
        red, green, blue = (exp(-2 * (pi * mm / self.fringe.pitch_mm) ** 2) for mm in _SCATTER_MM[self.choice.surface])
        return red, green, blue

    @property
    def code_mm(self) -> float:
        """The least length of a surface across the stripes to be placed by "contrast" alone, mm."""
        return _CODE_CYCLES * self.fringe.pitch_mm

    @property
    def window_mm(self) -> tuple[float, float]:
        """The least surface to be placed by "contrast2" alone: across and along the stripes, mm."""
        geometry = self.choice.calibration(self.period_px, "contrast2").geometry()
        cell_mm = geometry.camera_px_along(self.choice.distance_mm) * self.fields.mm_per_px
        cell_mm *= geometry.pattern.cell_px or nan
        cycles, cells = _CODE_WINDOW
        return cycles * self.fringe.pitch_mm, cells * cell_mm

    @property
    def passed_mm(self) -> float:
        """The object's way during the exposure, mm."""
        return self.choice.speed_mm_s * (self.exposure_s or 0.0)


def plan_rig(**values: Any) -> RigPlan:
    """Predict what a rig will measure.

    Parameters
    ----------
    **values
        Fields of `RigChoice`; what is left out is its default.

    Raises
    ------
    SettingsError
        A value is out of its bounds, or no rig can be like that; the message names it and the cure.
    RigError
        The exposure is not a whole number of colour cycles.

    Examples
    --------
    >>> plan = plan_rig(distance_mm=900, baseline_mm=180, period_px=17.4545)
    >>> round(plan.fringe.depth_per_rad_mm, 2), round(plan.fringe.pitch_mm, 2)
    (7.25, 9.12)
    """
    choice = build(RigChoice, values, SettingsError, "the rig")
    if choice.exposure_s is not None and choice.colour_cycle_s is not None:
        check_exposure(choice.exposure_s, choice.colour_cycle_s)
    fields = seen_fields(choice)
    if fields.lit_share < _LIT_LEAST:
        raise SettingsError(_dark(choice, fields))
    if min(fields.overlap_mm) <= 0:
        raise SettingsError(
            f"an edge of the projector's picture never meets the object's plane, as its throw ratio is "
            f"{choice.throw_ratio:g}: take a longer throw or a shorter baseline"
        )
    period_px = _period_px(choice)
    fringe = fringe_geometry(choice, period_px)
    cycles = fields.overlap_mm[choice.phase_axis] / fringe.pitch_mm
    sigma, dark = (_phase_sigma_rad(choice, cycles, share) for share in (1.0, 0.5))
    speed, cycle_s = choice.speed_mm_s, choice.colour_cycle_s or 0.0
    longest_s = longest_exposure_s(speed, fields.mm_per_px) if speed else inf
    board = choose_board(fields.overlap_mm, fields.mm_per_px)
    plan = RigPlan(
        choice=choice,
        period_px=period_px,
        angle_deg=angle_deg(choice),
        fields=fields,
        fringe=fringe,
        cycles_in_view=cycles,
        phase_sigma_rad=sigma,
        dark_phase_sigma_rad=dark,
        longest_exposure_s=longest_s,
        exposure_s=choice.exposure_s or _usual_exposure_s(longest_s, choice.colour_cycle_s),
        colour_bias_mm=ripple_mm(speed, cycle_s),
        least_rate_hz=speed / (_CARRIED * fringe.depth_per_cycle_mm),
        board=board,
        chessboard_bias_mm=planned_bias_mm(choice, fields, board.of_kind("chessboard")),
        charuco_bias_mm=planned_bias_mm(choice, fields, board.of_kind("charuco")),
        warnings=(),
    )
    return replace(plan, warnings=tuple(_warnings(plan)))


def _phase_sigma_rad(choice: RigChoice, cycles_in_view: float, share: float) -> float:
    return expected_phase_sigma(
        choice.surface,
        brightness=share * choice.brightness,
        contrast=choice.contrast,
        noise_levels=choice.noise_levels,
        bits=choice.bits,
        sensor=choice.sensor,
        cycles_in_view=cycles_in_view,
    )


def _period_px(choice: RigChoice) -> float:
    """Return the period that was chosen, if a pattern can have it, or the one that is recommended; projector px."""
    length = choice.projector_px[choice.phase_axis]
    whole = fringe_geometry(choice, length)
    camera_px, least = whole.period_camera_px / length, length / CYCLES
    clear = min(_least_pitch_mm(choice.surface) / whole.pitch_mm, 1 / _LEAST_CYCLES) * length
    usual = max(USUAL_CAMERA_PX / camera_px, _LEAST_PROJECTOR_PX, least, clear)
    # Up to a tenth of a px, which the code still fits, and the command line shows as it is.
    usual = ceil(10 * usual) / 10
    period_px = choice.period_px or usual
    if usual > length / _LEAST_CYCLES:
        raise SettingsError(
            f"the projector's {length} px across the stripes lie {camera_px:.3g} camera px apart: not even four cycles "
            "would be seen: take a projector with more px or a longer throw, or a camera with a shorter lens"
        )
    if period_px < least:
        raise SettingsError(
            f"the code distinguishes {CYCLES} cycles, but {length} px hold {length / period_px:.0f} of {period_px:g} "
            f"px: give a period of {usual:g} px, which is {usual * camera_px:.3g} camera px"
        )
    if period_px > length / _LEAST_CYCLES:
        raise SettingsError(
            f"a period of {period_px:g} px leaves fewer than four cycles on the projector's {length} px: give a period "
            f"of {usual:g} px, which is {usual * camera_px:.3g} camera px"
        )
    if period_px * camera_px < _SHORTEST_CAMERA_PX:
        raise SettingsError(
            f"a period of {period_px:g} px is {period_px * camera_px:.3g} camera px, too short to be seen: give "
            f"{usual:g} px, which is {usual * camera_px:.3g} camera px"
        )
    return period_px


def _least_pitch_mm(surface: str) -> float:
    """Return the shortest cycle that leaves red enough of its contrast, mm."""
    return pi * _SCATTER_MM[surface][0] * sqrt(2 / -log(_LEAST_LEFT))


def _usual_exposure_s(longest_s: float, colour_cycle_s: float | None) -> float | None:
    """Return the longest exposure that motion allows, of whole colour cycles where there are any."""
    if longest_s == inf:
        return None
    return longest_s if colour_cycle_s is None else colour_cycle_s * max(1, int(longest_s / colour_cycle_s))


def _warnings(plan: RigPlan) -> list[str]:
    """Return what is wrong with it, one line each, with the cure."""
    choice, fields, fringe, found = plan.choice, plan.fields, plan.fringe, []
    if fields.lit_share < _LIT_ENOUGH:
        found.append(_dark(choice, fields))
    ratio = choice.baseline_mm / choice.distance_mm
    if not _LEAST_RATIO <= ratio <= _MOST_RATIO:
        harm = "a step hides half of its height" if ratio > _MOST_RATIO else "little depth is in the phase"
        found.append(
            f"the baseline is {ratio:.2g} of the distance, and {harm}: a fifth is usual, "
            f"{choice.distance_mm / 5:.3g} mm"
        )
    least_mm = _least_pitch_mm(choice.surface)
    if fringe.pitch_mm < least_mm:
        found.append(
            f"light that scatters under {choice.surface} leaves red {plan.contrast_left[0]:.0%} of its contrast at "
            f"{fringe.pitch_mm:.2g} mm a cycle, which bends phases by 0.1 rad or more: give a period of "
            f"{ceil(10 * plan.period_px * least_mm / fringe.pitch_mm) / 10:g} px, {least_mm:.2g} mm"
        )
    if fringe.period_camera_px < LEAST_CAMERA_PX:
        found.append(
            f"{fringe.period_camera_px:.1f} camera px per cycle lose contrast in the lens: give a longer period, or "
            "none"
        )
    if fringe.period_camera_px > MOST_CAMERA_PX and fringe.pitch_mm > 1.1 * least_mm:
        cure = "a projector with more px" if choice.period_px is None else "a shorter period, or none"
        found.append(f"{fringe.period_camera_px:.0f} camera px per cycle lose precision in depth: take {cure}")
    if plan.cycles_in_view < _ENOUGH_CYCLES:
        found.append(
            f"only {plan.cycles_in_view:.0f} cycles are in view, and a frame does not determine the projector's "
            "response well: run colorphase calibrate radiometry, and give colorphase pattern its --calibration"
        )
    if plan.cycles_in_view < _CODE_CYCLES:
        found.append(
            f"only {plan.cycles_in_view:.0f} cycles are in view, and the code may not place them: give colorphase "
            "decode a --depth-range"
        )
    found += _motion_warnings(plan)
    if plan.board.square_px < LEAST_SQUARE_PX:
        found.append(
            f"the board's squares are {plan.board.square_px:.0f} camera px, and not surely found below "
            f"{LEAST_SQUARE_PX:.0f}: take a camera with more px, or light more of what it sees"
        )
    return found


def _motion_warnings(plan: RigPlan) -> list[str]:
    """Return what motion costs beyond what smoothing and noise do, one line each, with the cure."""
    choice, found = plan.choice, []
    speed, longest_ms = f"{choice.speed_mm_s:g} mm/s", 1e3 * plan.longest_exposure_s
    if plan.exposure_s is not None and plan.exposure_s > 1.001 * plan.longest_exposure_s:
        found.append(
            f"at {speed} the object moves {plan.passed_mm:.2g} mm in an exposure of {1e3 * plan.exposure_s:.3g} ms, "
            f"and details smaller than that are lost: expose for {longest_ms:.2g} ms or less"
            + (", under a projector that shows its colours at once" if choice.colour_cycle_s else "")
        )
    if plan.colour_bias_mm > plan.depth_sigma_mm:
        found.append(
            f"at {speed} colours in turn put a ripple of up to {plan.colour_bias_mm:.2g} mm RMS on the depth: take a "
            "projector that shows its colours at once, or give its projector.fields and decode with the frame before"
        )
    return found


def _dark(choice: RigChoice, fields: SeenFields) -> str:
    """Return what is wrong where the projector's picture is smaller than the camera's."""
    room = fields.picture_over_needed
    return (
        f"the projector lights {100 * fields.lit_share:.2g} % of what the camera sees: take a throw ratio of "
        f"{floor(100 * choice.throw_ratio * room) / 100:g} or less, or a camera's lens of "
        f"{ceil(10 * choice.lens_mm / room) / 10:g} mm or more"
    )
