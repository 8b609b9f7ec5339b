"""The command in this process, and a folder as a user may have it: a frame, its calibration, and settings."""

import shutil

import numpy as np
import pytest
from support.command_in_process import command

from pipeline.output.range_image import write_png
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

__all__ = ["command", "folder"]


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
