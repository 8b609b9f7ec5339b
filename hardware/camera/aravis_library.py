"""Used parts of libaravis, with their types: the C library itself, so that it works in any virtual environment.

Aravis's usual Python bindings are PyGObject's: that has no wheels, so only the system's own Python finds it.
"""

import ctypes
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

from hardware.errors import CameraError

_NAME, _INSTALL = {
    "darwin": ("/opt/homebrew/lib/libaravis-0.8.dylib", "brew install aravis"),
    "win32": ("libaravis-0.8-0.dll", "on Windows it is not supported, take the maker's library"),
}.get(sys.platform, ("libaravis-0.8.so.0", "apt install libaravis-0.8-0, or your system's package of it"))

_Text = ctypes.c_char_p
_Object = ctypes.c_void_p
_Int = ctypes.c_int
_Int64 = ctypes.c_int64
_Double = ctypes.c_double
_Size = ctypes.c_size_t
#: Functions that may fail: the result, then the arguments without the last one, which receives the error.
_FALLIBLE: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_open_device": (_Object, (_Text,)),
    "arv_camera_new_with_device": (_Object, (_Object,)),
    "arv_camera_create_stream": (_Object, (_Object, _Object, _Object)),
    "arv_camera_get_payload": (ctypes.c_uint, (_Object,)),
    "arv_chunk_parser_get_integer_value": (_Int64, (_Object, _Object, _Text)),
    "arv_camera_start_acquisition": (None, (_Object,)),
    "arv_camera_stop_acquisition": (None, (_Object,)),
    "arv_device_read_memory": (_Int, (_Object, ctypes.c_uint64, ctypes.c_uint32, _Object)),
    "arv_device_execute_command": (None, (_Object, _Text)),
    "arv_device_is_feature_available": (_Int, (_Object, _Text)),
    "arv_device_get_string_feature_value": (_Text, (_Object, _Text)),
    "arv_device_set_string_feature_value": (None, (_Object, _Text, _Text)),
    "arv_device_get_boolean_feature_value": (_Int, (_Object, _Text)),
    "arv_device_set_boolean_feature_value": (None, (_Object, _Text, _Int)),
    "arv_device_get_integer_feature_value": (_Int64, (_Object, _Text)),
    "arv_device_set_integer_feature_value": (None, (_Object, _Text, _Int64)),
    "arv_device_get_integer_feature_bounds": (None, (_Object, _Text, _Object, _Object)),
    "arv_device_get_integer_feature_increment": (_Int64, (_Object, _Text)),
    "arv_device_get_float_feature_value": (_Double, (_Object, _Text)),
    "arv_device_set_float_feature_value": (None, (_Object, _Text, _Double)),
    "arv_device_get_float_feature_bounds": (None, (_Object, _Text, _Object, _Object)),
    "arv_device_dup_available_enumeration_feature_values_as_strings": (_Object, (_Object, _Text, _Object)),
    "arv_gv_device_get_timestamp_tick_frequency": (ctypes.c_uint64, (_Object,)),
}
_SURE: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (ctypes.c_uint, ()),
    "arv_get_device_id": (_Text, (ctypes.c_uint,)),
    "arv_get_device_vendor": (_Text, (ctypes.c_uint,)),
    "arv_get_device_model": (_Text, (ctypes.c_uint,)),
    "arv_get_device_serial_nbr": (_Text, (ctypes.c_uint,)),
    "arv_get_device_protocol": (_Text, (ctypes.c_uint,)),
    "arv_device_get_feature": (_Object, (_Object, _Text)),
    "arv_gv_device_is_controller": (_Int, (_Object,)),
    "arv_camera_create_chunk_parser": (_Object, (_Object,)),
    "arv_buffer_has_chunks": (_Int, (_Object,)),
    "arv_buffer_new_allocate": (_Object, (_Size,)),
    "arv_buffer_get_status": (_Int, (_Object,)),
    "arv_buffer_get_data": (_Object, (_Object, ctypes.POINTER(_Size))),
    "arv_buffer_get_frame_id": (ctypes.c_uint64, (_Object,)),
    "arv_buffer_set_frame_id": (None, (_Object, ctypes.c_uint64)),
    "arv_buffer_get_timestamp": (ctypes.c_uint64, (_Object,)),
    "arv_buffer_get_image_padding": (None, (_Object, _Object, _Object)),
    "arv_stream_push_buffer": (None, (_Object, _Object)),
    "arv_stream_timeout_pop_buffer": (_Object, (_Object, ctypes.c_uint64)),
    "arv_gv_device_get_type": (_Size, ()),
    "arv_gc_boolean_get_type": (_Size, ()),
    "arv_gc_enumeration_get_type": (_Size, ()),
    "arv_gc_float_get_type": (_Size, ()),
    "arv_gc_integer_get_type": (_Size, ()),
    # Of GObject and GLib, which come with it.
    "g_type_check_instance_is_a": (_Int, (_Object, _Size)),
    "g_object_unref": (None, (_Object,)),
    "g_free": (None, (_Object,)),
    "g_error_free": (None, (_Object,)),
}


class _Error(ctypes.Structure):
    """GError."""

    _fields_ = (("domain", ctypes.c_uint32), ("code", _Int), ("message", _Text))


class Aravis:
    """The library's functions by their names; those that fail raise CameraError with their message."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self._functions = {name: self._fallible(name, *types) for name, types in _FALLIBLE.items()}
        self._functions |= {name: self._typed(name, *types) for name, types in _SURE.items()}

    def __getattr__(self, name: str) -> Callable[..., Any]:
        try:
            return self._functions[name]
        except KeyError:
            raise AttributeError(name) from None

    def is_a(self, instance: int, kind: str) -> bool:
        """Return whether an object is of a class or has an interface, as "gc_float"."""
        return bool(self.g_type_check_instance_is_a(instance, getattr(self, f"arv_{kind}_get_type")()))

    def _typed(self, name: str, result: Any, arguments: tuple[Any, ...]) -> Callable[..., Any]:
        # A symbol of a library that it is linked to is found through it, too.
        function: Any = getattr(self._library, name)
        function.restype, function.argtypes = result, arguments
        typed: Callable[..., Any] = function
        return typed

    def _fallible(self, name: str, result: Any, arguments: tuple[Any, ...]) -> Callable[..., Any]:
        function = self._typed(name, result, (*arguments, _Object))

        def call(*values: Any) -> Any:
            error = ctypes.POINTER(_Error)()
            returned = function(*values, ctypes.byref(error))
            if error:
                message = error.contents.message.decode(errors="replace")
                self.g_error_free(error)
                raise CameraError(message)
            return returned

        return call


@cache
def load_aravis() -> Aravis:
    """Return the library.

    Raises
    ------
    CameraError
        It is not installed, or older than 0.8.23.
    """
    try:
        library = ctypes.CDLL(_NAME)
    except OSError as error:
        raise CameraError(f"GigE and USB3 Vision cameras need Aravis: {_INSTALL}") from error
    try:
        return Aravis(library)
    except AttributeError as error:
        raise CameraError(f"Aravis is too old, 0.8.23 or later is needed: {error}") from error
