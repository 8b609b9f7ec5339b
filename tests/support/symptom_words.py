"""What the commands say of the frames of `docs/troubleshooting.md`, as the page quotes it."""

import io
import json
import re
import warnings
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path

import numpy as np
from support.symptom_frames import SEQUENCES, SYMPTOMS

from pipeline.cli.console import run
from pipeline.cli.main import command_line
from pipeline.output.range_image import write_png

_RULES = re.compile("[│┃┏┓┗┛┡┩└┘├┤─━┳┻╇┴┬]")  # of tables
_PROGRESS = re.compile(".*, after [0-9]+ s")  # said of what takes long, on a slow machine
#: What `colorphase calibrate check` is told was captured.
_SHAPES = {
    "projector_moved": ("--shape", "plane"),
    "wrong_scale": ("--shape", "ball", "--radius-mm", "85"),
    "rolling_shutter": ("--shape", "plane"),
}


def said_by(*arguments: str) -> list[str]:
    """Run a command in this process, and return its lines, rows of tables as words; a table of JSON is taken apart."""
    told = io.StringIO()
    with warnings.catch_warnings(), redirect_stdout(told), redirect_stderr(told):
        warnings.simplefilter("always")
        try:
            run(partial(command_line(arguments), arguments))
        except SystemExit:
            pass
    lines = [" ".join(_RULES.sub(" ", line).split()) for line in told.getvalue().splitlines()]
    return [line for line in lines if line and not _PROGRESS.fullmatch(line)]


def inspected(path: Path, settings: Path) -> list[str]:
    """Return what `colorphase inspect` finds that is not fine, as topic | found | what to change."""
    lines = said_by("inspect", str(path), "--settings", str(settings), "--arch", "cpu", "--json")
    found = json.loads("\n".join(lines[lines.index("{") :]))  # what is said beside the result comes before it
    rows = [f for f in found["findings"] if f["grade"] != "fine"]
    return [f"{row['topic']} | {row['found']} | {row['advice']}" for row in rows]


def what_is_said(name: str, folder: Path) -> list[str]:
    """Return what decode, inspect and calibrate check say of a symptom, each line after its command's name."""
    if name in SEQUENCES:
        film, calibration = SEQUENCES[name]()
        path = folder / "frames"
        path.mkdir()
        for number, truth in enumerate(film):
            write_png(path / f"{number:02}.png", np.asarray(truth.image, np.uint8))
        calibration.write(folder / "calibration.json")
        (folder / "settings.toml").touch()
        with_rig, alone = True, ("--workers", "1")
    else:
        symptom = SYMPTOMS[name]()
        path, with_rig, alone = symptom.write(folder), symptom.calibration is not None, ()
    settings, rig = folder / "settings.toml", ("--calibration", str(folder / "calibration.json")) if with_rig else ()
    also = (*rig, "--settings", str(settings), "--arch", "cpu")
    decoded = said_by("decode", str(path), "--out", str(folder / "result"), *alone, *also)
    lines = [f"decode: {line}" for line in decoded]
    lines += [f"inspect: {line}" for line in inspected(path, settings)]
    known = {line for line in decoded if line.startswith("warning: ")}  # which the check gives again
    if with_rig:
        checked = said_by("calibrate", "check", str(path), *_SHAPES.get(name, ()), *also)
        lines += [f"check: {line}" for line in checked if not line.startswith("figure ") and line not in known]
    return [line.replace(f"{folder}/", "") for line in lines]
