"""`colorphase calibrate simulate`."""

import shlex
from pathlib import Path

import numpy as np

from pipeline.calibration.board import Board
from pipeline.cli.console import Arch, say, steps


def simulate(*, out: Path, arch: Arch = "auto") -> None:
    """Make captures of a simulated rig for every step of a calibration, to practise on, and the truth to judge it by.

    It takes a minute or two, and 80 MB.

    Example: colorphase calibrate simulate --out practice

    Parameters
    ----------
    out
        The folder to make.
    arch
        Where to compute.
    """
    from pipeline.acquisition import practice_set as practice

    with steps() as show:
        truth = practice.write_practice(out, arch, show)
    board, second = practice.BOARD, practice.SECOND_BOARD
    baseline_mm = float(np.linalg.norm(truth.geometry().translation_mm))
    say(
        f"made {out}: the board's squares are {board.square_mm:g} mm, the second board's {second.square_mm:g} mm; "
        f"camera and projector stand {baseline_mm:g} mm apart; the ball's radius is {practice.BALL_RADIUS_MM:g} mm"
    )
    say("next:")
    for line in _next_commands(out, board, second):
        say(f"  {line}")


def _next_commands(out: Path, board: Board, second: Board) -> list[str]:
    """Return the commands that calibrate the simulated rig and try the result."""
    from pipeline.acquisition import practice_set as practice

    folder = shlex.quote(str(out))
    described = "--board {} --squares {}x{} --square-mm {:g}".format(board.kind, *board.squares, board.square_mm)
    proof = f"--second-board {folder}/{practice.SECOND_POSES} --second-square-mm {second.square_mm:g}"
    light = "--calibration light.json"
    ball = f"{folder}/{practice.BALL} --calibration rig.json"
    return [
        f"colorphase calibrate radiometry {folder}/{practice.LIGHT} --out light.json",
        f"colorphase calibrate geometry {folder}/{practice.POSES} {described} {proof} {light} --out rig.json",
        f"colorphase calibrate check {ball} --shape ball --radius-mm {practice.BALL_RADIUS_MM:g}",
        f"colorphase decode {ball} --out ball",
    ]
