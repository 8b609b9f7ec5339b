"""A capture without hardware: a simulated rig before a bust that turns to and fro.

Python hears Ctrl-C between two of its own steps, and a kernel that is compiled is one step of up to seconds. So what
the camera sees is rendered in a process of its own, where kernels hold up nobody.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from hardware.alternating_pictures import DIM
from hardware.protocols import Camera, FrameFormat, Trigger
from hardware.settings import RigSettings
from hardware.simulated import SimulatedInstruments
from pipeline.calibration import Calibration
from pipeline.errors import RenderError
from pipeline.pattern import make_pattern
from pipeline.processes import Child, ChildDied, serve
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
# The bust turns to one side and back in this time.
_SWING_S = 2.0
# Poses that are rendered, from one side to the other.
_POSES = 6
# The bust turns by this to either side.
_SWING_DEG = 5.0


@dataclass(frozen=True)
class SceneTask:
    """What is to be rendered."""

    arch: str
    size_px: tuple[int, int]
    n_poses: int  # from one side to the other


@dataclass(frozen=True)
class Scene:
    """What the camera sees: a pose a row, under the bright and under the dim picture; and the rig's calibration."""

    poses: tuple[tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]], ...]
    calibration: Calibration


def render_elsewhere(task: SceneTask, step: Callable[[str], None]) -> Scene:
    """Render in a process that is started here, and ended if this is interrupted.

    Parameters
    ----------
    task : SceneTask
        What to render, and where.
    step : callable
        Told what is being done.

    Raises
    ------
    DeviceNotReady
        The machine lacks the arch.
    RenderError
        The process has died.
    """
    step("starting the simulation")
    program = "from pipeline.acquisition.simulated_capture import render_what_comes; render_what_comes()"
    try:
        with Child(program) as process:
            process.send(task)
            while isinstance(message := process.receive(), str):
                step(message)
    except ChildDied:
        raise RenderError("the process that renders the simulated frames has died: is memory short?") from None
    return cast(Scene, message)


def render_what_comes() -> None:
    """Render one task, in a process of its own; say each step, and at last the scene."""
    serve(lambda receive, say: say(render_scene(receive(), say)))


def render_scene(task: SceneTask, step: Callable[[str], None]) -> Scene:
    """Render every pose under both pictures; see `render_elsewhere`.

    Raises
    ------
    DeviceNotReady
        The machine lacks the arch.
    """
    step("starting the device")
    runtime.init(task.arch)
    rig = simulated_rig(task.size_px, code="contrast")
    geometry = rig.geometry()
    codes = make_pattern(geometry.projector.size_px, geometry.pattern)
    settings = SimulationSettings(exposure=1.0)
    poses = []
    for pose in range(task.n_poses):
        step(f"simulating pose {pose + 1} of {task.n_poses}")
        turn_deg = _SWING_DEG * float(np.sin(np.pi * (pose / (task.n_poses - 1) - 0.5)))
        bright, dim = (
            simulate_frame(
                rig,
                settings.model_copy(update={"object_turn_deg": turn_deg, "seed": 2 * pose + picture}),
                codes * np.float32(light ** (1 / settings.gamma)),
            ).image.astype(np.uint8)
            for picture, light in enumerate((1.0, DIM))
        )
        poses.append((bright, dim))
    return Scene(tuple(poses), rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix}))


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
