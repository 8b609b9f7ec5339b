"""`colorphase plan`."""

import inspect
import re
from collections.abc import Iterator
from math import inf
from typing import Annotated, Any

from cyclopts import Parameter
from rich.table import Table

from pipeline.cli.console import remark, size_of, stdout
from pipeline.planning import RigChoice, RigPlan, plan_rig
from pipeline.planning.expected_calibration import PICTURES, POSES
from pipeline.planning.motion_cost import motion_costs
from pipeline.planning.rig_plan import TILTS_DEG

# The options are the fields of a rig, named without units.
_UNITS = re.compile("_(mm|mm_s|px|levels|ratio)$")


def plan(**values: Any) -> None:
    """Print what a rig will measure before it is bought: field, pattern, accuracy, exposure, and the board to print.

    The equations, and how well simulated frames met them, are in docs/planning.md.

    Example: colorphase plan --distance 900 --baseline 180 --camera 640x480 --pixel-um 4.8 --lens 6 --throw 1.75
    """
    for name in values.keys() & {"camera_px", "projector_px"}:
        values[name] = size_of(values[name], f"--{_option(name)}")
    found = plan_rig(**values)
    table = Table("what", "figure", "which means")
    for row in _rows(found):
        table.add_row(*row)
    stdout.print(table)
    for warning in found.warnings:
        remark(f"warning: {warning}")


def _option(field: str) -> str:
    return _UNITS.sub("", field).replace("_", "-")


def _options() -> Iterator[inspect.Parameter]:
    """Yield an option for each field of a rig, explained by the field's docstring."""
    for name, field in RigChoice.model_fields.items():
        kind, default = field.annotation, field.default
        if isinstance(default, tuple):
            kind, default = str, "{}x{}".format(*default)
        annotation = Annotated[kind, Parameter(name=_option(name), help=field.description)]  # type: ignore[valid-type]
        yield inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


plan.__signature__ = inspect.Signature([*_options()])  # type: ignore[attr-defined]  # of any function


def _rows(plan: RigPlan) -> list[tuple[str, str, str]]:
    """Return what is printed: the name, the figure with its unit, and what it means or what to do with it."""
    choice, fields, fringe = plan.choice, plan.fields, plan.fringe
    near, far = fringe.lit_range_mm
    window = "{}x{}".format(*map(_number, plan.window_mm))
    size = "{}x{}".format(*choice.projector_px)
    return [
        ("camera sees", _area(fields.camera_mm), f"{_number(fields.mm_per_px)} mm per pixel"),
        (
            "projector lights",
            _area(fields.projector_mm),
            f"both see {_area(fields.overlap_mm)}; {100 * fields.lit_share:.0f} % of what the camera sees is lit",
        ),
        (
            "angle between them",
            f"{plan.angle_deg:.1f} deg",
            f"a step of 10 mm hides {_number(10 * choice.baseline_mm / choice.distance_mm)} mm behind it",
        ),
        (
            "period",
            f"{plan.period_px:g} px",
            f"colorphase pattern pattern.png --size {size} --period {plan.period_px:g} --stripes {choice.stripes}",
        ),
        (
            "cycle on the object",
            f"{_number(fringe.pitch_mm)} mm",
            f"{fringe.period_camera_px:.1f} camera px; {plan.cycles_in_view:.0f} cycles in view",
        ),
        *_scatter_rows(plan),
        ("depth per radian", f"{_number(fringe.depth_per_rad_mm)} mm", "of the phase"),
        (
            "depth per cycle",
            f"{_number(fringe.depth_per_cycle_mm)} mm",
            "a step of this depth does not show under a plain pattern",
        ),
        (
            "absolute depth",
            f"{near:.0f} mm to " + ("infinity" if far == inf else f"{far:.0f} mm"),
            f"by the code, where both lenses are sharp; a surface must span {_number(plan.code_mm)} mm across the "
            f"stripes; with contrast2 {window} mm (across x along)",
        ),
        (
            "phase sigma",
            f"{_number(plan.phase_sigma_rad)} rad",
            f"of a pixel; {_number(plan.dark_phase_sigma_rad)} rad where it is half as bright",
        ),
        (
            "depth sigma",
            f"{_number(plan.depth_sigma_mm)} mm",
            f"of a pixel; {_number(plan.dark_depth_sigma_mm)} mm where it is half as bright",
        ),
        (
            "lateral resolution",
            f"{_number(plan.lateral_limit_mm)} mm",
            "the period of a relief of which half is left, along and across the stripes",
        ),
        *_motion_rows(plan),
        *_board_rows(plan),
    ]


def _scatter_rows(plan: RigPlan) -> list[tuple[str, str, str]]:
    """Return what is printed of light that scatters under the surface."""
    red, green, blue = (f"{100 * left:.0f} %" for left in plan.contrast_left)
    if red == blue:
        return []
    return [
        ("contrast left", red, f"of red, {green} of green, {blue} of blue: light scatters under {plan.choice.surface}")
    ]


def _motion_rows(plan: RigPlan) -> list[tuple[str, str, str]]:
    """Return what is printed of exposure and motion."""
    choice = plan.choice
    whole = (
        "" if choice.colour_cycle_s is None else f"; whole colour cycles of {_number(1e3 * choice.colour_cycle_s)} ms"
    )
    if plan.exposure_s is None or choice.speed_mm_s == 0:
        return [("longest exposure", "any", f"nothing moves{whole}")]
    speed = f"at {choice.speed_mm_s:g} mm/s"
    exposure, *others = motion_costs(choice.speed_mm_s, plan.fields.mm_per_px, choice.colour_cycle_s)
    return [
        (exposure.topic, f"{_number(exposure.value)} {exposure.unit}", exposure.meaning + whole),
        (
            "moved meanwhile",
            f"{_number(plan.passed_mm)} mm",
            f"in {_number(1e3 * plan.exposure_s)} ms; the depth is that of the exposure's middle",
        ),
        *((cost.topic, f"{_number(cost.value)} {cost.unit}", cost.meaning) for cost in others),
        ("frame rate", f"{_number(plan.least_rate_hz)} Hz", f"or more, to carry orders {speed} under a plain pattern"),
    ]


def _board_rows(plan: RigPlan) -> list[tuple[str, str, str]]:
    """Return what is printed of the board."""
    board = plan.board
    squares = "{}x{}".format(*board.squares)
    left = (
        f"{POSES} poses of {PICTURES} pictures leave depth off by this (one standard deviation) with a chessboard, by "
        f"{_number(plan.charuco_bias_mm)} mm with a ChArUco board"
    )
    calibration = (f"{_number(plan.chessboard_bias_mm)} mm", left)
    if inf in (plan.chessboard_bias_mm, plan.charuco_bias_mm):
        calibration = ("unknown", "camera and projector do not both face the board in every pose")
    return [
        (
            "board",
            f"{squares} of {board.square_mm:.3g} mm",
            f"colorphase pattern board.pdf --board charuco --squares {squares} --square-mm {board.square_mm:.3g}; "
            f"sheet: {board.sheet}; {board.square_px:.0f} camera px per square",
        ),
        (
            "board's tilt",
            "{} to {} deg".format(*TILTS_DEG),
            f"eight poses or more; the lenses must be sharp {_number(board.sharp_mm)} mm before and behind",
        ),
        ("calibration", *calibration),
    ]


def _area(size_mm: tuple[float, float]) -> str:
    return "{} x {} mm".format(*map(_number, size_mm))


def _number(value: float) -> str:
    """Return a number in two figures, or whole if it is 10 or more."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
