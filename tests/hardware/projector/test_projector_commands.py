"""`colorphase project` and `colorphase projector` as their user meets them."""

import warnings
from functools import partial

import cv2
import numpy as np
import pytest
from support.emulators.emulated_pjlink import PJLinkProjector

from hardware.projector import pjlink, switching
from pipeline.cli import main as cli
from pipeline.cli.main import app

PASSWORD = "JBMIAProjectorLink"


@pytest.fixture
def colorphase(monkeypatch, capsys, tmp_path):
    """Return a function that runs the command, and returns its exit code, output and complaints."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # which it replaces
    monkeypatch.setattr(pjlink, "ANSWER_S", 0.5)
    monkeypatch.setattr(switching, "POLL_S", 0.02)

    def run(*arguments):
        # Given its words, it does not warn that it reads the test runner's.
        monkeypatch.setattr(cli, "app", partial(app, arguments))
        try:
            cli.main()
            code = 0
        except SystemExit as stopped:
            code = stopped.code
        return code, *capsys.readouterr()

    return run


def write_rig(projector):
    text = (
        '[trigger]\ndriver = "simulated"\n[timing]\nperiod_s = 0.1\n'
        '[camera]\ndriver = "simulated"\nexposure_s = 0.01\n[projector]\n'
    )
    with open("rig.toml", "w", encoding="utf-8") as file:
        file.write(text + projector)


def test_a_projector_is_switched(colorphase):
    with PJLinkProjector(PASSWORD) as device:
        device.warming_s = 0.2
        write_rig(f'control = "pjlink"\nport = "{device.url}"\npassword = "{PASSWORD}"\n')
        assert colorphase("projector", "on", "--rig", "rig.toml") == (0, "the projector is on\n", "")
        assert device.power == "1"
        assert colorphase("projector", "input", "31", "--rig", "rig.toml") == (0, "", "")
        assert device.input == "31"
        assert colorphase("projector", "blank", "--rig", "rig.toml") == (0, "", "")
        device.errors = "020000"
        code, said, complained = colorphase("projector", "status", "--rig", "rig.toml")
        assert (code, complained) == (0, "")
        assert "ACME X-1" in said
        rows = dict(" ".join(line.split()).strip("│ ").split(" │ ") for line in said.splitlines() if "│" in line)
        assert rows == {"power": "on", "input": "31", "blank": "yes", "faults": "lamp: error", "lamp hours": "1234"}
        assert colorphase("projector", "unblank", "--rig", "rig.toml") == (0, "", "")
        assert device.mute == "30"
        assert colorphase("projector", "off", "--rig", "rig.toml") == (0, "the projector is off\n", "")
        said = colorphase("projector", "status", "--rig", "rig.toml")[1]
        assert said.count("not told") == 2  # input and blank
        code, _, complained = colorphase("projector", "blank", "--rig", "rig.toml")
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
def test_mistakes_in_the_rig_file_are_one_line(colorphase, projector, message):
    write_rig(projector)
    code, said, complained = colorphase("projector", "status", "--rig", "rig.toml")
    assert (code, said) == (1, "")
    assert message in complained
    assert complained.count("\n") == 1


def test_a_picture_is_shown(colorphase):
    cv2.imwrite("grey.png", np.zeros((768, 1024), np.uint8))
    code, said, complained = colorphase("project", "grey.png", "--seconds", "0.1")
    assert (code, said, complained) == (0, "grey.png is on display 0, 1024x768; Esc, q or Ctrl-C ends it\n", "")
    assert colorphase("pattern", "pattern.png", "--brightness", "0.85")[0] == 0
    assert colorphase("project", "pattern.png", "--display", "0", "--seconds", "0.1")[0] == 0


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
def test_pictures_that_are_refused(colorphase, name, picture, message):
    if picture is not None:
        cv2.imwrite(name, picture)
    code, said, complained = colorphase("project", name, "--seconds", "0.1")
    assert (code, said) == (1, "")
    assert message in complained
    assert complained.count("\n") == 1


def test_devices_lists_displays(colorphase, monkeypatch):
    code, said, _ = colorphase("devices")
    assert code == 0
    assert "1024x768" in said
    monkeypatch.setenv("SDL_VIDEODRIVER", "none such")
    code, said, complained = colorphase("devices")
    assert (code, complained) == (0, "")
    assert "display" not in said
