"""The rig that a capture is to use: what it says of itself, what opens its instruments, and whether it is ready."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial

from hardware.drivers import SIMULATED
from hardware.errors import ProjectorError
from hardware.instruments import open_instruments
from hardware.projector import open_projector
from hardware.protocols import Camera, Trigger
from hardware.settings import RigSettings
from pipeline.acquisition.rig_file import read_rig
from pipeline.calibration import Calibration

# The exposure may differ from the calibration's by this fraction.
_SAME_EXPOSURE = 1e-3


@dataclass(frozen=True)
class ChosenRig:
    """A rig whose projector is not known to show nothing."""

    settings: RigSettings
    open_instruments: Callable[[], tuple[Trigger, Camera]]
    calibration: Calibration | None

    def differences(self) -> list[str]:
        """Say where the camera stands otherwise than at calibration."""
        capture = None if self.calibration is None else self.calibration.capture
        before = None if capture is None else capture.exposure_s
        now = self.settings.camera.exposure_s
        if before is None or abs(now / before - 1) < _SAME_EXPOSURE:
            return []
        return [f"the exposure is {now:g} s, and was {before:g} s at calibration"]


def choose_rig(rig: str, arch: str, tell: Callable[[str], None]) -> ChosenRig:
    """Return the rig of a file, or the simulated one.

    Parameters
    ----------
    rig : str
        Its TOML file, or "simulated".
    arch : str
        Where a simulated rig's frames are rendered.
    tell : callable
        Told what is being done.

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
        return ChosenRig(settings, *simulated_instruments(settings, arch, tell))
    calibration = None if settings.calibration is None else Calibration.read(settings.calibration)
    _check_projector(settings, rig)
    return ChosenRig(settings, partial(open_instruments, settings), calibration)


def _check_projector(settings: RigSettings, rig: str) -> None:
    """Refuse a projector that is known to show nothing."""
    if settings.projector.control is None:
        return
    with closing(open_projector(settings.projector)) as projector:
        found = projector.status()
    if found.power not in ("on", None):
        raise ProjectorError(f"the projector is {found.power}: run `colorphase projector on --rig {rig}`")
    if found.blank:
        raise ProjectorError(f"the projector shows black: run `colorphase projector unblank --rig {rig}`")
