"""`colorphase calibrate capture ...`: the pictures of a calibration are shown and taken, and the rig is calibrated."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from hardware.drivers import SIMULATED
from hardware.settings import RigSettings
from pipeline.acquisition.chosen_rig import read_rig
from pipeline.acquisition.guided_capture import GuidedCapture
from pipeline.acquisition.simulated_capture import SETTINGS
from pipeline.acquisition.studio import Studio
from pipeline.calibration.board import Board
from pipeline.calibration.pose_guide import PoseGuide
from pipeline.cli import calibrate
from pipeline.cli.console import read_calibration, remark
from pipeline.cli.opened_studio import opened_studio
from pipeline.cli.project import BoardOptions, PatternOptions

_BOARD, _FRINGES = BoardOptions(), PatternOptions()
#: The picture for whoever holds the board, and the calibration where the rig's file names none.
GUIDE, CALIBRATION = "guide.png", "calibration.json"
_Rig = Annotated[
    str,
    Parameter(
        help="The rig's TOML file, whose projector.display shows the pictures; or simulated, which needs nothing to be "
        "there."
    ),
]
_Captures = Annotated[Path, Parameter(help=f"The folder of the captures; {GUIDE} in it shows where to hold the board.")]
_Shown = Annotated[Literal["charuco", "chessboard"], Parameter(help="What the board is.")]
_Baseline = Annotated[
    float | None,
    Parameter(help="The distance between camera and projector where it is known; a wrong square size shows in it."),
]


@dataclass(frozen=True)
class _Capture:
    """A guided capture under way."""

    guided: GuidedCapture
    studio: Studio
    settings: RigSettings
    target: Path  # the calibration to write


def radiometry(*, rig: _Rig, out: _Captures) -> None:
    """Show 33 plain pictures on a white sheet, take each, and measure the rig's light.

    Stopped at any time, it continues where it was when it is called again. The calibration is the one that the rig's
    file names, else calibration.json in the folder; its geometry is kept.

    Example: colorphase calibrate capture radiometry --rig rig.toml --out captures
    """
    with _capturing(rig, out, None) as capture:
        folder = capture.guided.take_light()
    size_px = "{}x{}".format(*capture.studio.projector_px)
    calibrate.radiometry(
        folder,
        out=capture.target,
        size=size_px,
        calibration=_kept(capture.target, out),
        exposure_s=capture.settings.camera.exposure_s,
        force=True,
    )


def geometry(
    *,
    rig: _Rig,
    out: _Captures,
    board: _Shown = "charuco",
    options: BoardOptions = _BOARD,
    fringes: PatternOptions = _FRINGES,
    baseline_mm: _Baseline = None,
) -> None:
    """Say where to hold a board, take its pictures in each pose, and measure lenses and places.

    A pose is taken when the board has been still for 2 s, or Enter is pressed. It ends when another pose would hardly
    lower the uncertainty of depth. Stopped at any time, it continues where it was when it is called again. The
    calibration is the one that the rig's file names, else calibration.json in the folder; its light is kept.

    Example: colorphase calibrate capture geometry --rig rig.toml --out captures --board chessboard --squares 11x8
    --square-mm 24
    """
    described = options.board(board)
    with _capturing(rig, out, described) as capture:
        known = _kept(capture.target, out)
        pattern = fringes.pattern(read_calibration(known))
        camera_px = capture.guided.camera_px
        guide = PoseGuide(described, camera_px, capture.studio.projector_px, pattern)
        folder = capture.guided.take_poses(described, guide)
    calibrate.geometry(
        folder,
        out=capture.target,
        size="{}x{}".format(*capture.studio.projector_px),
        board=board,
        options=options,
        fringes=fringes,
        baseline_mm=baseline_mm,
        calibration=known,
        force=True,
    )


@contextmanager
def _capturing(rig: str, out: Path, board: Board | None) -> Iterator[_Capture]:
    """Open a rig for a guided capture, checked for faults."""
    settings = SETTINGS if rig == SIMULATED else read_rig(rig)
    target = out / CALIBRATION if settings.calibration is None else Path(settings.calibration)
    with opened_studio(settings, rig, board, out / GUIDE) as (studio, show):
        identity = {"camera": settings.camera.model_dump(mode="json")}
        if board is not None:
            identity["board"] = board.model_dump(mode="json")
        guided = GuidedCapture(studio, out, identity, show, remark)
        guided.check_rig()
        yield _Capture(guided, studio, settings, target)


def _kept(target: Path, out: Path) -> Path | None:
    """Return an earlier calibration, which is kept in the captures' folder, too; None: there is none."""
    if not target.exists():
        return None
    earlier = out / "earlier-calibration.json"
    shutil.copyfile(target, earlier)
    return earlier


def everything(
    *,
    rig: _Rig,
    out: _Captures,
    board: _Shown = "charuco",
    options: BoardOptions = _BOARD,
    fringes: PatternOptions = _FRINGES,
    baseline_mm: _Baseline = None,
) -> None:
    """Show and take the pictures of a calibration, and calibrate the rig: its light, then its geometry.

    First a white sheet is put before the rig, then a board is held where the command says. Stopped at any time, it
    continues where it was when it is called again. radiometry and geometry do one of the two.

    Example: colorphase calibrate capture --rig rig.toml --out captures --board chessboard --squares 11x8 --square-mm 24
    """
    radiometry(rig=rig, out=out)
    geometry(rig=rig, out=out, board=board, options=options, fringes=fringes, baseline_mm=baseline_mm)


capture = App(name="capture")
capture.default(everything)
for command in (radiometry, geometry):
    capture.command(command)
