"""The rig of `colorphase capture --rig simulated`: its frames, and the process that renders what it sees."""

import subprocess
from functools import partial

import numpy as np
import pytest

from pipeline import Decoder
from pipeline.acquisition import simulated_capture
from pipeline.acquisition.simulated_capture import (
    SETTINGS,
    SceneTask,
    render_elsewhere,
    render_scene,
    simulated_instruments,
)
from pipeline.errors import RenderError
from tikernels.errors import DeviceNotReady

SMALL = SceneTask("cpu", (80, 60), 2)


@pytest.mark.usefixtures("cpu")
def test_a_bust_that_turns_before_a_pattern_that_takes_turns(monkeypatch):
    """The second picture has 0.85 of the light, and decodes to the same phase."""
    monkeypatch.setattr(simulated_capture, "_SIZE_PX", (320, 240))
    monkeypatch.setattr(simulated_capture, "_POSES", 2)
    told = []
    open_instruments, calibration = simulated_instruments(SETTINGS, "cpu", told.append)
    assert told[-2:] == ["simulating pose 1 of 2", "simulating pose 2 of 2"]
    trigger, camera = open_instruments()
    assert trigger.limits.counts_strobes and camera.limits.size_px == (320, 240)
    bright, dim, turned = (camera._expose(time_s) for time_s in (0.0, 0.0, 1.0))
    trigger.projector(0.0)
    dim = camera._expose(0.0)
    lit = bright.mean(axis=-1) > 60
    assert np.median(dim[lit] / bright[lit]) == pytest.approx(0.85, abs=0.02)
    assert np.abs(turned.astype(int) - bright)[lit].mean() > 5
    decoder = Decoder(calibration=calibration, arch="cpu")
    phases = [decoder.decode(image).wrapped_phase for image in (bright, dim)]
    assert np.nanmedian(np.abs(np.angle(np.exp(1j * (phases[0] - phases[1]))))) < 0.05


@pytest.fixture
def started(monkeypatch):
    """Return the processes that are started."""
    processes, popen = [], subprocess.Popen

    def start(*arguments, **options):
        processes.append(popen(*arguments, **options))
        return processes[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    return processes


@pytest.mark.usefixtures("cpu")
def test_it_renders_what_this_process_would():
    told = []
    elsewhere, here = render_elsewhere(SMALL, told.append), render_scene(SMALL, lambda step: None)
    assert told[0] == "starting the simulation" and told[-1] == "simulating pose 2 of 2"
    assert elsewhere.calibration.digest() == here.calibration.digest()
    for there, expected in zip(elsewhere.poses, here.poses, strict=True):
        assert np.array_equal(there, expected)


def test_an_error_in_it_is_the_same_here():
    with pytest.raises(DeviceNotReady, match="warp-drive"):
        render_elsewhere(SceneTask("warp-drive", (80, 60), 2), lambda step: None)


@pytest.mark.parametrize("death", ["by itself", "interrupted"])
def test_it_ends_whatever_happens(started, death):
    def stop(step):
        if step.startswith("starting the device"):
            if death == "interrupted":
                raise KeyboardInterrupt
            started[0].kill()

    with pytest.raises(KeyboardInterrupt if death == "interrupted" else RenderError):
        render_elsewhere(SMALL, stop)
    assert started[0].returncode is not None


def test_an_interrupt_before_it_is_told_anything_leaves_no_process(started):
    with pytest.raises(KeyboardInterrupt):
        render_elsewhere(SMALL, partial(_stop_at, "starting the simulation"))
    assert not started


def _stop_at(where, step):
    if step == where:
        raise KeyboardInterrupt
