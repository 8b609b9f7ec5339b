"""
A camera driver of your own
===========================

A DSLR on a USB cable, through the program gphoto2 (http://www.gphoto.org).

In rig.toml::

    [trigger]
    driver = "software"
    [timing]
    period_s = 5.0
    [camera]
    driver = "dslr_camera:Dslr"
    exposure_s = 0.0166667
    trigger = "software"

with this file's folder on PYTHONPATH. Set the camera to manual exposure and focus, fixed white balance, the finest JPEG
and the neutral picture style. ``python dslr_camera.py`` takes one picture.
"""

import subprocess
from queue import Empty, Queue
from threading import Thread
from time import monotonic

import cv2
import numpy as np

from hardware import CameraError, CameraFrame, CameraLimits, FrameFormat, Identity
from hardware.settings import CameraSettings

#: The sensitivity without amplification; cameras count it in steps of 6 dB.
BASE_ISO = 100
#: A picture is exposed, stored and sent within this time.
DEADLINE_S = 30.0


class Dslr:
    """A camera with the methods of `hardware.protocols.Camera`."""

    def __init__(self, settings: CameraSettings) -> None:
        if settings.trigger != "software":
            raise CameraError('a DSLR is triggered by its cable: set camera.trigger = "software"')
        self.identity = Identity("gphoto2", "DSLR", settings.serial or "")
        self.exposure_s = settings.exposure_s
        self.unlocked = ("a DSLR applies a tone curve and sharpening: choose its neutral picture style",)
        self._settings = (
            f"shutterspeed=1/{1 / settings.exposure_s:.0f}",
            f"iso={BASE_ISO * 2 ** (settings.gain_db / 6):.0f}",
        )
        self._burst = 0
        self._requests: Queue[int | None] = Queue()
        self._frames: Queue[tuple[int, CameraFrame | CameraError]] = Queue()
        began_s = monotonic()
        image = self._take()
        self.limits = CameraLimits(
            size_px=(image.shape[1], image.shape[0]),
            format=FrameFormat("rgb"),
            exposure_s=(1 / 8000, 30.0),
            min_period_s=1.5 * (monotonic() - began_s),
            triggered=False,
        )
        Thread(target=self._work, name="DSLR", daemon=True).start()

    def arm(self, count: int | None) -> None:
        """Get ready for `count` triggers."""
        self.disarm()

    def trigger(self) -> None:
        """Take one frame now."""
        self._requests.put(self._burst)

    def frame(self, timeout_s: float) -> CameraFrame | None:
        """Return the next frame; None: none came in time."""
        end_s = monotonic() + timeout_s
        while True:
            try:
                burst, frame = self._frames.get(timeout=max(0.0, end_s - monotonic()))
            except Empty:
                return None
            if burst == self._burst:
                break  # and not asked for before the last disarming
        if isinstance(frame, CameraError):
            raise frame
        return frame

    def disarm(self) -> None:
        """Forget what was asked for."""
        self._burst += 1

    def close(self) -> None:
        """Let go of the camera."""
        self.disarm()
        self._requests.put(None)

    def _work(self) -> None:
        while (burst := self._requests.get()) is not None:
            try:
                self._frames.put((burst, CameraFrame(self._take(), monotonic())))
            except CameraError as error:
                self._frames.put((burst, error))

    def _take(self) -> np.ndarray:
        settings = [word for setting in self._settings for word in ("--set-config", setting)]
        command = ["gphoto2", *settings, "--capture-image-and-download", "--stdout"]
        try:
            done = subprocess.run(command, capture_output=True, timeout=DEADLINE_S, check=True)
        except FileNotFoundError:
            raise CameraError("there is no gphoto2: install it") from None
        except subprocess.TimeoutExpired:
            raise CameraError(f"the camera sends nothing within {DEADLINE_S:.0f} s: look at its battery") from None
        except subprocess.CalledProcessError as failed:
            reason = (failed.stderr.decode(errors="replace").splitlines() or ["no reason given"])[-1]
            raise CameraError(
                f"gphoto2 fails ({reason}): close programs that use the camera, and switch it on"
            ) from None
        picture = cv2.imdecode(np.frombuffer(done.stdout, np.uint8), cv2.IMREAD_COLOR_RGB)
        if picture is None:
            raise CameraError("gphoto2 sends no JPEG: set the camera's image quality to JPEG, without raw")
        return np.asarray(picture)


def main() -> None:
    """Take a picture and print what came."""
    camera = Dslr(CameraSettings(driver="dslr_camera:Dslr", exposure_s=1 / 60, trigger="software"))
    camera.arm(1)
    camera.trigger()
    frame = camera.frame(DEADLINE_S)
    camera.close()
    if frame is None or frame.image is None:
        raise SystemExit("no picture came")
    print("{}x{} px, {:.0f} of 255 levels in the mean".format(*camera.limits.size_px, frame.image.mean()))


if __name__ == "__main__":
    main()
