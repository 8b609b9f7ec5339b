"""A GigE Vision camera on the loopback device that renders each frame by a function, at the moment of its trigger."""

import ctypes
import fcntl
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hardware.camera.aravis_library import load_aravis

#: Returns the frame that is exposed now: (H, W, 3) or (H, W), uint8 or uint16, as the camera's size and pixel format.
Render = Callable[[], npt.NDArray[Any]]

_Fill = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32)
# How often the fake camera looks for triggers; its own 25 Hz would make each test wait.
_TRIGGERS_HZ = 500.0


class AravisTwin:
    """The fake camera of Aravis, in this process; what `render` raises is raised again when it is left.

    Parameters
    ----------
    serial : str
        Its serial number.
    render : callable
        Gives the frame of the trigger that has just come; called on another thread.
    """

    def __init__(self, serial: str, render: Render) -> None:
        load_aravis()
        self._library = ctypes.CDLL("libaravis-0.8.so.0")
        for name, result, arguments in (
            ("arv_gv_fake_camera_new", ctypes.c_void_p, (ctypes.c_char_p, ctypes.c_char_p)),
            ("arv_gv_fake_camera_get_fake_camera", ctypes.c_void_p, (ctypes.c_void_p,)),
            ("arv_fake_camera_set_trigger_frequency", None, (ctypes.c_void_p, ctypes.c_double)),
            ("arv_fake_camera_set_fill_pattern", None, (ctypes.c_void_p, _Fill, ctypes.c_void_p)),
            ("arv_buffer_get_image_width", ctypes.c_int, (ctypes.c_void_p,)),
            ("arv_buffer_get_image_height", ctypes.c_int, (ctypes.c_void_p,)),
            ("arv_buffer_get_image_pixel_format", ctypes.c_uint32, (ctypes.c_void_p,)),
            ("arv_buffer_get_data", ctypes.c_void_p, (ctypes.c_void_p, ctypes.c_void_p)),
            ("g_object_unref", None, (ctypes.c_void_p,)),
        ):
            function = getattr(self._library, name)
            function.restype, function.argtypes = result, arguments
        self._serial = serial
        self._render = render
        self._errors: list[Exception] = []
        self._fill = _Fill(self._filled)  # the camera does not keep it alive

    def __enter__(self) -> "AravisTwin":
        self._port = gige_port()
        self._port.__enter__()
        self._camera = self._library.arv_gv_fake_camera_new(b"127.0.0.1", self._serial.encode())
        fake = self._library.arv_gv_fake_camera_get_fake_camera(self._camera)
        self._library.arv_fake_camera_set_trigger_frequency(fake, _TRIGGERS_HZ)
        self._library.arv_fake_camera_set_fill_pattern(fake, self._fill, None)
        until_it_listens()
        return self

    def __exit__(self, *_: object) -> None:
        self._library.g_object_unref(self._camera)
        self._port.__exit__(None, None, None)
        if self._errors:
            raise self._errors[0]

    def _filled(self, buffer: int, _: object, exposure_us: int, gain: int, pixel_format: int) -> None:
        try:
            image = np.ascontiguousarray(self._render())
            width = self._library.arv_buffer_get_image_width(buffer)
            height = self._library.arv_buffer_get_image_height(buffer)
            expected = width * height * (pixel_format >> 16 & 0xFF) // 8
            if image.nbytes != expected:
                raise ValueError(f"the twin's frame has {image.nbytes} bytes, the camera's {expected}")
            ctypes.memmove(self._library.arv_buffer_get_data(buffer, None), image.ctypes.data, image.nbytes)
        except Exception as error:
            self._errors.append(error)


@contextmanager
def gige_port() -> Iterator[None]:
    """Wait for one's turn: all GigE Vision cameras of one address share one port."""
    with open(Path(tempfile.gettempdir()) / "colorphase-gige-vision.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def until_it_listens() -> None:
    """Return once a camera listens on the loopback device's port 3956."""
    deadline = time.monotonic() + 10
    while "0100007F:0F74" not in Path("/proc/net/udp").read_text():
        if time.monotonic() > deadline:
            raise TimeoutError("the fake camera does not listen")
        time.sleep(0.01)
