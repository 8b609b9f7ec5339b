"""Simulated rigs with faults in their cables, whose frames carry the truth: what exposed them, under which picture."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from hardware.errors import CameraError, TriggerError
from hardware.protocols import Camera, CameraFrame, FrameFormat, Trigger, TriggerStatus
from hardware.pulse_run import Run
from hardware.rig import Burst, Rejected, Rig
from hardware.settings import RigSettings
from hardware.simulated import SimulatedInstruments

PERIOD_S = 6e-3
FRAMES = 6
WIDTH, HEIGHT = 96, 64


@dataclass(frozen=True)
class Faulty:
    """What goes wrong in one run of pulses, at which of them."""

    lost_trigger: frozenset[int] = frozenset()  # the camera does not get it
    noise: frozenset[int] = frozenset()  # the camera gets another one before the next
    late_noise: frozenset[int] = frozenset()  # so late that it keeps the camera from the next
    lost_picture: frozenset[int] = frozenset()  # the projector does not get it
    extra_picture: frozenset[int] = frozenset()  # the projector gets two
    lost_strobe: frozenset[int] = frozenset()
    extra_strobe: frozenset[int] = frozenset()
    lost_frame: frozenset[int] = frozenset()  # on its way to the computer
    broken_frame: frozenset[int] = frozenset()
    repeated_frame: frozenset[int] = frozenset()  # delivered twice
    cloned_frame: frozenset[int] = frozenset()  # delivered in place of the next
    late_frame: frozenset[int] = frozenset()  # by 30 ms, and all behind it
    restart: int | None = None  # of the trigger source, at this pulse
    unplugged_trigger: int | None = None
    unplugged_camera: int | None = None

    @property
    def harmless(self) -> bool:
        """Whether every frame can still be had."""
        return replace(self, late_frame=frozenset(), repeated_frame=frozenset()) == Faulty()


def settings(
    *, strobe: bool = True, vsync: str | None = None, alternating: bool = True, frames: int = FRAMES, **timing: Any
) -> RigSettings:
    return RigSettings.model_validate(
        {
            "trigger": {"driver": "simulated", "strobe": strobe, "vsync": vsync},
            "timing": {"period_s": PERIOD_S, "frames": frames, "camera_delay_s": 2e-4, **timing},
            "camera": {"driver": "simulated", "exposure_s": 5e-4},
            "projector": {"alternating": alternating},
        }
    )


class Bench:
    """A simulated rig; each run of pulses takes the next fault of the plan, and none when it is empty."""

    def __init__(self, rig_settings: RigSettings, plan: list[Faulty] | None = None, *, clocks: bool = True) -> None:
        self.settings = rig_settings
        self.plan = plan if plan is not None else []
        self.rejected: list[Rejected] = []
        self.calls: list[str] = []
        self.n_opened = 0
        self._clocks = clocks  # whether the camera has one, and numbers
        self._random = np.random.default_rng(0)
        self._run = -1
        self._pulse = -1  # that the trigger source makes now
        self._causes: int | None = None  # the pulse that exposes now; None: noise
        self._pictures = 0  # that reached the projector in this period
        self.truth: list[tuple[int, int | None, bool]] = []  # of every exposure: run, pulse, whether the picture is new
        self._fault = Faulty()
        self._fired: list[Faulty] = []  # since the rig began this start
        self._boot = 1
        self._held: CameraFrame | None = None

    def open(self) -> tuple[Trigger, Camera]:
        """Connect new devices, all cables whole."""
        self.n_opened += 1
        self._fault = Faulty()
        devices = SimulatedInstruments.wired(self._render, (WIDTH, HEIGHT), FrameFormat("rgb"), self.settings)
        self.devices = devices
        trigger, camera = devices.trigger, devices.camera
        trigger.projector, trigger.camera = self._projector_wire, self._camera_wire
        self._strobe_wire, camera.strobe = camera.strobe, self._strobe
        self._deliver, camera.deliver = camera.deliver, self._transport
        for device, names in (
            (trigger, ("configure", "arm", "fire", "status", "strobes", "abort", "close")),
            (camera, ("arm", "frame", "disarm", "close")),
        ):
            for name in names:
                setattr(device, name, self._logged(device, name))
        return trigger, camera

    def rig(self) -> Rig:
        """Return the rig under test."""
        return self.repeating(Rig)(self.settings, self.open, self.rejected.append)

    def repeating(self, kind: type[Rig]) -> type[Rig]:
        """Return a rig that has the same faults again where a start is in doubt, on a busy machine, and is repeated."""
        bench = self

        class Repeating(kind):
            def _fire(self, **endless: bool) -> Run:
                bench._fired.clear()
                return super()._fire(**endless)

            def _check_start(self, *seen: Any, **ended: bool) -> None:
                try:
                    super()._check_start(*seen, **ended)
                except Exception:
                    bench.plan[:0] = bench._fired
                    raise

        return Repeating

    def mispaired(self, burst: Burst) -> list[int]:
        """Return the pulses whose frame they did not expose, or that shows the picture before."""
        seen = [self.truth[number_in(paired.frame.image)] for paired in burst.frames]
        return [
            paired.pulse
            for paired, truth in zip(burst.frames, seen, strict=True)
            if truth[:2] != (self._run, paired.pulse) or not (truth[2] or not self.settings.projector.alternating)
        ]

    def _logged(self, device: Any, name: str) -> Any:
        method = getattr(device, name)
        is_trigger = device is self.devices.trigger

        def call(*arguments: Any) -> Any:
            self.calls.append(f"{'trigger' if is_trigger else 'camera'}.{name}")
            if name == "fire":
                self._fault = self.plan.pop(0) if self.plan else Faulty()
                self._fired.append(self._fault)
                self._run += 1
                self._pulse = -1
                self._held = None
            if name not in ("close", "disarm"):
                lost = self._fault.unplugged_trigger if is_trigger else self._fault.unplugged_camera
                if lost is not None and self._pulse >= lost:
                    raise (TriggerError if is_trigger else CameraError)("the cable is out")
            result = method(*arguments)
            if name == "status":
                assert isinstance(result, TriggerStatus)
                result = replace(result, boot=self._boot)
            return result

        return call

    def _projector_wire(self, time_s: float) -> None:
        self._pulse += 1
        self._pictures = 0
        if self._pulse == self._fault.restart:
            self._boot += 1
            self.devices.trigger._stopped.set()
            return
        for _ in range((self._pulse not in self._fault.lost_picture) + (self._pulse in self._fault.extra_picture)):
            self._pictures += 1
            self.devices.projector.pulse(time_s)

    def _camera_wire(self, time_s: float) -> None:
        self._causes = self._pulse
        if self._pulse not in self._fault.lost_trigger:
            self.devices.camera.pulse(time_s)
        for when, late in ((self._fault.noise, 0.5), (self._fault.late_noise, 0.8)):
            if self._pulse in when:
                self._causes = None
                self.devices.camera.pulse(time_s + late * PERIOD_S)

    def _strobe(self, time_s: float) -> None:
        if self._pulse not in self._fault.lost_strobe:
            self._strobe_wire(time_s)
        if self._pulse in self._fault.extra_strobe:
            self._strobe_wire(time_s)

    def _render(self, picture: int, time_s: float) -> npt.NDArray[np.uint8]:
        image = self._random.integers(90, 110, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        if picture:
            image -= 15
        image[0, 0] = np.frombuffer(len(self.truth).to_bytes(3, "little"), np.uint8)
        self.truth.append((self._run, self._causes, self._pictures % 2 == 1))
        return image

    def _transport(self, frame: CameraFrame) -> None:
        fault = self._fault
        if not self._clocks:
            frame = replace(frame, frame_id=None, device_time_s=None)
        if self._held is not None:
            assert frame.image is not None
            frame, self._held = replace(frame, image=self._held.image), None
        if self._pulse in fault.broken_frame:
            frame = replace(frame, image=None, fault="missing packets")
        if self._pulse in fault.cloned_frame:
            self._held = frame
        if self._pulse in fault.late_frame:
            frame = replace(frame, host_time_s=frame.host_time_s + 0.03)
        for _ in range((self._pulse not in fault.lost_frame) + (self._pulse in fault.repeated_frame)):
            self._deliver(frame)


def number_in(image: npt.NDArray[Any] | None) -> int:
    assert image is not None
    return int.from_bytes(image[0, 0].tobytes(), "little")
