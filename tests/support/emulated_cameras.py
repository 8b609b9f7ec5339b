"""Emulated cameras: Basler's, and Aravis's fake one, a real GigE Vision camera."""

import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib.util import find_spec

import pytest
from support.aravis_twin import AravisTwin, Render, gige_port, until_it_listens
from support.missing import skip_but_fail_in_ci

from hardware.camera.aravis_library import load_aravis
from hardware.errors import CameraError


@pytest.fixture
def emulator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two emulated Basler cameras, 0815-0000 and 0815-0001."""
    if find_spec("pypylon") is None:
        skip_but_fail_in_ci("pypylon is not installed")
    monkeypatch.setenv("PYLON_CAMEMU", "2")  # read whenever cameras are looked for


@pytest.fixture
def aravis() -> None:
    """Aravis."""
    try:
        load_aravis()
    except CameraError:
        skip_but_fail_in_ci("Aravis is not installed")


@pytest.fixture
def start_fake_camera(aravis: None) -> Iterator[Callable[..., "subprocess.Popen[bytes]"]]:
    """Start Aravis's fake camera with a serial number; it is killed whatever happens."""
    program = shutil.which("arv-fake-gv-camera-0.8")
    if program is None:
        skip_but_fail_in_ci("arv-fake-gv-camera-0.8 is not installed")
    with ExitStack() as stack:

        def start(serial: str, lost_permille: int = 0) -> "subprocess.Popen[bytes]":
            stack.enter_context(gige_port())
            command = [str(program), "-i", "127.0.0.1", "-s", serial, "-r", str(lost_permille)]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            stack.callback(process.wait)
            stack.callback(process.kill)
            until_it_listens()
            return process

        yield start


@pytest.fixture
def start_twin(aravis: None) -> Iterator[Callable[[str, Render], AravisTwin]]:
    """Start a fake camera in this process that renders its frames by a function."""
    with ExitStack() as stack:
        yield lambda serial, render: stack.enter_context(AravisTwin(serial, render))
