"""Webcams, over a make-believe one that queues old frames and believes nothing that it is told."""

import threading
import time
from collections import deque

import cv2
import numpy as np
import pytest

from hardware.camera import CameraListing, list_cameras, open_camera
from hardware.camera.opencv import OpenCVCamera
from hardware.errors import CameraError, RigError
from hardware.protocols import FrameFormat
from hardware.settings import CameraSettings

SETTINGS = CameraSettings(driver="opencv", exposure_s=8e-3, trigger="software")
PERIOD_S = 4e-3


class Webcam:
    """It exposes all the time, hands a frame out two periods after its start, and keeps the oldest few."""

    def __init__(self, queue=4, says_queue=True, obeys=True, backend="V4L2", opens=True, dies_after=None):
        self.queue, self.says_queue, self.obeys, self.backend, self.opens = queue, says_queue, obeys, backend, opens
        self.dies_after = dies_after
        self.properties, self.script = {}, []
        self.began_s = time.monotonic()
        self.taken = 0
        self.waiting = deque()
        self.next = 0
        self.released = threading.Event()

    def isOpened(self):
        """Whether it is there."""
        return self.opens

    def getBackendName(self):
        """Return the system's interface."""
        return self.backend

    def set(self, code, value):
        """Say that it is done."""
        self.script.append((code, value))
        if self.obeys:
            self.properties[code] = value
        return True

    def get(self, code):
        """Return what was set, if it obeys."""
        if code == cv2.CAP_PROP_BUFFERSIZE:
            return float(self.queue) if self.says_queue else -1.0
        return self.properties.get(code, -1.0)

    def grab(self):
        """Take the oldest frame."""
        if self.dies_after is not None and self.taken >= self.dies_after:
            return False
        self.taken += 1
        while True:
            # A frame that was begun at k periods is there at k + 2; where the queue is full, the newest are lost.
            while self.began_s + (self.next + 2) * PERIOD_S <= time.monotonic():
                if len(self.waiting) < self.queue:
                    self.waiting.append(self.next)
                self.next += 1
            if self.waiting:
                self.number = self.waiting.popleft()
                return True
            time.sleep(PERIOD_S / 10)

    def read(self):
        """Return the oldest frame, its number in its colours."""
        if not self.grab():
            return False, None
        image = np.zeros((6, 8, 3), np.uint8)
        image[..., 0], image[..., 2] = self.number >> 8, self.number & 255  # blue, red
        return True, image

    def release(self):
        """Let go."""
        self.released.set()


@pytest.fixture
def plug_in(monkeypatch):
    """Make a webcam the one that OpenCV opens; what is opened is closed."""
    cameras = []

    def plug(settings=SETTINGS, **behaviour):
        webcam = Webcam(**behaviour)
        monkeypatch.setattr(cv2, "VideoCapture", lambda number: webcam)
        camera = open_camera(settings)
        cameras.append(camera)
        return webcam, camera

    yield plug
    for camera in cameras:
        camera.close()
        camera.close()


def exposed_s(webcam, image):
    return webcam.began_s + (int(image[0, 0, 2]) * 256 + int(image[0, 0, 0])) * PERIOD_S


@pytest.mark.parametrize("behaviour", [{"queue": 1}, {"queue": 4}, {"queue": 10}, {"queue": 9, "says_queue": False}])
def test_no_frame_is_older_than_its_trigger(plug_in, behaviour):
    webcam, camera = plug_in(**behaviour)
    camera.arm(3)
    for idle_s in (0.0, 0.1, 0.03):
        time.sleep(idle_s)  # frames grow old in the driver
        triggered_s = time.monotonic()
        camera.trigger()
        frame = camera.frame(2.0)
        assert exposed_s(webcam, frame.image) >= triggered_s
        assert frame.host_time_s > triggered_s
        assert (frame.frame_id, frame.device_time_s, frame.fault) == (None, None, None)
        assert frame.image.dtype == np.uint8 and frame.image.flags.owndata


def test_what_it_says_of_itself(plug_in):
    webcam, camera = plug_in()
    assert not camera.limits.triggered
    assert camera.limits.size_px == (8, 6)
    assert camera.limits.format == FrameFormat("rgb", 8)
    assert camera.limits.min_period_s > 6 * PERIOD_S
    assert str(camera.identity) == "OpenCV V4L2 0"
    assert camera.exposure_s == pytest.approx(8e-3)
    assert len(camera.unlocked) == 2  # it did all that it was told, and is not trusted all the same
    assert "driver may change exposure" in camera.unlocked[0]
    order = [code for code, _ in webcam.script]
    assert order.index(cv2.CAP_PROP_AUTO_EXPOSURE) < order.index(cv2.CAP_PROP_EXPOSURE)
    assert (cv2.CAP_PROP_AUTO_EXPOSURE, 1) in webcam.script  # Video4Linux's word for manual
    assert (cv2.CAP_PROP_EXPOSURE, pytest.approx(80)) in webcam.script  # in 100 us


def test_other_systems_count_exposure_in_powers_of_two(plug_in):
    webcam, camera = plug_in(backend="DSHOW")
    assert (cv2.CAP_PROP_AUTO_EXPOSURE, 0) in webcam.script
    assert (cv2.CAP_PROP_EXPOSURE, -7) in webcam.script
    assert camera.exposure_s == 2**-7


def test_what_it_does_not_obey_is_said(plug_in):
    _, camera = plug_in(obeys=False)
    for what in ("automatic exposure", "automatic white balance", "gain", "gamma", "exposure"):
        assert any(f"its {what} cannot be" in sentence for sentence in camera.unlocked), what
    assert camera.exposure_s == 8e-3


@pytest.mark.parametrize(
    "change, said",
    [
        ({"trigger": "Line1"}, 'cannot be triggered by Line1, it exposes when it likes: set trigger = "software"'),
        ({"strobe_line": "Line2"}, "no output lines"),
        ({"pixel_format": "BayerRG8"}, "no pixel_format BayerRG8"),
        ({"serial": "front"}, "a webcam goes by its number, as 0"),
        ({"serial": "9999999999"}, "a webcam goes by its number, as 0"),
        ({"size_px": (640, 480)}, r"this webcam gives \(8, 6\)"),
    ],
)
def test_what_no_webcam_can(plug_in, change, said):
    with pytest.raises(RigError, match=said):
        plug_in(SETTINGS.model_copy(update=change))


def test_not_there(capfd):
    with pytest.raises(CameraError, match="webcam 97 is not there, or in use"):
        OpenCVCamera(SETTINGS.model_copy(update={"serial": "97"}))
    assert capfd.readouterr() == ("", "")


def test_unplugged(plug_in):
    webcam, camera = plug_in(dies_after=40)
    camera.arm(None)
    with pytest.raises(CameraError, match="webcam 0 gives no frames: look at its cable"):
        for _ in range(40):
            camera.trigger()
            camera.frame(2.0)
    camera.close()
    assert webcam.released.wait(2.0)


def test_deadlines_and_arming(plug_in):
    _, camera = plug_in()
    with pytest.raises(CameraError, match="is not armed"):
        camera.trigger()
    camera.arm(1)
    began_s = time.monotonic()
    assert camera.frame(0.05) is None
    assert time.monotonic() - began_s < 1.0
    camera.trigger()
    camera.disarm()
    camera.disarm()
    camera.arm(1)
    assert camera.frame(0.2) is None  # the frame of the trigger before is gone
    camera.close()
    with pytest.raises(CameraError, match="is closed"):
        camera.arm(1)


def test_listing_takes_seconds_at_most(monkeypatch):
    """One that hangs, one whose library is missing, and one that works."""

    def missing():
        raise CameraError("install it")

    monkeypatch.setattr("hardware.camera._PATIENCE_S", 0.2)
    monkeypatch.setattr("hardware.camera.basler.list_basler_cameras", missing)
    monkeypatch.setattr("hardware.camera.aravis.list_aravis_cameras", lambda: time.sleep(1) or [])
    monkeypatch.setattr("hardware.camera.opencv.list_webcams", lambda: [])
    assert list_cameras() == [
        CameraListing("basler", note="install it"),
        CameraListing("aravis", note="no answer in 0.2 s"),
    ]


def test_simulated_cameras_are_made_elsewhere():
    with pytest.raises(RigError, match="use `colorphase capture --rig simulated`"):
        open_camera(CameraSettings(driver="simulated", exposure_s=1e-3))
