"""A capture without hardware: a simulated rig before a bust that turns to and fro."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from hardware.protocols import Camera, FrameFormat, Trigger
from hardware.settings import RigSettings
from hardware.simulated import SimulatedInstruments
from pipeline.acquisition.scene_process import SceneTask, render_elsewhere
from pipeline.calibration import Calibration

#: `colorphase capture --rig simulated`, as its file would say it.
SETTINGS = RigSettings.model_validate(
    {
        "trigger": {"driver": "simulated", "strobe": True},
        "timing": {"period_s": 0.02, "frames": 25, "camera_delay_s": 0.001},
        "camera": {"driver": "simulated", "exposure_s": 1 / 120},
        "projector": {"colour_cycle_s": 1 / 120, "alternating": True},
    }
)
_SIZE_PX = (640, 480)
# The bust turns to one side and back in this time.
_SWING_S = 2.0
# Poses that are rendered, from one side to the other.
_POSES = 6


def simulated_instruments(
    wiring: RigSettings, arch: str, step: Callable[[str], None]
) -> tuple[Callable[[], tuple[Trigger, Camera]], Calibration]:
    """Return what opens the simulated rig, and its calibration.

    Parameters
    ----------
    wiring : RigSettings
        Its exposure, and which outputs are wired back.
    arch : str
        Where the frames are rendered, in a process of its own.
    step : callable
        Told what is being done.

    Raises
    ------
    DeviceNotReady
        The machine lacks the arch.
    RenderError
        The process has died.
    """
    scene = render_elsewhere(SceneTask(arch, _SIZE_PX, _POSES), step)

    def render(picture: int, time_s: float) -> npt.NDArray[np.uint8]:
        swing = abs((time_s / _SWING_S) % 1 - 0.5) * 2
        return scene.poses[round(swing * (len(scene.poses) - 1))][picture]

    def open_instruments() -> tuple[Trigger, Camera]:
        devices = SimulatedInstruments.wired(render, _SIZE_PX, FrameFormat("rgb"), wiring)
        return devices.trigger, devices.camera

    return open_instruments, scene.calibration
