"""A capture without hardware: a simulated rig before somebody who turns to and fro.

The head is rendered once at each of its places. A frame shows one of them, with noise of its own; the exposure is the
same for all. The rig is that of `simulated_studio`, and is decoded by the calibration that it has found by itself.

Python notices Ctrl-C between two of its own steps, and a kernel that is compiled is one step of up to seconds. So what
the camera sees is rendered in a process of its own, where kernels hold up nobody.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import cv2
import numpy as np
import numpy.typing as npt

from hardware.alternating_pictures import DIM
from hardware.protocols import Camera, FrameFormat, Trigger
from hardware.settings import RigSettings
from hardware.simulated import SimulatedInstruments
from pipeline.acquisition.simulated_camera import WEBCAM, WEBCAM_NAME, SimulatedCamera
from pipeline.acquisition.simulated_studio import FRAME_S, LIGHT
from pipeline.calibration import Calibration
from pipeline.calibration.model import choose_pattern
from pipeline.errors import RenderError
from pipeline.models import CameraState, CodeName
from pipeline.processes import Child, ChildDied, serve
from pipeline.simulation import (
    TYPICAL_CROSSTALK,
    SimulatedFrame,
    SimulationSettings,
    own_calibration,
    simulate_frame,
    simulated_truth,
)
from tikernels import runtime

#: `colorphase capture --rig simulated`, as its file would specify it.
SETTINGS = RigSettings.model_validate(
    {
        "trigger": {"driver": "simulated", "strobe": True},
        "timing": {"period_s": 0.02, "frames": 25, "camera_delay_s": 0.001},
        "camera": {"driver": "simulated", "exposure_s": 1 / 120},
        "projector": {"colour_cycle_s": 1 / 120, "alternating": True},
    }
)
#: `[camera] serial` of a rig file by which the simulated camera sees a ball instead of a head.
BALL = "ball"
# The head turns by so much to either side: by up to 0.3 deg from one frame to the next.
_SWING_DEG = 2.0
# Places of the head that are rendered, one per frame: at 50 frames per second it turns to and fro in 0.8 s. More places
# would make a slower and longer swing, and the start of a capture as much longer.
_PLACES = 21
# The exposure of every frame: the brightest skin reaches 0.9 of full scale where the head is in the middle.
_EXPOSURE = 1.0
# Levels of a place's pictures: 257 per level of a frame.
_FINE = 65535 // 255
# Noise is read from a prepared field at a random place: of a thousand frames hardly two begin at the same one.
_NOISE_PLACES = 2**20


@dataclass(frozen=True)
class SceneTask:
    """A scene to be rendered."""

    arch: str
    n_places: int  # from one side to the other
    scene: Literal["portrait", "ball"]
    code: CodeName | None = "contrast"  # of the pattern


@dataclass(frozen=True)
class Scene:
    """The head at each of its places, under the bright and under the dim picture, (H, W, 3) uint16, without noise."""

    places: tuple[tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16]], ...]


class SceneCamera:
    """Frames of the simulated camera: the head where it is at the time, with noise of the frame's own.

    Parameters
    ----------
    scene : Scene
        The head at its places.
    period_s : float
        From frame to frame. The head is at a place for one period: frames of a burst show one place after another.
    webcam : bool
        True for a webcam, which exposes by its own clock: the next time after it is triggered.
    """

    def __init__(self, scene: Scene, period_s: float, *, webcam: bool) -> None:
        self._scene, self._period_s = scene, period_s
        self._rng = np.random.default_rng()
        self._webcam = SimulatedCamera(WEBCAM, LIGHT.noise, self._rng) if webcam else None
        n_levels = scene.places[0][0].size + _NOISE_PLACES
        noise = self._rng.standard_normal(n_levels, dtype=np.float32)
        self._noise = np.rint(LIGHT.noise * _FINE * noise).astype(np.int16)

    def expose(self, picture: int, time_s: float) -> npt.NDArray[np.uint8]:
        """Return a frame, (H, W, 3) RGB, under the bright picture (0) or the dim one (1)."""
        if self._webcam is not None:
            time_s = math.ceil(time_s / FRAME_S) * FRAME_S
        light = self._scene.places[place_at(time_s, self._period_s, len(self._scene.places))][picture]
        if self._webcam is not None:
            return self._webcam.develop(np.asarray(light / np.float32(65535), np.float32), time_s)
        start = self._rng.integers(_NOISE_PLACES)
        noise = self._noise[start : start + light.size].reshape(light.shape)
        return np.asarray(cv2.convertScaleAbs(cv2.add(light, noise, dtype=cv2.CV_16U), alpha=1 / _FINE), np.uint8)


def place_at(time_s: float, period_s: float, n_places: int) -> int:
    """Return the place that the head is at: to and fro by one per frame."""
    last = n_places - 1
    return last - abs(math.floor(time_s / period_s) % (2 * last) - last)


def turn_deg(place: int, n_places: int) -> float:
    """Return how far the head is turned at a place."""
    return -_SWING_DEG * math.cos(math.pi * place / (n_places - 1))


def simulate_place(
    place: int, n_places: int, scene: Literal["portrait", "ball"] = "portrait", code: CodeName | None = "contrast"
) -> SimulatedFrame:
    """Render the head, or a ball, at a place under the rig's pattern, without noise, in 16 bits."""
    settings = SimulationSettings(
        scene=scene,
        gamma=LIGHT.gamma,
        crosstalk_matrix=np.array(TYPICAL_CROSSTALK),
        exposure=_EXPOSURE,
        camera_blur_px=(LIGHT.blur_px,) * 3,
        noise_levels=0.0,
        bits=16,
        object_turn_deg=turn_deg(place, n_places),
    )
    return simulate_frame(simulated_truth(code), settings)


def render_elsewhere(task: SceneTask, step: Callable[[str], None]) -> Scene:
    """Render in a process that is started here, and ended if this is interrupted.

    Parameters
    ----------
    task : SceneTask
        The scene, and the device that renders it.
    step : callable
        Called with what is being done.

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
        raise RenderError(
            "the process that renders the simulated frames has died: the system's log may say why"
        ) from None
    return cast(Scene, message)


def render_what_comes() -> None:
    """Render one task, in a process of its own; report each step, and at last the scene."""
    serve(lambda receive, say: say(render_scene(receive(), say)))


def render_scene(task: SceneTask, step: Callable[[str], None]) -> Scene:
    """Render every place under both pictures; see `render_elsewhere`.

    Raises
    ------
    DeviceNotReady
        The machine lacks the arch.
    """
    step("starting the device")
    runtime.init(task.arch)
    places = []
    for place in range(task.n_places):
        step(f"simulating place {place + 1} of {task.n_places}")
        places.append(_under_both_pictures(simulate_place(place, task.n_places, task.scene, task.code)))
    return Scene(tuple(places))


def _under_both_pictures(frame: SimulatedFrame) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16]]:
    """Return a frame under the bright picture, and under the dim one, which leaves the room's light as it is."""
    bright = frame.image.astype(np.uint16)
    room = SimulationSettings().ambient * frame.reflectance * np.sum(TYPICAL_CROSSTALK, axis=1, dtype=np.float32)
    room_levels = _EXPOSURE * frame.white_level * cv2.GaussianBlur(room, (0, 0), LIGHT.blur_px)
    return bright, np.rint(DIM * bright + (1 - DIM) * room_levels).astype(np.uint16)


def simulated_instruments(
    wiring: RigSettings, arch: str, step: Callable[[str], None]
) -> tuple[Callable[[], tuple[Trigger, Camera]], Calibration]:
    """Return what opens the simulated rig, and the calibration that its frames are decoded by.

    That is the one that the file names, if it is there, or else the one that the rig has found by itself; it is never
    the true one.

    Parameters
    ----------
    wiring : RigSettings
        Its exposure, its calibration, whether its camera is a webcam, and which outputs are wired back.
    arch : str
        Device that renders the frames, in a process of its own.
    step : callable
        Called with what is being done.

    Raises
    ------
    CalibrationError
        The calibration that the file names cannot be read.
    DeviceNotReady
        The machine lacks the arch.
    RenderError
        The process has died.
    """
    webcam = wiring.camera.serial == WEBCAM_NAME
    if wiring.calibration is not None and Path(wiring.calibration).exists():
        calibration = Calibration.read(wiring.calibration)
    else:
        calibration = own_calibration()
        if webcam:
            calibration = calibration.replace(capture=CameraState(transfer="srgb"))
    is_ball = wiring.camera.serial == BALL
    code = choose_pattern(calibration, None, None).code
    task = SceneTask(arch, 2, "ball", code) if is_ball else SceneTask(arch, _PLACES, "portrait", code)
    scene = render_elsewhere(task, step)
    camera = SceneCamera(scene, wiring.timing.period_s, webcam=webcam)
    height, width = scene.places[0][0].shape[:2]

    def open_instruments() -> tuple[Trigger, Camera]:
        devices = SimulatedInstruments.wired(camera.expose, (width, height), FrameFormat("rgb"), wiring)
        return devices.trigger, devices.camera

    return open_instruments, calibration
