"""The projector, camera and operator that `calibrate capture` and `expose` work with."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from hardware.drivers import SIMULATED
from hardware.instruments import open_instruments
from hardware.settings import RigSettings
from pipeline.acquisition.chosen_rig import check_projector
from pipeline.acquisition.session import Stopping
from pipeline.acquisition.simulated_camera import WEBCAM, WEBCAM_NAME, CameraFaults
from pipeline.acquisition.simulated_studio import SimulatedStudio, StudioFaults
from pipeline.acquisition.studio import RigStudio, Studio
from pipeline.calibration.board import Board
from pipeline.cli.console import say, steps
from pipeline.diagnosis.artefacts import BallBar, Plate
from tikernels import runtime


@contextmanager
def opened_studio(
    settings: RigSettings, rig: str, held: Board | BallBar | Plate | None, picture: Path, *, any_exposure: bool = False
) -> Iterator[tuple[Studio, Callable[[str], None]]]:
    """Open a rig, or the simulated one; yield it, and the callable that shows the step being done.

    Parameters
    ----------
    settings : RigSettings
        The rig.
    rig : str
        Its file, for messages.
    held : Board, BallBar, Plate or None
        The object that the simulated operator holds; None: a white sheet.
    picture : Path
        The PNG that shows the operator of a real rig what to do.
    any_exposure : bool
        True if the exposure may be no whole number of the projector's cycles, which is refused else.

    Raises
    ------
    ProjectorError, TriggerError, CameraError, RigError
        An instrument cannot be reached or used.
    """
    with Stopping().listening(), steps() as show:
        show("opening the rig")
        if settings.trigger.driver == settings.camera.driver == SIMULATED:
            cycle_s, fields = settings.projector.colour_cycle_s, settings.projector.fields
            shown_s = None if fields is None else np.array([fields.red_s, fields.green_s, fields.blue_s])
            faults = StudioFaults(
                colour_cycle_s=cycle_s,
                shown=None if shown_s is None or cycle_s is None else shown_s / cycle_s,
                row_s=settings.camera.row_s,
                camera=WEBCAM if settings.camera.serial == WEBCAM_NAME else CameraFaults(),
            )
            studio: Studio = SimulatedStudio(held, settings.camera.exposure_s, notify=show, faults=faults)
        else:
            if any_exposure:
                projector = settings.projector.replace(colour_cycle_s=None)
                settings = settings.replace(projector=projector)
            check_projector(settings, rig)
            runtime.init("cpu")
            studio = RigStudio(settings, open_instruments, picture, show)
        try:
            yield studio, show
        finally:
            studio.close()
    if isinstance(studio, SimulatedStudio):
        say(f"simulated: {studio.n_acts} manual acts, {studio.now_s():.0f} s by the rig's clock")
