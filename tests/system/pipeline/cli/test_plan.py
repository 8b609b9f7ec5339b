"""`colorphase plan` as its user meets it, and its page, whose figures are what it prints."""

import re
import shlex
from pathlib import Path

import pytest

from pipeline.cli import console

PAGE = Path(__file__).resolve().parents[4] / "docs" / "planning.md"
HEAD = "| rig | options |"


def figures(said):
    """Return the printed figure of each name."""
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in said.splitlines() if line.startswith("│")]
    return {name: figure for name, figure, _ in rows if name}


def test_it_prints_what_to_buy_show_and_print(command):
    code, said, complained = command(
        *("plan", "--distance", 900, "--baseline", 180, "--camera", "640x480", "--pixel-um", 4.8, "--lens", 6)
    )
    assert (code, complained) == (0, "")
    found = figures(said)
    assert found["camera sees"] == "458 x 343 mm" and found["period"] == "16.5 px"
    assert found["depth per cycle"] == "43 mm" and found["board"] == "11x8 of 29 mm"
    assert "colorphase pattern pattern.png --size 1024x768 --period 16.5 --stripes horizontal" in said
    assert "colorphase pattern board.pdf --board charuco --squares 11x8 --square-mm 29" in said


def test_it_prints_the_lateral_resolution(command):
    """Of 0.72 mm per px; a mosaic makes it 12 % coarser."""
    _, said, _ = command("plan", "--sensor", "rgb")
    assert figures(said)["lateral resolution"] == "4.1 mm"
    _, said, _ = command("plan")
    assert figures(said)["lateral resolution"] == "4.6 mm"


def test_it_prints_what_the_calibration_leaves(command, monkeypatch):
    monkeypatch.setattr(console.stdout, "width", 200)
    _, said, _ = command("plan")
    (row,) = (line for line in said.splitlines() if line.startswith("│ calibration "))
    assert "0.14 mm" in row and "10 poses of 12 pictures leave depth off by this (one standard deviation)" in row
    assert "by 0.24 mm with a ChArUco board" in row
    _, said, _ = command("plan", "--baseline", 500, "--lens", 1.5, "--throw", 1.2)
    assert figures(said)["calibration"] == "unknown"


def test_what_it_tells_to_run_can_be_run(command, tmp_path):
    _, said, _ = command("plan", "--stripes", "vertical", "--projector", "1280x800")
    for told in re.findall(r"colorphase (pattern [^│;]*)", said):
        done = command(*shlex.split(told))
        assert done.returncode == 0, done.stderr
    assert {"pattern.png", "board.pdf"} <= {path.name for path in tmp_path.iterdir()}


def test_what_is_wrong_is_a_warning_beside_the_table(command):
    code, said, complained = command("plan", "--throw", 2.2)
    assert code == 0 and "camera sees" in said
    assert complained.startswith("warning: the projector lights 83 % of what the camera sees: take a throw ratio")
    assert complained.count("\n") == 1


def test_what_holds_still_has_any_exposure(command):
    code, said, _ = command("plan", "--speed", 0, "--exposure-s", 0.5, "--colour-cycle-s", 1 / 60)
    assert code == 0 and "moved meanwhile" not in said
    assert figures(said)["longest exposure"] == "any" and "whole colour cycles of 17 ms" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--baseline", 900), "a fifth is usual, 180 mm"),
        (("--throw", 9), "take a throw ratio of 1.93 or less"),
        (("--period", 8), "too short to be seen: give 16.5 px"),
        (("--camera", "wide"), "--camera is 'wide'"),
        (("--projector", "1024"), "--projector is '1024'"),
        (("--distance", "nan"), "distance_mm"),
        (("--exposure-s", 0.02, "--colour-cycle-s", 0.0166667), "set exposure_s to 0.0166667 s or 0.0333334 s"),
        (("--bits", 9), "Invalid value"),
    ],
)
def test_mistakes_are_one_line(command, arguments, message):
    code, said, complained = command("plan", *arguments)
    assert code != 0 and said == ""
    assert message in complained and complained.count("\n") == 1


def page_rows():
    """Return the page's table of rigs: the names of its figures, and each rig's options and figures."""
    lines = PAGE.read_text(encoding="utf-8").partition(HEAD)[2].splitlines()
    names = [cell.strip() for cell in lines[0].split("|")[:-1]]
    rows = []
    for line in lines[2:]:
        if not line.startswith("|"):
            break
        rig, options, *cells = (cell.strip() for cell in line.split("|")[1:-1])
        rows.append(pytest.param(options.strip("`"), dict(zip(names, cells, strict=True)), id=rig))
    return rows


def test_the_page_has_rigs():
    assert len(page_rows()) >= 5


@pytest.mark.parametrize(("options", "told"), page_rows())
def test_the_pages_table_is_what_the_command_prints(command, options, told):
    code, said, complained = command("plan", *shlex.split(options))
    assert (code, complained) == (0, "")
    printed = figures(said)
    assert {name: printed[name] for name in told} == told


def test_the_pages_output_is_what_the_command_prints(command, monkeypatch):
    page = PAGE.read_text(encoding="utf-8")
    told, shown = re.search(r"\n    colorphase (plan .*?)\n\n```text\n(.*?)```", page, flags=re.DOTALL).groups()
    monkeypatch.setattr(console.stdout, "width", 118)
    code, said, complained = command(*shlex.split(told.replace("\\\n", " ")))
    assert (code, complained) == (0, "")
    assert said == shown
