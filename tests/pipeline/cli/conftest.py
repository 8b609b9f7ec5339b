"""The command in this process, and a folder as a user may have it: a frame, its calibration, and settings."""

import shutil
import warnings
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

from hardware.projector import pjlink, switching
from pipeline.cli import main as cli
from pipeline.cli.main import app
from pipeline.output.range_image import write_png
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig


@pytest.fixture(scope="session")
def folder(tmp_path_factory, cpu):
    """Return a folder with a frame of our own simulator, its calibration, and a black picture."""
    folder = tmp_path_factory.mktemp("cli")
    rig = simulated_rig((320, 240), period_px=2 * 768 / 44)
    settings = SimulationSettings()
    write_png(folder / "frame.png", simulate_frame(rig, settings).image)
    rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix}).write(folder / "calibration.json")
    write_png(folder / "black.png", np.zeros((64, 64, 3), np.uint8))
    (folder / "settings.toml").write_text("smoothing_px = 3\n")
    (folder / "pictures").mkdir()
    shutil.copy(folder / "frame.png", folder / "pictures")
    return folder


class Done(NamedTuple):
    """What a command left."""

    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    """Return a function that runs the command in this process, where kernels are compiled once."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(pjlink, "ANSWER_S", 0.5)
    monkeypatch.setattr(switching, "POLL_S", 0.02)

    def run(*arguments, cwd=tmp_path):
        monkeypatch.chdir(cwd)
        # Given its words, it does not warn that it reads the test runner's.
        monkeypatch.setattr(cli, "app", partial(app, [str(argument) for argument in arguments]))
        code = 0
        with warnings.catch_warnings():  # which it shows in a way of its own
            warnings.simplefilter("default")
            try:
                cli.main()
            except SystemExit as stopped:
                code = stopped.code
        return Done(code, *capsys.readouterr())

    return run
