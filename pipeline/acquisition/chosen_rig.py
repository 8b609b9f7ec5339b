"""The rig that a capture is to use: its settings, its instruments' opener, and a check that it is ready."""

import tomllib
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from hardware.display import Display
from hardware.drivers import SIMULATED
from hardware.errors import ProjectorError, RigError
from hardware.instruments import open_instruments
from hardware.projector import open_projector
from hardware.protocols import Camera, Trigger
from hardware.settings import RigSettings
from pipeline.calibration import Calibration
from pipeline.calibration.model import choose_pattern
from pipeline.models import read_file
from pipeline.pattern import make_pattern

# Time in which a pattern is on the screen for certain; and that is given to the display between two bursts.
_SETTLE_S, _POLL_S = 1.0, 1e-3
# The exposure may differ from the calibration's by this fraction.
_SAME_EXPOSURE = 1e-3


@dataclass(frozen=True)
class ChosenRig:
    """A rig whose projector is not known to show nothing."""

    settings: RigSettings
    open_instruments: Callable[[], tuple[Trigger, Camera]]
    calibration: Calibration | None

    @contextmanager
    def showing_pattern(self) -> Iterator[Callable[[], None]]:
        """Show the calibrated pattern where the projector is a display of this computer.

        What is yielded is to be called now and then, and keeps the picture there.

        Raises
        ------
        ProjectorError
            The display cannot be used.
        RigError
            The projector is to alternate two pictures by itself.
        """
        if self.settings.projector.display is None or self.settings.camera.driver == SIMULATED:
            yield lambda: None
            return
        if self.settings.projector.alternating:
            raise RigError("projector.display shows one pattern, and projector.alternating needs two: leave one out")
        known = self.calibration or Calibration()
        with Display(self.settings.projector.display) as screen:
            codes = make_pattern(screen.size_px, choose_pattern(known, None, None), known.response)
            screen.show(np.rint(255 * codes).astype(np.uint8))
            screen.wait(_SETTLE_S)

            def keep() -> None:
                screen.wait(_POLL_S)

            yield keep

    def differences(self) -> list[str]:
        """Report where the camera's state differs from the calibration's, or that there is none yet."""
        if self.calibration is None and self.settings.calibration is not None:
            return [f"{self.settings.calibration} does not exist yet: colorphase calibrate capture makes it"]
        capture = None if self.calibration is None else self.calibration.capture
        before = None if capture is None else capture.exposure_s
        now = self.settings.camera.exposure_s
        if before is None or abs(now / before - 1) < _SAME_EXPOSURE:
            return []
        return [f"the exposure is {now:g} s, and was {before:g} s at calibration"]


def read_rig(path: str | Path) -> RigSettings:
    """Read what is wired to what.

    Parameters
    ----------
    path : str or Path
        The TOML file.

    Returns
    -------
    RigSettings
        Its contents; a calibration named relative to its folder is found from here.

    Raises
    ------
    RigError
        It cannot be read, or a key is missing, unknown or wrong; the message names it.

    Examples
    --------
    >>> timing = ["[timing]", "period_s = 0.02", "frames = 4", "camera_delay_s = 0.001"]
    >>> parts = ["[trigger]", 'driver = "simulated"', "[camera]", 'driver = "simulated"', "exposure_s = 0.008"]
    >>> with open("rig.toml", "w") as file:
    ...     for line in timing + parts:
    ...         print(line, file=file)
    >>> f"{1 / colorphase.read_rig('rig.toml').timing.period_s:.0f} frames/s"
    '50 frames/s'
    """
    settings = read_file(path, RigSettings, tomllib.loads, RigError)
    if settings.calibration is None:
        return settings
    return settings.replace(calibration=str(Path(path).parent / settings.calibration))


def choose_rig(rig: str, arch: str, notify: Callable[[str], None]) -> ChosenRig:
    """Return the rig of a file, or the simulated one.

    Parameters
    ----------
    rig : str
        Its TOML file, or "simulated".
    arch : str
        Device that renders a simulated rig's frames.
    notify : callable
        Called with what is being done.

    Raises
    ------
    RigError
        The file cannot be read, or is wrong.
    CalibrationError
        The calibration that it names cannot be read.
    ProjectorError
        The projector is off, or shows black.
    DeviceNotReady
        The machine lacks the arch.
    """
    from pipeline.acquisition.simulated_capture import SETTINGS, simulated_instruments

    settings = SETTINGS if rig == SIMULATED else read_rig(rig)
    if settings.trigger.driver == settings.camera.driver == SIMULATED:
        return ChosenRig(settings, *simulated_instruments(settings, arch, notify))
    there = settings.calibration is not None and Path(settings.calibration).exists()
    calibration = Calibration.read(settings.calibration) if there and settings.calibration else None
    if calibration is not None and calibration.response is not None and settings.projector.display is not None:
        # The response is undone in what this program shows.
        shown = choose_pattern(calibration, None, None).replace(compensated=True)
        calibration = calibration.replace(pattern=shown)
    check_projector(settings, rig)
    return ChosenRig(settings, partial(open_instruments, settings), calibration)


def check_projector(settings: RigSettings, rig: str) -> None:
    """Refuse a projector that is known to show nothing.

    Raises
    ------
    ProjectorError
        It is off, or shows black; or cannot be reached.
    """
    if settings.projector.control is None:
        return
    with closing(open_projector(settings.projector)) as projector:
        found = projector.status()
    if found.power not in ("on", None):
        raise ProjectorError(f"the projector is {found.power}: run `colorphase projector on --rig {rig}`")
    if found.blank:
        raise ProjectorError(f"the projector shows black: run `colorphase projector unblank --rig {rig}`")
