"""A projector, a camera and somebody who holds things before them: what guided captures work with."""

import select
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from hardware.display import Display
from hardware.protocols import Camera, Trigger
from hardware.rig import Rig
from hardware.settings import RigSettings
from pipeline.acquisition.capture_folder import pixel_format
from pipeline.files import write_atomically
from pipeline.models import FloatArray, ImageArray, SensorPart
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.linearization import WHITE_LEVELS

#: Frames of every picture: two that differ show one that was not on the screen yet, or light that flickers.
FRAMES = 2
# Colours of the operator's picture, RGB: where the board should be, is, and was.
_SHOULD, _IS, _WAS = (255, 160, 0), (0, 220, 90), (120, 150, 255)
# The width of that picture, px, and the height of the band that its line is in.
_SHOWN_PX, _BAND_PX = 960, 48


@dataclass(frozen=True)
class Guidance:
    """Instructions for the operator who holds the board."""

    line: str
    frame: ImageArray | None = None  # (H, W, 3) RGB, as the camera sees it
    outline_px: FloatArray | None = None  # (4, 2) where the board should be in it
    corners_px: FloatArray | None = None  # (N, 2) where it is; None: it is not seen
    covered_px: FloatArray | None = None  # (N, 2) where corners of the poses before were


class Studio(Protocol):
    """A projector, a camera, and somebody who holds things before them. Times are in s by its own clock."""

    @property
    def projector_px(self) -> tuple[int, int]:
        """Width and height of the projector's pictures."""

    @property
    def exposures_s(self) -> tuple[float, float]:
        """Shortest and longest exposure at the present frame rate."""

    @property
    def is_mosaic(self) -> bool:
        """True where frames are developed from a Bayer mosaic."""

    @property
    def sensor(self) -> SensorPart | None:
        """The part of the camera's sensor that frames are; None: it is not known."""

    @property
    def taken_s(self) -> list[float]:
        """Times of the last frames' exposures, plus a constant, by the camera's clock if it has one."""

    def set_camera(self, exposure_s: float, gain_db: float) -> float:
        """Set exposure and gain, and return the exposure as read back; the camera starts afresh."""

    def now_s(self) -> float:
        """Return the time."""

    def sleep(self, seconds: float) -> None:
        """Let time pass."""

    def show(self, picture: npt.NDArray[np.uint8]) -> None:
        """Send a picture, (height, width, 3), to the projector; it is on the screen some time later."""

    def take(self) -> list[ImageArray]:
        """Return `FRAMES` frames, (H, W, 3) RGB, that were exposed from now on."""

    def guide(self, guidance: Guidance) -> None:
        """Show whoever holds the board what to do."""

    def key_pressed(self) -> bool:
        """Return whether a key was pressed since the last call: the board is where it should be."""

    def close(self) -> None:
        """Let go of everything; idempotent."""


class RigStudio:
    """A rig whose projector is a display.

    Parameters
    ----------
    settings : RigSettings
        The rig; where `projector.display` is None, the projector is the only display there is.
    open_instruments : callable
        Opens the trigger source and the camera of a rig's settings.
    picture : Path
        A PNG of what the operator should see, written anew whenever that changes.
    notify : callable
        Called with the line of every guidance.

    Raises
    ------
    ProjectorError, TriggerError, CameraError, RigError
        An instrument cannot be reached or used, or the camera sends a Bayer mosaic and does not report which.
    """

    def __init__(
        self,
        settings: RigSettings,
        open_instruments: Callable[[RigSettings], tuple[Trigger, Camera]],
        picture: Path,
        notify: Callable[[str], None],
    ) -> None:
        self._picture, self._notify = picture, notify
        timing = settings.timing.replace(frames=FRAMES)
        projector = settings.projector.replace(alternating=False)
        self._settings = settings.replace(timing=timing, projector=projector)
        self._open_instruments = open_instruments
        self._display = Display(settings.projector.display)
        try:
            self._projector_px = self._display.size_px
            self._open()
        except BaseException:
            self._display.close()
            raise

    def _open(self) -> None:
        settings = self._settings
        self._rig = Rig(settings, lambda: self._open_instruments(settings))
        try:
            self._format = pixel_format(self._rig.camera.limits.format)
        except BaseException:
            self._rig.close()
            raise
        self._bursts = self._rig.bursts()
        self._taken_s: list[float] = []

    @property
    def projector_px(self) -> tuple[int, int]:
        """Width and height of the projector's pictures."""
        return self._projector_px

    @property
    def exposures_s(self) -> tuple[float, float]:
        """Shortest and longest exposure; see `Studio`."""
        camera = self._rig.camera
        shortest_s, longest_s = camera.limits.exposure_s
        readout_s = camera.limits.min_period_s - camera.exposure_s
        return shortest_s, min(longest_s, self._settings.timing.period_s - readout_s)

    @property
    def is_mosaic(self) -> bool:
        """True where frames are developed from a mosaic; see `Studio`."""
        return self._rig.camera.limits.format.layout == "bayer"

    @property
    def sensor(self) -> SensorPart | None:
        """The part of the camera's sensor that frames are; see `Studio`."""
        return SensorPart.of(self._rig.camera.limits)

    @property
    def taken_s(self) -> list[float]:
        """Times of the last frames' exposures; see `Studio`."""
        return self._taken_s

    def set_camera(self, exposure_s: float, gain_db: float) -> float:
        """Set exposure and gain; see `Studio`.

        Drivers set a camera up when they open it, so it is opened again. Exposures off the colour cycle are allowed
        here, because the cycle is found by them.
        """
        camera = self._settings.camera.replace(exposure_s=exposure_s, gain_db=gain_db)
        projector = self._settings.projector.replace(colour_cycle_s=None)
        self._settings = self._settings.replace(camera=camera, projector=projector)
        self._rig.close()
        self._open()
        return self._rig.camera.exposure_s

    def now_s(self) -> float:
        """Return the time."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        if self._display.wait(seconds):
            raise KeyboardInterrupt("stopped: run the command again to go on")

    def show(self, picture: npt.NDArray[np.uint8]) -> None:
        """Send a picture to the projector; see `Studio`."""
        self._display.show(picture)

    def take(self) -> list[ImageArray]:
        """Return frames; see `Studio`."""
        paired = next(self._bursts).frames
        arrived = [each.frame for each in paired]
        self._taken_s = [each.host_time_s if each.device_time_s is None else each.device_time_s for each in arrived]
        return [np.array(runtime.to_host(develop((each.image,), self._format))) for each in paired]

    def guide(self, guidance: Guidance) -> None:
        """Write the operator's picture; see `Studio`."""
        self._notify(guidance.line)
        if guidance.frame is None:
            return
        drawn = draw_guidance(guidance)
        self._display.show_aside(drawn)
        write_atomically(self._picture, cv2.imencode(".png", drawn[..., ::-1])[1].tobytes())

    def key_pressed(self) -> bool:
        """Return whether Enter was pressed in the operator's window or in the terminal; see `Studio`."""
        return self._display.entered() or _enter_in_terminal()

    def close(self) -> None:
        """Let go of everything; idempotent."""
        self._rig.close()
        self._display.close()


def _enter_in_terminal() -> bool:
    """Return whether Enter was pressed in the terminal, if there is one."""
    if not sys.stdin.isatty():
        return False
    if sys.platform == "win32":
        import msvcrt

        return msvcrt.kbhit() and msvcrt.getch() in (b"\r", b"\n")
    pressed = bool(select.select([sys.stdin], [], [], 0)[0])
    if pressed:
        sys.stdin.readline()
    return pressed


def draw_guidance(guidance: Guidance) -> npt.NDArray[np.uint8]:
    """Return what the operator should see, (H, W, 3) RGB, given the camera's frame.

    The place that the board should be at is outlined, corners that are seen are dots, those of the poses before are
    small dots, and the line is below.
    """
    if guidance.frame is None:
        raise ValueError("there is no frame to draw on")
    height, width = guidance.frame.shape[:2]
    scale = _SHOWN_PX / width
    levels = guidance.frame.astype(np.float32) / WHITE_LEVELS[guidance.frame.dtype.name]
    size = (_SHOWN_PX, round(scale * height))
    shown = np.rint(255 * cv2.resize(levels, size, interpolation=cv2.INTER_AREA)).astype(np.uint8)
    for dots, color, radius in ((guidance.covered_px, _WAS, 2), (guidance.corners_px, _IS, 4)):
        for x, y in () if dots is None else np.rint(scale * dots).astype(int):
            cv2.circle(shown, (int(x), int(y)), radius, color, cv2.FILLED, cv2.LINE_AA)
    if guidance.outline_px is not None:
        outline = np.rint(scale * guidance.outline_px).astype(np.int32)
        cv2.polylines(shown, [outline], isClosed=True, color=_SHOULD, thickness=3, lineType=cv2.LINE_AA)
    band = np.zeros((_BAND_PX, _SHOWN_PX, 3), np.uint8)
    font = cv2.FONT_HERSHEY_SIMPLEX
    across = cv2.getTextSize(guidance.line, font, 1.0, 2)[0][0]
    size_of_text = min(0.8, (_SHOWN_PX - 24) / max(across, 1))
    cv2.putText(band, guidance.line, (12, 32), font, size_of_text, (255, 255, 255), 1, cv2.LINE_AA)
    return np.concatenate([shown, band])
