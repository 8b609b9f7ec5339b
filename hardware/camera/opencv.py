"""Webcams through OpenCV: for trying things out. They are triggered by software only, and not trusted.

A webcam has no trigger, no frame numbers and no clock, makes frames all the time, and its driver keeps some of them. So
a trigger here means: throw away as many frames as could have been begun before it, and keep the next one.

Frames are OpenCV's RGB, not the planes that the webcam sends (CAP_PROP_CONVERT_RGB = 0), which do not specify their
matrix: decoding takes YUYV's samples out of RGB again, to 0.003 mm of what the planes give (docs/cameras.md).
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import log2
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from time import monotonic
from typing import Any

import cv2
import numpy as np

from hardware.camera.opened_camera import OpenedCamera, Setup
from hardware.errors import CameraError, RigError
from hardware.protocols import CameraFrame, CameraLimits, FrameFormat, Identity
from hardware.settings import CameraSettings

# Frames that the driver keeps: OpenCV requests 4 of Video4Linux, and takes at most 10.
_USUAL_QUEUE, _LONGEST_QUEUE = 4, 10
# The frame that is being exposed when the trigger comes, and the one before it, still on its way.
_IN_FLIGHT = 2
# Drivers that stop sending block for ever, or for 10 s.
_PATIENCE_S = 5.0
_MEASURED_FRAMES = 10


@dataclass(frozen=True)
class _Request:
    """Frames to throw away, then one to keep."""

    stale: int
    burst: int


def list_webcams() -> list[Identity]:
    """Return the webcams that the system names, without switching them on.

    Raises
    ------
    CameraError
        This system does not name them; Linux does.
    """
    if not sys.platform.startswith("linux"):
        raise CameraError('webcams go by their numbers here: serial = "0" is the first')
    found = []
    for folder in sorted(Path("/sys/class/video4linux").glob("video*"), key=lambda path: (len(path.name), path.name)):
        with suppress(OSError):  # it is being unplugged
            # One camera has several devices, of which the first one gives frames.
            if (folder / "index").read_text().strip() == "0":
                found.append(Identity("", (folder / "name").read_text().strip(), folder.name.removeprefix("video")))
    return found


class OpenCVCamera(OpenedCamera):
    """A webcam, opened and as far as it allows set up; the methods are those of `hardware.protocols.Camera`.

    Raises
    ------
    CameraError
        It is not there, in use, or gives no frames.
    RigError
        The settings request what no webcam can do.
    """

    def __init__(self, settings: CameraSettings) -> None:
        if settings.trigger != "software":
            raise RigError(
                f"a webcam cannot be triggered by {settings.trigger}, it exposes when it likes: "
                'set trigger = "software", or take an industrial camera'
            )
        if settings.strobe_line is not None:
            raise RigError("a webcam has no output lines: leave strobe_line out")
        if settings.pixel_format not in (None, "RGB8"):
            raise RigError(f"a webcam has no pixel_format {settings.pixel_format}: leave it out, frames come as RGB8")
        number = settings.serial or "0"
        if not number.isdecimal() or int(number) >= 2**31:  # it takes no larger ones
            raise RigError(f"serial is {number}: a webcam goes by its number, as 0")
        with _quiet():
            self._webcam = cv2.VideoCapture(int(number))
        if not self._webcam.isOpened():
            raise CameraError(f"webcam {number} is not there, or in use: `colorphase devices` lists webcams")
        self._identity = Identity("OpenCV", self._webcam.getBackendName(), number)
        self._requests: Queue[_Request | None] = Queue()
        self._frames: Queue[tuple[_Request, CameraFrame | None]] = Queue()
        self._burst = 0
        self._armed = False
        self._closed = False
        # A grab cannot be given a deadline, so another thread waits for it.
        self._worker = Thread(target=self._work, name="webcam", daemon=True)
        self._worker.start()
        try:
            unlocked, exposure_s = _set_up(self._webcam, settings)
            self._stale = _queue_length(self._webcam) + _IN_FLIGHT
            size_px, period_s = self._measure()
        except BaseException:
            self.close()
            raise
        if settings.size_px is not None and settings.size_px != size_px:
            self.close()
            raise RigError(f"size_px is {settings.size_px}: this webcam gives {size_px}; take that, or leave it out")
        limits = CameraLimits(
            size_px=size_px,
            format=FrameFormat("rgb"),
            exposure_s=(0.0, period_s),
            min_period_s=(self._stale + 1) * period_s,
            triggered=False,
        )
        self._setup = Setup(limits, exposure_s, unlocked)

    def arm(self, count: int | None) -> None:
        """Get ready for `count` triggers (None: until disarmed), queues empty; return when it takes them."""
        if self._closed:
            raise CameraError(f"webcam {self._identity.serial} is closed")
        self.disarm()
        self._armed = True

    def frame(self, timeout_s: float) -> CameraFrame | None:
        """Return the next frame in the order of their triggers; None: none came in time."""
        deadline = monotonic() + timeout_s
        while True:
            try:
                request, frame = self._frames.get(timeout=max(0.0, deadline - monotonic()))
            except Empty:
                return None
            if request.burst != self._burst:
                continue  # it was requested before the last disarming
            if frame is None:
                raise CameraError(f"webcam {self._identity.serial} gives no frames: look at its cable")
            return frame

    def trigger(self) -> None:
        """Take one frame from now on."""
        if not self._armed:
            raise CameraError(f"webcam {self._identity.serial} is not armed")
        self._requests.put(_Request(self._stale, self._burst))

    def disarm(self) -> None:
        """Stop; harmless at any time."""
        self._armed = False
        self._burst += 1

    def close(self) -> None:
        """Stop and let go of the camera; idempotent, and never raises."""
        self.disarm()
        if not self._closed:
            self._closed = True
            self._requests.put(None)
            self._worker.join(_PATIENCE_S)

    def _work(self) -> None:
        while (request := self._requests.get()) is not None:
            if request.burst == self._burst:
                self._frames.put((request, self._take(request)))
        self._webcam.release()

    def _take(self, request: _Request) -> CameraFrame | None:
        for _ in range(request.stale):
            if not self._webcam.grab():
                return None
        taken, image = self._webcam.read()
        host_time_s = monotonic()
        if not taken:
            return None
        if image.ndim != 3 or image.dtype != np.uint8:
            return CameraFrame(None, host_time_s, fault="it is not a colour picture of 8 bits")
        return CameraFrame(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)), host_time_s)

    def _measure(self) -> tuple[tuple[int, int], float]:
        """Return the size of its frames and the time between them, from a few of them."""
        for stale in (self._stale, _MEASURED_FRAMES - 1):
            self._requests.put(_Request(stale, self._burst))
        first, last = self.frame(_PATIENCE_S), self.frame(_PATIENCE_S)
        if first is None or last is None:
            raise CameraError(f"webcam {self._identity.serial} gives no frames: look at its cable, and at its light")
        if last.image is None:
            raise CameraError(f"webcam {self._identity.serial} is of no use: {last.fault}")
        height, width, _ = last.image.shape
        return (width, height), (last.host_time_s - first.host_time_s) / _MEASURED_FRAMES


def _set_up(webcam: Any, settings: CameraSettings) -> tuple[tuple[str, ...], float]:
    """Switch off what can be; return what cannot be relied on, and the exposure."""
    unlocked = [
        "a webcam's driver may change exposure, gain, colours and sharpness whatever it says: use it for trials only",
        'its levels are probably not proportional to light: decode its frames with transfer = "srgb"',
    ]
    if settings.size_px is not None:
        webcam.set(cv2.CAP_PROP_FRAME_WIDTH, settings.size_px[0])
        webcam.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.size_px[1])
    webcam.set(cv2.CAP_PROP_CONVERT_RGB, 1)
    webcam.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    on_linux = webcam.getBackendName() == "V4L2"
    fixed = {
        # Video4Linux calls manual exposure 1; the others take 0 for "not automatic".
        "automatic exposure": (cv2.CAP_PROP_AUTO_EXPOSURE, 1 if on_linux else 0),
        "automatic white balance": (cv2.CAP_PROP_AUTO_WB, 0),
        "automatic focus": (cv2.CAP_PROP_AUTOFOCUS, 0),
        "gain": (cv2.CAP_PROP_GAIN, settings.gain_db),
        # In hundredths, of Video4Linux and DirectShow.
        "gamma": (cv2.CAP_PROP_GAMMA, 100),
        "sharpening": (cv2.CAP_PROP_SHARPNESS, 0),
    }
    for what, (code, value) in fixed.items():
        webcam.set(code, value)
        if webcam.get(code) != value:
            unlocked.append(f"its {what} cannot be fixed, or not be read back: look for it in the webcam's own program")
    # Video4Linux counts in 100 us; the others in powers of two of a second.
    webcam.set(cv2.CAP_PROP_EXPOSURE, settings.exposure_s / 1e-4 if on_linux else round(log2(settings.exposure_s)))
    found = webcam.get(cv2.CAP_PROP_EXPOSURE)
    exposure_s = found * 1e-4 if on_linux else 2.0**found
    if abs(exposure_s - settings.exposure_s) > 0.5 * settings.exposure_s or (on_linux and found <= 0):
        unlocked.append(f"its exposure cannot be read back, {settings.exposure_s:g} s is only what was asked for")
        exposure_s = settings.exposure_s
    return tuple(unlocked), exposure_s


def _queue_length(webcam: Any) -> int:
    """Return how many frames may lie in the driver: as many as it could, where it does not report it."""
    said = webcam.get(cv2.CAP_PROP_BUFFERSIZE)
    return _USUAL_QUEUE if 1 <= said <= _USUAL_QUEUE else _LONGEST_QUEUE


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep OpenCV from printing what the error reports, too."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
