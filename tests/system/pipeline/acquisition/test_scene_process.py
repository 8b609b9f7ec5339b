"""The process that renders a simulated rig's frames: its result, its errors, and its end."""

import subprocess
from functools import partial

import numpy as np
import pytest

from pipeline.acquisition.scene_process import SceneTask, render_elsewhere, render_scene
from pipeline.errors import RenderError
from tikernels.errors import DeviceNotReady

SMALL = SceneTask("cpu", (80, 60), 2)


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
