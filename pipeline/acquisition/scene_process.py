"""The process that renders what a simulated camera sees, before a bust that turns to and fro.

Python hears Ctrl-C between two of its own steps, and a kernel that is compiled is one step of up to seconds. In a
process of their own the kernels hold up nobody.
"""

import os
import pickle
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from hardware.alternating_pictures import DIM
from pipeline.batch.worker_process import Failure
from pipeline.calibration import Calibration
from pipeline.errors import RenderError
from pipeline.pattern import make_pattern
from pipeline.processes import block_interrupts
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

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
    with block_interrupts():  # a terminal's Ctrl-C goes to all its processes: this one decides when that one ends
        process = subprocess.Popen(
            [sys.executable, "-c", "from pipeline.acquisition.scene_process import serve; serve()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )
    with process:
        try:
            tasks, said = cast(Any, process.stdin), cast(Any, process.stdout)
            pickle.dump(task, tasks)
            tasks.flush()
            while isinstance(message := pickle.load(said), str):
                step(message)
        except BaseException as error:
            process.kill()
            if isinstance(error, EOFError | OSError | pickle.UnpicklingError):
                raise RenderError("the process that renders the simulated frames has died: is memory short?") from None
            raise
    if isinstance(message, Failure):
        raise message.error from RuntimeError(message.trace)
    return cast(Scene, message)


def serve() -> None:
    """Render one task that comes by the standard input; say each step, and at last the scene, or a `Failure`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    said = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever else is printed must not come between

    def say(message: Any) -> None:
        pickle.dump(message, said)
        said.flush()

    try:
        say(render_scene(pickle.load(sys.stdin.buffer), say))
    except BrokenPipeError:
        os._exit(1)  # what is left to flush would complain
    except Exception as error:
        say(Failure(error, traceback.format_exc()))


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
