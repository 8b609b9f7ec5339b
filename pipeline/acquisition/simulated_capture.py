"""A capture without hardware: a simulated rig before a bust that turns to and fro."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from hardware.alternating_pictures import DIM
from hardware.protocols import Camera, FrameFormat, Trigger
from hardware.settings import RigSettings
from hardware.simulated import SimulatedInstruments
from pipeline.calibration import Calibration
from pipeline.pattern.fringes import make_pattern
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

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
# The bust turns by this to either side ...
_SWING_DEG = 5.0
# ... and back in this time.
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
        Where the frames are rendered.
    step : callable
        Told what is being done.

    Raises
    ------
    DeviceNotReady
        The machine lacks the arch.
    """
    runtime.init(arch)
    rig = simulated_rig(_SIZE_PX, code="contrast")
    geometry = rig.geometry()
    codes = make_pattern(geometry.projector.size_px, geometry.pattern)
    settings = SimulationSettings(exposure=1.0)
    frames: list[tuple[npt.NDArray[np.uint8], ...]] = []
    for pose in range(_POSES):
        step(f"simulating pose {pose + 1} of {_POSES}")
        turn_deg = _SWING_DEG * float(np.sin(np.pi * (pose / (_POSES - 1) - 0.5)))
        frames.append(())
        for picture, light in enumerate((1.0, DIM)):
            changed = settings.model_copy(update={"object_turn_deg": turn_deg, "seed": 2 * pose + picture})
            image = simulate_frame(rig, changed, codes * np.float32(light ** (1 / settings.gamma))).image
            frames[-1] += (image.astype(np.uint8),)

    def render(picture: int, time_s: float) -> npt.NDArray[np.uint8]:
        swing = abs((time_s / _SWING_S) % 1 - 0.5) * 2
        return frames[round(swing * (_POSES - 1))][picture]

    def open_instruments() -> tuple[Trigger, Camera]:
        devices = SimulatedInstruments.wired(render, _SIZE_PX, FrameFormat("rgb"), wiring)
        return devices.trigger, devices.camera

    calibration = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})
    return open_instruments, calibration
