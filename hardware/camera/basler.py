"""Basler cameras through pylon, Basler's own library: GigE, USB3 and its emulator."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from math import ceil
from time import monotonic
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np

from hardware.camera.genicam import (
    FrameNumbers,
    Value,
    buffers_for,
    choose,
    copy_image,
    frame_bytes,
    sensor_temperature_c,
    set_up,
    wait_until_ready,
)
from hardware.camera.opened_camera import OpenedCamera, let_go_within
from hardware.camera.trigger_counter import TriggerCounter
from hardware.errors import CameraError, RigError
from hardware.protocols import CameraFrame, Identity
from hardware.settings import CameraSettings

_NO_BLOCK_ID = 2**64 - 1
# Letting go of a camera that is gone was seen to hang (pypylon issue 235).
_CLOSE_S = 5.0


def list_basler_cameras() -> list[Identity]:
    """Return the Basler cameras that can be seen.

    Raises
    ------
    CameraError
        pypylon is not installed, or fails.
    """
    pylon, genicam = _libraries()
    with _camera_errors(genicam, "pylon finds no cameras"):
        return [_identity(info) for info in pylon.TlFactory.GetInstance().EnumerateDevices()]


class BaslerCamera(OpenedCamera):
    """A Basler camera, opened and set up; the methods are those of `hardware.protocols.Camera`.

    Raises
    ------
    CameraError
        pypylon is not installed, the camera is not there, in use, or refuses.
    RigError
        The settings request what this camera cannot do.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self._pylon, self._genicam = _libraries()
        self._by_software = settings.trigger == "software"
        factory = self._pylon.TlFactory.GetInstance()
        with _camera_errors(self._genicam, "pylon finds no cameras"):
            found = list(factory.EnumerateDevices())
        info = found[choose(settings.serial, [(_identity(one).serial, _identity(one).model) for one in found])]
        self._identity = _identity(info)
        # Network cameras count from 1, and 0 means that there is no number; USB counts from 0.
        self._from_one = info.GetDeviceClass() == "BaslerGigE"
        self._open = False
        with self._camera_errors("cannot be opened; close what else uses it"):
            self._camera = self._pylon.InstantCamera(factory.CreateDevice(info))
            self._camera.Open()
        self._open = True
        try:
            with self._camera_errors("refuses"):
                self._features = _PylonFeatures(self._genicam, self._camera.GetNodeMap())
                self._setup = set_up(self._features, settings)
                self._counter = TriggerCounter(self._features, settings.trigger)
                # Network cameras report how fast they count; USB ones count nanoseconds.
                rate = "GevTimestampTickFrequency"
                self._tick_s = 1 / float(self._features.get(rate)) if self._features.has(rate) else 1e-9
        except BaseException:
            self.close()
            raise
        self._numbers = FrameNumbers()
        self._temperature_c: float | None = None

    def arm(self, count: int | None) -> None:
        """Get ready for `count` triggers (None: until disarmed), queues empty; return when it takes them."""
        if not self._open:  # its features are gone, and reading them crashes
            raise CameraError(f"camera {self._identity.serial} is closed")
        self.disarm()
        with self._camera_errors("cannot be armed"):
            self._temperature_c = sensor_temperature_c(self._features)
            self._numbers = FrameNumbers()
            self._camera.MaxNumBuffer.Value = buffers_for(count, frame_bytes(self.limits))
            self._counter.start()
            # Never the latest only: that loses frames in silence (pypylon issue 332).
            self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)
            wait_until_ready(self._features, self.exposure_s)

    def frame(self, timeout_s: float) -> CameraFrame | None:
        """Return the next frame in the order of their arrival, whole or not; None: none came in time."""
        with self._camera_errors("gives no frames; look for its power and its cable"):
            if not self._open or not self._camera.IsGrabbing():
                raise CameraError(f"camera {self._identity.serial} is not armed")
            # Its own RetrieveResult was seen to wait for ever with a timeout of 0.2 s; this keeps it.
            if self._camera.GetGrabResultWaitObject().Wait(ceil(1000 * timeout_s)):
                with self._camera.RetrieveResult(0, self._pylon.TimeoutHandling_Return) as result:
                    host_time_s = monotonic()
                    if result.IsValid():
                        return self._frame_of(result, host_time_s)
            if self._camera.IsCameraDeviceRemoved():
                raise CameraError(f"camera {self._identity.serial} is gone: look for its power and its cable")
        return None

    def trigger(self) -> None:
        """Take one frame as soon as it can; only with trigger = "software" in the settings."""
        if not self._by_software:
            raise RigError('the camera waits for a line: set trigger = "software" to trigger it from here')
        with self._camera_errors("cannot be triggered"):
            if not self._open or not self._camera.IsGrabbing():
                raise CameraError(f"camera {self._identity.serial} is not armed")
            wait_until_ready(self._features, self.exposure_s)
            self._camera.GetNodeMap().GetNode("TriggerSoftware").Execute()

    def disarm(self) -> None:
        """Stop; harmless at any time."""
        if self._open:
            with self._camera_errors("cannot be stopped"):
                self._camera.StopGrabbing()

    def close(self) -> None:
        """Stop and let go of the camera; idempotent, and never raises."""
        if not self._open:
            return
        self._open = False

        def let_go() -> None:
            for step in (self._camera.StopGrabbing, self._camera.Close, self._camera.DestroyDevice):
                try:
                    step()
                except self._genicam.GenericException:
                    pass  # it is gone, or was never begun: there is nothing left to let go of

        let_go_within(_CLOSE_S, let_go)

    def _frame_of(self, result: Any, host_time_s: float) -> CameraFrame:
        block, ticks = result.BlockID, result.TimeStamp
        numbered = block != _NO_BLOCK_ID and (block > 0 or not self._from_one)
        image, fault = None, None
        if result.GrabSucceeded():
            raw = np.frombuffer(result.GetMemoryView(), np.uint8)
            image = copy_image(raw, self._setup, result.PaddingX)
            if image is None:
                fault = "it is smaller than a frame"
        else:
            fault = " ".join(result.ErrorDescription.split()) or "it was not received whole"
        return CameraFrame(
            image=image,
            host_time_s=host_time_s,
            frame_id=self._numbers.count_on(block) if numbered else None,
            device_time_s=ticks * self._tick_s if ticks else None,
            temperature_c=self._temperature_c,
            triggers=self._triggers_of(result),
            fault=fault,
        )

    def _triggers_of(self, result: Any) -> int | None:
        """Return how many triggers had come by a frame."""
        if self._counter.chunk is None or not result.IsChunkDataAvailable():
            return None
        node = result.GetChunkDataNodeMap().GetNode(self._counter.chunk)
        return int(node.Value) if self._genicam.IsReadable(node) else None

    def _camera_errors(self, what: str) -> AbstractContextManager[None]:
        return _camera_errors(self._genicam, f"camera {self._identity.serial} {what}")


class _PylonFeatures:
    """A node map as `hardware.camera.genicam.Features`."""

    def __init__(self, genicam: Any, node_map: Any) -> None:
        self._genicam = genicam
        self._map = node_map

    def has(self, name: str) -> bool:
        return bool(self._genicam.IsAvailable(self._map.GetNode(name)))

    def get(self, name: str) -> Value:
        with _camera_errors(self._genicam, f"{name} cannot be read"):
            value: Value = self._map.GetNode(name).Value
            return value

    def set(self, name: str, value: Value) -> None:
        with _camera_errors(self._genicam, f"{name} cannot be set to {value}"):
            node = self._map.GetNode(name)
            if isinstance(value, str) != isinstance(node.Value, str):
                raise CameraError(f"{name} cannot be set to {value}: it is {node.Value}")
            node.Value = type(node.Value)(value)

    def execute(self, name: str) -> None:
        with _camera_errors(self._genicam, f"{name} is refused"):
            self._map.GetNode(name).Execute()

    def options(self, name: str) -> tuple[str, ...]:
        with _camera_errors(self._genicam, f"{name} cannot be read"):
            return tuple(self._map.GetNode(name).Symbolics)

    def bounds(self, name: str) -> tuple[float, float]:
        with _camera_errors(self._genicam, f"{name} cannot be read"):
            node = self._map.GetNode(name)
            return node.Min, node.Max

    def step(self, name: str) -> int:
        with _camera_errors(self._genicam, f"{name} cannot be read"):
            return int(self._map.GetNode(name).Inc)


def _libraries() -> tuple[Any, Any]:
    try:
        # Its generated modules warn while they are imported, and crash the process where warnings are errors.
        with catch_warnings():
            simplefilter("ignore", DeprecationWarning)
            from pypylon import genicam, pylon
    except ImportError as error:
        raise CameraError("Basler cameras need pypylon: pip install 'colorphase[basler]'") from error
    return pylon, genicam


def _identity(info: Any) -> Identity:
    firmware = info.GetDeviceVersion() if info.IsDeviceVersionAvailable() else ""
    return Identity(info.GetVendorName(), info.GetModelName(), info.GetSerialNumber(), firmware)


@contextmanager
def _camera_errors(genicam: Any, what: str) -> Iterator[None]:
    """Report in one line what pylon reports in several, with its own file names and lines."""
    try:
        yield
    except genicam.GenericException as error:
        said = str(error).split(" : ")[0].split("(file")[0]
        raise CameraError(f"{what}: {' '.join(said.split()).rstrip('.')}") from error
