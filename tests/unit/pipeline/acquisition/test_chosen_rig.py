"""The rig that is used: what its file may say, and whether it is ready."""

from pathlib import Path

import numpy as np
import pytest
from support.emulators.emulated_pjlink import PJLinkProjector

from hardware.errors import ProjectorError, RigError
from hardware.settings import RigSettings
from pipeline.acquisition.chosen_rig import choose_rig, read_rig
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


SECTIONS = {
    "trigger": 'driver = "box"\nport = "/dev/ttyUSB0"',
    "timing": "period_s = 0.1\nframes = 30",
    "camera": 'driver = "basler"\nexposure_s = 0.0166667\nsize_px = [640, 480]',
    "projector": 'colour_cycle_s = 0.0166667\ncontrol = "pjlink"\nport = "socket://10.0.0.6:4352"',
}


def write(folder: Path, top: str = "", **changed: str | None) -> Path:
    path = folder / "rig.toml"
    sections = {**SECTIONS, **changed}
    texts = [top, *(f"[{name}]\n{text}" for name, text in sections.items() if text is not None)]
    path.write_text("\n".join(texts), encoding="utf-8")
    return path


def test_a_rig(tmp_path):
    rig = read_rig(write(tmp_path))
    assert isinstance(rig, RigSettings)
    assert rig.timing.frames == 30
    assert rig.camera.size_px == (640, 480)
    assert rig.projector.control == "pjlink"
    assert rig.calibration is None
    assert read_rig(str(write(tmp_path, projector=None))).projector.control is None


def test_a_serial_number_may_be_written_as_a_number(tmp_path):
    rig = read_rig(write(tmp_path, camera='driver = "basler"\nexposure_s = 0.01\nserial = 40012345'))
    assert rig.camera.serial == "40012345"


def test_the_calibration_is_found_beside_it(tmp_path, monkeypatch):
    (tmp_path / "rigs").mkdir()
    path = write(tmp_path / "rigs", 'calibration = "measured/calibration.json"')
    assert read_rig(path).calibration == str(tmp_path / "rigs" / "measured" / "calibration.json")
    monkeypatch.chdir(tmp_path)
    assert read_rig("rigs/rig.toml").calibration == str(Path("rigs/measured/calibration.json"))
    absolute = tmp_path / "calibration.json"
    write(tmp_path / "rigs", f"calibration = '{absolute}'")
    assert read_rig(path).calibration == str(absolute)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trigger": None}, "trigger: is missing"),
        ({"timing": ""}, "timing.period_s: is missing"),
        ({"timing": "period_s = 0.1\nperiods = 3"}, "timing.periods: is not a known key"),
        ({"timing": 'period_s = "fast"'}, "timing.period_s: must be a number above 0 and at most 3600"),
        ({"timing": "period_s = 0"}, "timing.period_s: must be a number above 0 and at most 3600, got 0"),
        ({"timing": "period_s = inf"}, "timing.period_s: must be a number above 0 and at most 3600, got Infinity"),
        ({"camera": 'driver = "leica"\nexposure_s = 0.1'}, 'camera.driver: must be "basler"'),
        ({"projector": 'control = "telnet"'}, 'projector.control: must be "pjlink"'),
        ({"lamp": "on = true"}, "lamp: is not a known key"),
        ({"trigger": "driver = "}, "is not what it should be"),
    ],
)
def test_one_line_names_the_key(tmp_path, changes, message):
    path = write(tmp_path, **changes)
    with pytest.raises(RigError) as fault:
        read_rig(path)
    assert message in str(fault.value)
    assert str(path) in str(fault.value)
    assert "\n" not in str(fault.value)


def test_there_is_none(tmp_path):
    with pytest.raises(RigError, match=r"cannot read .*rig\.toml: No such file"):
        read_rig(tmp_path / "rig.toml")


def test_a_password_is_not_in_a_message(tmp_path):
    path = write(tmp_path, projector='control = "pjlink"\npassword = "secret"\nbaud = "many"')
    with pytest.raises(RigError, match=r"projector\.baud") as fault:
        read_rig(path)
    assert "secret" not in str(fault.value)
