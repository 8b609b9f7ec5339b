"""A projector that shows nothing is refused; a camera that stands otherwise than at calibration is told."""

import numpy as np
import pytest
from support.emulators.emulated_pjlink import PJLinkProjector

from hardware.errors import ProjectorError
from pipeline.acquisition.chosen_rig import choose_rig
from pipeline.calibration import Calibration
from pipeline.models import CameraState

RIG = """
calibration = "calibration.json"
[trigger]
driver = "box"
port = "/dev/ttyNONE"
[timing]
period_s = 0.02
[camera]
driver = "opencv"
exposure_s = 0.01
"""


def silent(said):
    raise AssertionError(said)


@pytest.fixture
def rig_file(tmp_path):
    """Write the file of a rig that was calibrated with another exposure."""
    Calibration(crosstalk_matrix=np.eye(3), capture=CameraState(exposure_s=0.008)).write(tmp_path / "calibration.json")
    file = tmp_path / "rig.toml"
    file.write_text(RIG, encoding="utf-8")
    return file


def test_another_exposure_than_at_calibration_is_said(rig_file):
    chosen = choose_rig(str(rig_file), "cpu", silent)
    assert chosen.calibration is not None
    assert chosen.differences() == ["the exposure is 0.01 s, and was 0.008 s at calibration"]
    rig_file.write_text(RIG.replace("0.01", "0.008"), encoding="utf-8")
    assert choose_rig(str(rig_file), "cpu", silent).differences() == []


def test_a_projector_that_shows_nothing_is_refused(rig_file):
    with PJLinkProjector("secret") as device:
        rig_file.write_text(
            f'{RIG}[projector]\ncontrol = "pjlink"\nport = "{device.url}"\npassword = "secret"\n', encoding="utf-8"
        )
        with pytest.raises(ProjectorError, match=r"is off: run `colorphase projector on --rig .*rig.toml`"):
            choose_rig(str(rig_file), "cpu", silent)
        device.switch(on=True)
        device.mute = "31"
        with pytest.raises(ProjectorError, match="the projector shows black: run `colorphase projector unblank"):
            choose_rig(str(rig_file), "cpu", silent)
        device.mute = "30"
        choose_rig(str(rig_file), "cpu", silent)
