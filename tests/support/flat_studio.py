"""A studio that is one line of mathematics: the camera sees each of the projector's pixels as one of its own."""

import numpy as np

from pipeline.acquisition.studio import FRAMES


class FlatStudio:
    """A projector of 64x48 px, and a camera that sees each of its pixels as one, as light = code ** 2.

    Every call may be overridden, or interrupted: `before_each` is called with the method's name.
    """

    projector_px = (64, 48)
    sensor = None

    def __init__(self, latency_s=0.05, seed=0):
        self.latency_s, self.rng = latency_s, np.random.default_rng(seed)
        self.time_s, self.frame_s = 0.0, 1 / 30
        self.sent = [(-1.0, np.zeros((48, 64, 3), np.uint8))]
        self.before_each = lambda name: None
        self.ambient, self.light, self.lines, self.pressed = 0.02, 0.8, [], False

    def now_s(self):
        """Return the time."""
        return self.time_s

    def sleep(self, seconds):
        """Let time pass."""
        self.before_each("sleep")
        self.time_s += seconds

    def show(self, picture):
        """Send a picture."""
        self.before_each("show")
        self.sent.append((self.time_s + self.latency_s, picture))

    def take(self):
        """Return frames."""
        self.before_each("take")
        frames = []
        for _ in range(FRAMES):
            picture = [shown for on_s, shown in self.sent if on_s <= self.time_s][-1]
            frames.append(self.frame(picture))
            self.time_s += self.frame_s
        return frames

    def frame(self, picture):
        """Return a frame."""
        light = self.ambient + self.light * (picture / 255) ** 2 @ np.array([[9, 1, 0], [1, 8, 1], [0, 1, 9]]) / 10
        return np.clip(np.rint(255 * light + self.rng.normal(size=light.shape)), 0, 255).astype(np.uint8)

    def guide(self, guidance):
        """Note the line."""
        self.lines.append(guidance.line)

    def key_pressed(self):
        """Return whether a key is said to be pressed."""
        return self.pressed

    def close(self):
        """Let go."""
        pass
