"""`colorphase calibrate capture` on a display, with a driver of one's own, and simulated."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.command_line import command as command_line
from support.screen_camera import FOLDER
from support.virtual_screen import screen

from pipeline.calibration import Calibration, Pattern
from pipeline.calibration.model import DEFAULT_PERIOD_PX
from pipeline.footage.opening import open_footage
from pipeline.pattern import make_pattern

MIX = np.array([[9, 1, 0], [1, 8, 1], [0, 1, 9]])
TESTS = Path(__file__).resolve().parents[3]
ON_A_SCREEN = """
calibration = "calibration.json"
[trigger]
driver = "software"
[timing]
period_s = 0.02
[projector]
display = 0
[camera]
driver = "support.screen_camera:ScreenCamera"
exposure_s = 0.01
trigger = "software"
"""


@pytest.mark.skipif(os.name == "nt", reason="Xvfb is for X11")
def test_the_light_of_a_screen_is_measured_through_a_driver_of_ones_own(tmp_path):
    """Every picture goes through SDL, an X server, the camera's driver and the rig."""
    (tmp_path / "pixels").mkdir()
    (tmp_path / "rig.toml").write_text(ON_A_SCREEN)
    with screen(tmp_path / "pixels", "160x120x24") as shown:
        places = os.pathsep.join([str(TESTS), str(TESTS.parent)])
        environment = {**os.environ, "DISPLAY": shown.name, FOLDER: str(tmp_path / "pixels"), "PYTHONPATH": places}

        def run(*arguments):
            done = subprocess.run(
                command_line(*arguments),
                cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=240, check=False,
            )  # fmt: skip
            assert done.returncode == 0, done.stderr
            return done

        done = run("calibrate", "capture", "radiometry", "--rig", "rig.toml", "--out", "captures")
        run("capture", "--rig", "rig.toml", "--out", "face")
    assert "good: response and crosstalk leave a ripple of 0.00" in done.stdout
    found = Calibration.read(tmp_path / "calibration.json")
    assert found.crosstalk_matrix[0] == pytest.approx([0.72, 0.08, 0.0], abs=3e-3)
    assert len(list((tmp_path / "captures" / "light").glob("*.png"))) == 33
    assert (tmp_path / "captures" / "guide.png").exists()
    # The capture has shown the pattern with the response undone: its light is sinusoidal.
    (stored,) = open_footage(tmp_path / "face" / "recording.zarr").frames()
    assert Calibration.read(tmp_path / "face" / "calibration.json").pattern.compensated
    light = make_pattern((160, 120), Pattern(period_px=DEFAULT_PERIOD_PX, code="contrast"), None) @ MIX
    assert np.abs(stored.planes[0] / 255 - 0.02 - 0.08 * light).max() < 0.03
