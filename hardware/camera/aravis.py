"""GigE Vision and USB3 Vision cameras of any maker through Aravis, a free library."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from math import ceil
from time import monotonic

import numpy as np

from hardware.camera.aravis_library import load_aravis
from hardware.camera.genicam import (
    FrameNumbers,
    Value,
    buffers_for,
    choose,
    copy_image,
    sensor_temperature_c,
    set_up,
    wait_until_ready,
)
from hardware.camera.opened_camera import OpenedCamera, let_go_within
from hardware.camera.trigger_counter import TriggerCounter
from hardware.errors import CameraError, RigError
from hardware.protocols import CameraFrame, Identity
from hardware.settings import CameraSettings

_SUCCESS = 0
_FAULTS = {
    2: "packets are missing or late: look at the network's cable, packet size and load",
    3: "packets are missing: look at the network's cable, packet size and load",
    4: "its packets are out of order",
    5: "it is larger than a frame",
    7: "it was cut off",
}
# No frame has this number: a frame whose first packet is lost leaves the buffer's as it was.
_NO_FRAME_ID = 2**64 - 1
# Letting go takes milliseconds; of a network camera that is gone, 3 s for each register: that goes on by itself.
_CLOSE_S = 2.0


def list_aravis_cameras() -> list[Identity]:
    """Return the GigE Vision and USB3 Vision cameras that can be seen; takes a second.

    Raises
    ------
    CameraError
        Aravis is not installed.
    """
    return [identity for _, identity in _found()]


class AravisCamera(OpenedCamera):
    """A GigE Vision or USB3 Vision camera, opened and set up; the methods are those of `hardware.protocols.Camera`.

    Raises
    ------
    CameraError
        Aravis is not installed, the camera is not there, in use, or refuses.
    RigError
        The settings request what this camera cannot do.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self._aravis = load_aravis()
        self._by_software = settings.trigger == "software"
        # Without this look around, a network camera can be reached and sends no frames.
        found = _found()
        device_id, self._identity = found[choose(settings.serial, [(one.serial, one.model) for _, one in found])]
        self._camera = self._device = self._stream = self._chunks = 0
        try:
            with self._camera_errors("cannot be opened"):
                self._device = self._aravis.arv_open_device(device_id.encode())
                self._camera = self._aravis.arv_camera_new_with_device(self._device)
            is_gige = self._aravis.is_a(self._device, "gv_device")
            if is_gige and not self._aravis.arv_gv_device_is_controller(self._device):
                raise CameraError(f"camera {self._identity.serial} is in use: close the other program")
            with self._camera_errors("refuses"):
                self._features = _AravisFeatures(self._device)
                self._setup = set_up(self._features, settings)
                self._counter = TriggerCounter(self._features, settings.trigger)
                if self._counter.chunk is not None:
                    self._chunks = self._aravis.arv_camera_create_chunk_parser(self._camera)
                # Without a rate of its own, Aravis hands out this machine's time.
                self._has_clock = (
                    not is_gige or self._aravis.arv_gv_device_get_timestamp_tick_frequency(self._device) > 0
                )
        except BaseException:
            self.close()
            raise
        self._from_one = is_gige
        self._numbers = FrameNumbers()
        self._temperature_c: float | None = None

    def arm(self, count: int | None) -> None:
        """Get ready for `count` triggers (None: until disarmed), queues empty; return when it takes them."""
        self.disarm()
        if not self._camera:
            raise CameraError(f"camera {self._identity.serial} is closed")
        with self._camera_errors("cannot be armed"):
            self._temperature_c = sensor_temperature_c(self._features)
            self._numbers = FrameNumbers()
            self._counter.start()
            payload = self._aravis.arv_camera_get_payload(self._camera)
            self._stream = self._aravis.arv_camera_create_stream(self._camera, None, None)
            for _ in range(buffers_for(count, payload)):
                self._give(self._aravis.arv_buffer_new_allocate(payload))
            self._aravis.arv_camera_start_acquisition(self._camera)
            wait_until_ready(self._features, self.exposure_s)

    def frame(self, timeout_s: float) -> CameraFrame | None:
        """Return the next frame in the order of their arrival, whole or not; None: none came in time."""
        if not self._stream:
            raise CameraError(f"camera {self._identity.serial} is not armed")
        buffer = self._aravis.arv_stream_timeout_pop_buffer(self._stream, ceil(1e6 * timeout_s))
        host_time_s = monotonic()
        if buffer:
            try:
                return self._frame_of(buffer, host_time_s)
            finally:
                self._give(buffer)
        # Whoever waits in vain wants to know whether it is still there: the first register of any camera shows it.
        with self._camera_errors("is gone; look for its power and its cable"):
            self._aravis.arv_device_read_memory(self._device, 0, 4, ctypes.byref(ctypes.c_uint32()))
        return None

    def trigger(self) -> None:
        """Take one frame as soon as it can; only with trigger = "software" in the settings."""
        if not self._by_software:
            raise RigError('the camera waits for a line: set trigger = "software" to trigger it from here')
        if not self._stream:
            raise CameraError(f"camera {self._identity.serial} is not armed")
        with self._camera_errors("cannot be triggered"):
            wait_until_ready(self._features, self.exposure_s)
            self._features.execute("TriggerSoftware")

    def disarm(self) -> None:
        """Stop; harmless at any time."""
        if not self._stream:
            return
        stream, self._stream = self._stream, 0
        try:
            with self._camera_errors("cannot be stopped"):
                self._aravis.arv_camera_stop_acquisition(self._camera)
        finally:
            # With it go its thread and its buffers.
            self._aravis.g_object_unref(stream)

    def close(self) -> None:
        """Stop and let go of the camera; idempotent, and never raises."""
        if not self._device:
            return
        stream, chunks, camera, device = self._stream, self._chunks, self._camera, self._device
        self._stream = self._chunks = self._camera = self._device = 0

        def let_go() -> None:
            if stream:
                with suppress(CameraError):  # it is gone: there is nothing left to stop
                    self._aravis.arv_camera_stop_acquisition(camera)
            for instance in (stream, chunks, camera, device):
                if instance:
                    self._aravis.g_object_unref(instance)

        let_go_within(_CLOSE_S, let_go)

    def _give(self, buffer: int) -> None:
        self._aravis.arv_buffer_set_frame_id(buffer, _NO_FRAME_ID)
        self._aravis.arv_stream_push_buffer(self._stream, buffer)

    def _frame_of(self, buffer: int, host_time_s: float) -> CameraFrame:
        status = self._aravis.arv_buffer_get_status(buffer)
        frame_id = self._aravis.arv_buffer_get_frame_id(buffer)
        numbered = frame_id != _NO_FRAME_ID and (frame_id > 0 or not self._from_one)
        time_ns = self._aravis.arv_buffer_get_timestamp(buffer) if numbered and self._has_clock else 0
        image, fault = None, None
        if status == _SUCCESS:
            size = ctypes.c_size_t()
            data = self._aravis.arv_buffer_get_data(buffer, ctypes.byref(size))
            raw = np.frombuffer(memoryview((ctypes.c_uint8 * size.value).from_address(data)), np.uint8)
            padding = ctypes.c_int()
            self._aravis.arv_buffer_get_image_padding(buffer, ctypes.byref(padding), ctypes.byref(ctypes.c_int()))
            image = copy_image(raw, self._setup, padding.value)
            if image is None:
                fault = "it is smaller than a frame"
        else:
            fault = _FAULTS.get(status, "it was not received whole")
        return CameraFrame(
            image=image,
            host_time_s=host_time_s,
            frame_id=self._numbers.count_on(frame_id) if numbered else None,
            device_time_s=time_ns * 1e-9 if time_ns else None,
            temperature_c=self._temperature_c,
            triggers=self._triggers_of(buffer),
            fault=fault,
        )

    def _triggers_of(self, buffer: int) -> int | None:
        """Return how many triggers had come by a frame."""
        if self._counter.chunk is None or not self._aravis.arv_buffer_has_chunks(buffer):
            return None
        chunk = self._counter.chunk.encode()
        with suppress(CameraError):  # a frame that is not whole has none
            return int(self._aravis.arv_chunk_parser_get_integer_value(self._chunks, buffer, chunk))
        return None

    @contextmanager
    def _camera_errors(self, what: str) -> Iterator[None]:
        try:
            yield
        except CameraError as error:
            raise CameraError(f"camera {self._identity.serial} {what}: {error}") from error


class _AravisFeatures:
    """A device as `hardware.camera.genicam.Features`."""

    def __init__(self, device: int) -> None:
        self._aravis = load_aravis()
        self._device = device

    def has(self, name: str) -> bool:
        return bool(self._aravis.arv_device_is_feature_available(self._device, name.encode()))

    def get(self, name: str) -> Value:
        kind = self._kind(name)
        value = getattr(self._aravis, f"arv_device_get_{kind}_feature_value")(self._device, name.encode())
        if kind == "boolean":
            return bool(value)
        read: Value = value.decode() if kind == "string" else value
        return read

    def set(self, name: str, value: Value) -> None:
        kind = self._kind(name)
        if isinstance(value, str) != (kind == "string"):
            raise CameraError(f"{name} cannot be set to {value}: it is a {kind}")
        sent = value.encode() if isinstance(value, str) else float(value) if kind == "float" else int(value)
        getattr(self._aravis, f"arv_device_set_{kind}_feature_value")(self._device, name.encode(), sent)

    def execute(self, name: str) -> None:
        self._aravis.arv_device_execute_command(self._device, name.encode())

    def options(self, name: str) -> tuple[str, ...]:
        count = ctypes.c_uint()
        names = self._aravis.arv_device_dup_available_enumeration_feature_values_as_strings(
            self._device, name.encode(), ctypes.byref(count)
        )
        try:
            found = ctypes.cast(names, ctypes.POINTER(ctypes.c_char_p))
            return tuple((found[index] or b"").decode() for index in range(count.value))
        finally:
            self._aravis.g_free(names)

    def bounds(self, name: str) -> tuple[float, float]:
        kind, number = ("float", ctypes.c_double) if self._kind(name) == "float" else ("integer", ctypes.c_int64)
        least, most = number(), number()
        call = getattr(self._aravis, f"arv_device_get_{kind}_feature_bounds")
        call(self._device, name.encode(), ctypes.byref(least), ctypes.byref(most))
        return least.value, most.value

    def step(self, name: str) -> int:
        return int(self._aravis.arv_device_get_integer_feature_increment(self._device, name.encode()))

    def _kind(self, name: str) -> str:
        node = self._aravis.arv_device_get_feature(self._device, name.encode())
        if not node:
            raise CameraError(f"there is no {name}")
        # An enumeration is a string and an integer, too.
        for kind in ("enumeration", "boolean", "float", "integer"):
            if self._aravis.is_a(node, f"gc_{kind}"):
                return "string" if kind == "enumeration" else kind
        return "string"


def _found() -> list[tuple[str, Identity]]:
    """Return Aravis's names of the cameras, and what they are."""
    aravis = load_aravis()
    aravis.arv_update_device_list()
    found = []
    for index in range(aravis.arv_get_n_devices()):
        device_id, vendor, model, serial = (
            (get(index) or b"").decode(errors="replace")
            for get in (
                aravis.arv_get_device_id,
                aravis.arv_get_device_vendor,
                aravis.arv_get_device_model,
                aravis.arv_get_device_serial_nbr,
            )
        )
        found.append((device_id, Identity(vendor, model, serial)))
    return found
