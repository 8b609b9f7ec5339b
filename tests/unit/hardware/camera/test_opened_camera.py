"""What every opened camera says of itself, and that a library that hangs keeps nobody waiting."""

import threading
import time

from hardware.camera.opened_camera import OpenedCamera, Setup, let_go_within
from hardware.protocols import CameraLimits, FrameFormat, Identity


def test_it_says_what_was_found_and_set_up():
    class Own(OpenedCamera):
        _identity = Identity("maker", "model", "7")
        _setup = Setup(CameraLimits((64, 48), FrameFormat("rgb"), (1e-5, 1.0), 0.01, True), 2e-3, ("it moves",))

    camera = Own()
    assert str(camera.identity) == "maker model 7"
    assert camera.limits.size_px == (64, 48)
    assert (camera.exposure_s, camera.unlocked) == (2e-3, ("it moves",))


def test_letting_go_is_waited_for_but_not_for_ever():
    done, may_end = threading.Event(), threading.Event()
    let_go_within(5, done.set)
    assert done.is_set()
    begin = time.monotonic()
    let_go_within(0.05, lambda: may_end.wait(20))
    assert time.monotonic() - begin < 5
    may_end.set()
