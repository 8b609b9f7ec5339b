"""`colorphase pattern`, `project` and `projector` as their user meets them."""

import json

import cv2
import numpy as np
import pytest
from support.emulators.emulated_pjlink import PJLinkProjector

from pipeline.footage.image_file import read_image
from pipeline.simulation import simulated_rig

PASSWORD = "JBMIAProjectorLink"


def write_rig(projector):
    text = (
        '[trigger]\ndriver = "simulated"\n[timing]\nperiod_s = 0.1\n'
        '[camera]\ndriver = "simulated"\nexposure_s = 0.01\n[projector]\n'
    )
    with open("rig.toml", "w", encoding="utf-8") as file:
        file.write(text + projector)


def test_a_projector_is_switched(command):
    with PJLinkProjector(PASSWORD) as device:
        device.warming_s = 0.2
        write_rig(f'control = "pjlink"\nport = "{device.url}"\npassword = "{PASSWORD}"\n')
        assert command("projector", "on", "--rig", "rig.toml") == (0, "the projector is on\n", "")
        assert device.power == "1"
        assert command("projector", "input", "31", "--rig", "rig.toml") == (0, "", "")
        assert device.input == "31"
        assert command("projector", "blank", "--rig", "rig.toml") == (0, "", "")
        device.errors = "020000"
        code, said, complained = command("projector", "status", "--rig", "rig.toml")
        assert (code, complained) == (0, "")
        assert "ACME X-1" in said
        rows = dict(" ".join(line.split()).strip("│ ").split(" │ ") for line in said.splitlines() if "│" in line)
        assert rows == {"power": "on", "input": "31", "blank": "yes", "faults": "lamp: error", "lamp hours": "1234"}
        assert command("projector", "unblank", "--rig", "rig.toml") == (0, "", "")
        assert device.mute == "30"
        assert command("projector", "off", "--rig", "rig.toml") == (0, "the projector is off\n", "")
        said = command("projector", "status", "--rig", "rig.toml")[1]
        assert said.count("unknown") == 2  # input and blank
        code, _, complained = command("projector", "blank", "--rig", "rig.toml")
        assert code == 1
        assert complained.startswith("error: the projector refuses AVMT 31: not while it is off")


@pytest.mark.parametrize(
    ("projector", "message"),
    [
        ("", 'write control = "pjlink" or "infocus" under [projector]'),
        ('control = "pjlink"', "projector.port is missing"),
        ('control = "pjlink"\nport = "/dev/ttyUSB0"', "PJLink is spoken over the network"),
        ('control = "pjlink"\nport = "socket://127.0.0.1:99999"', "PJLink is spoken over the network"),
        ('control = "infocus"\nport = "/dev/ttyNONE"', "there is no port /dev/ttyNONE"),
        ("gamma = 2", "projector.gamma: is not a known key"),
    ],
)
def test_mistakes_in_the_rig_file_are_one_line(command, projector, message):
    write_rig(projector)
    code, said, complained = command("projector", "status", "--rig", "rig.toml")
    assert (code, said) == (1, "")
    assert message in complained
    assert complained.count("\n") == 1


def test_a_picture_is_shown(command):
    cv2.imwrite("grey.png", np.zeros((768, 1024), np.uint8))
    code, said, complained = command("project", "grey.png", "--seconds", "0.1")
    assert (code, said, complained) == (0, "grey.png is on display 0, 1024x768; Esc, q or Ctrl-C ends it\n", "")
    assert command("pattern", "pattern.png", "--brightness", "0.85")[0] == 0
    assert command("project", "pattern.png", "--display", "0", "--seconds", "0.1")[0] == 0


@pytest.mark.parametrize(
    ("name", "picture", "message"),
    [
        ("p.png", np.zeros((480, 640, 3), np.uint8), "the picture is 640x480, but display 0 is 1024x768"),
        ("p.png", np.zeros((768, 1024, 3), np.uint16), "has 16 bits a colour, and displays take 8"),
        ("p.png", np.zeros((768, 1024, 4), np.uint8), "save it without transparency"),
        ("p.jpg", np.zeros((768, 1024, 3), np.uint8), "is no PNG: make one with colorphase pattern"),
        ("p.png", None, "cannot read p.png"),
    ],
)
def test_pictures_that_are_refused(command, name, picture, message):
    if picture is not None:
        cv2.imwrite(name, picture)
    code, said, complained = command("project", name, "--seconds", "0.1")
    assert (code, said) == (1, "")
    assert message in complained
    assert complained.count("\n") == 1


def test_a_pattern_for_a_display_has_its_size(command, tmp_path):
    assert command("pattern", "pattern.png", "--display", "0") == (0, "", "")
    assert read_image(tmp_path / "pattern.png").shape == (768, 1024, 3)
    assert "there is no display 7: choose one of 0 (1024x768)" in command("pattern", "p.png", "--display", "7")[2]
    assert "--size or --display, not both" in command("pattern", "p.png", "--display", "0", "--size", "8x8")[2]
    rig = simulated_rig()
    other = rig.projector.model_copy(update={"size_px": (1920, 1080)})
    response = np.tile(np.linspace(0, 1, 256), (3, 1))
    rig.model_copy(update={"projector": other, "response": response}).write(tmp_path / "rig.json")
    said = command("pattern", "p.png", "--display", "0", "--calibration", "rig.json")[2]
    assert "display 0 is 1024x768 but the calibrated projector is 1920x1080" in said
    assert not (tmp_path / "p.png").exists()


def test_a_pattern_has_the_size_that_was_asked_for(command, tmp_path):
    assert command("pattern", "pattern.png", "--size", "320x240") == (0, "", "")
    assert read_image(tmp_path / "pattern.png").shape == (240, 320, 3)
    described = json.loads((tmp_path / "pattern.json").read_text())
    assert described["stripes"] == "horizontal" and described["code"] == "contrast"


def test_a_pattern_that_needs_a_geometry_says_so_where_there_is_none(command, tmp_path):
    status, _, said = command("pattern", "p.png", "--size", "320x240", "--code", "contrast2", "--period", "12")
    assert status == 0 and said.count("\n") <= 2 and "contrast2 is decoded by a calibrated geometry only" in said
    described = json.loads((tmp_path / "p.json").read_text())
    assert (described["code"], described["code_version"], described["cell_px"]) == ("contrast2", 1, 6)
    assert np.ptp(read_image(tmp_path / "p.png"), axis=1).max() > 20, "a picture, not lines"
    response = np.tile(np.linspace(0, 1, 256), (3, 1))
    simulated_rig(code="contrast2").model_copy(update={"response": response}).write(tmp_path / "rig.json")
    assert command("pattern", "q.png", "--calibration", "rig.json") == (0, "", "")
    described = json.loads((tmp_path / "q.json").read_text())
    assert (described["code"], described["cell_px"]) == ("contrast2", pytest.approx(768 / 88))


def test_a_plain_pattern_is_asked_for(command, tmp_path):
    assert command("pattern", "plain.png", "--size", "320x240", "--code", "none") == (0, "", "")
    assert json.loads((tmp_path / "plain.json").read_text())["code"] is None
    error = command("pattern", "fine.png", "--size", "1920x1080", "--period", "6")[2]
    assert "take a period of 7.94 px or more, or no code" in error
    assert command("pattern", "fine.png", "--size", "1920x1080", "--period", "6", "--code", "none")[0] == 0
