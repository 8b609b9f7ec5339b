"""A camera that sees a virtual screen, as a user's own driver: ``support.screen_camera:ScreenCamera``."""

import os
import time
from pathlib import Path

import numpy as np
from support.virtual_screen import Screen

from hardware.protocols import CameraFrame, CameraLimits, FrameFormat, Identity

#: Where the folder of the screen's pixels is told.
FOLDER = "SCREEN_CAMERA_FOLDER"


class ScreenCamera:
    """Sees every pixel of the screen as one of its own: light = code ** 2, mixed a little, with noise."""

    identity = Identity("colorphase", "screen camera")
    unlocked = ()

    def __init__(self, settings):
        self._screen = Screen("", Path(os.environ[FOLDER]) / "Xvfb_screen0")
        height, width, _ = self._screen.shot().shape
        self.exposure_s = settings.exposure_s
        self.limits = CameraLimits((width, height), FrameFormat("rgb"), (1e-5, 1.0), settings.exposure_s, False)
        self._rng = np.random.default_rng()
        self._asked = []

    def arm(self, count):
        """Get ready."""
        self._asked = []

    def trigger(self):
        """Take a frame."""
        self._asked.append(time.monotonic())

    def frame(self, timeout_s):
        """Return a frame."""
        deadline = time.monotonic() + timeout_s
        while not self._asked:
            if time.monotonic() > deadline:
                return None
            time.sleep(0.002)
        exposed_s = self._asked.pop(0) + self.exposure_s
        time.sleep(max(0.0, exposed_s - time.monotonic()))
        light = 0.02 + 0.8 * (self._screen.shot() / 255) ** 2 @ np.array([[9, 1, 0], [1, 8, 1], [0, 1, 9]]) / 10
        levels = np.clip(np.rint(255 * light + self._rng.normal(size=light.shape)), 0, 255)
        return CameraFrame(levels.astype(np.uint8), time.monotonic())

    def disarm(self):
        """Stop."""
        self._asked = []

    def close(self):
        """Let go."""
        self._asked = []
