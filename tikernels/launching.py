"""Launch kernels again without asking Taichi's Python front end what their arguments are.

At every call Taichi 1.7 makes a launch context, looks the kernel up by the types of its arguments, and checks each of
them: 80 us for ten arguments, as long as many a kernel takes. Of a kernel that has run before with arguments of the
same types only pointers, shapes and numbers change. So its context is kept, and only those are set.
"""

import contextlib
import functools
import gc
import threading
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar, cast, overload

import numpy as np
import numpy.typing as npt

from tikernels._taichi import DEVICE_TYPES, TESTED, ti
from tikernels.errors import DeviceNotReady
from tikernels.traffic import traffic

Function = TypeVar("Function", bound=Callable[..., Any])
Number = TypeVar("Number", bound=np.generic)

# How arguments are set: an array, a number, or a constant that the kernel was compiled with.
_ARRAY, _FLOAT, _INTEGER, _CONSTANT = range(4)

# What each kernel keeps, by the types of its arguments.
_kept: list[dict[Any, Any]] = []
# Arrays that were declared to be constant, by their identity, and their copies on a GPU.
_constants: dict[int, list[Any]] = {}
# A context is set and launched by one thread at a time.
_lock = threading.Lock()
# Why nothing can be launched any more.
_closed: str | None = None


@overload
def kernel(function: Function) -> Function: ...


@overload
def kernel(*, whole_vectors: bool = False, flow_analysis: bool = False) -> Callable[[Function], Function]: ...


def kernel(
    function: Function | None = None, *, whole_vectors: bool = False, flow_analysis: bool = False
) -> Function | Callable[[Function], Function]:
    """Compile a function as a kernel when it is called for the first time, and launch it quickly from then on.

    Parameters
    ----------
    function : callable
        In the kernel language.
    whole_vectors : bool
        True if the CPU loads and stores the vectors of arrays of such as a whole; see `lanes.py`.
    flow_analysis : bool
        True if Taichi follows stores to loads for the CPU, before LLVM does it again. That takes 45 % of compiling, and
        the kernel runs no faster; but without it LLVM cannot compile every kernel.
    """
    if function is None:
        return lambda later: _kernel(later, _Compiling(whole_vectors, flow_analysis))
    return _kernel(function, _Compiling(whole_vectors, flow_analysis))


def _kernel(function: Function, compiling: "_Compiling") -> Function:
    """Do what `kernel` says."""
    compiled: Any = ti.kernel(function)

    @functools.wraps(function)
    def plain(*arguments: Any) -> Any:
        check_open()
        if traffic.on_device:
            arguments = tuple(_on_device(argument) for argument in arguments)
        traffic.count_call(arguments)
        with compiling.configured():
            return compiled(*arguments)

    if not TESTED:  # Quadrants keeps its contexts itself
        return cast(Function, plain)
    primal = compiled._primal
    kinds = [_kind(argument.annotation) for argument in primal.arguments]
    if None in kinds or primal.return_type is not None:
        return cast(Function, plain)
    # Axes of an array that are those of its elements: none, or one of vectors.
    inner = [getattr(getattr(argument.annotation, "dtype", None), "ndim", 0) for argument in primal.arguments]
    kept: dict[Any, Any] = {}
    _kept.append(kept)
    implementation = ti.lang.impl

    @functools.wraps(function)
    def launch(*arguments: Any) -> Any:
        if len(arguments) != len(kinds):
            return plain(*arguments)
        types = []
        for kind, value in zip(kinds, arguments, strict=True):
            if kind == _ARRAY:
                # Buffers of a GPU, and what Taichi would copy or refuse, go the plain way.
                if type(value) is not np.ndarray or not value.flags.c_contiguous:
                    return plain(*arguments)
                types.append((value.dtype.num, value.ndim))
            elif kind == _CONSTANT:
                types.append(value)
        key = tuple(types)
        known = kept.get(key)
        if known is None or known[0] is not implementation.get_runtime().prog:
            plain(*arguments)  # compiles, and checks the arguments
            program = implementation.get_runtime().prog
            if program.config().arch in (ti.x64, ti.arm64):
                # A GPU's launch writes addresses of the device into the context, which is of no further use then.
                compiled_for = primal.compiled_kernels[primal.ensure_compiled(*arguments)]
                with compiling.configured():
                    code = program.compile_kernel(program.config(), program.get_device_caps(), compiled_for)
                kept[key] = (program, code, compiled_for.make_launch_context(), {})
            return None
        traffic.calls += 1
        program, code, context, last = known
        with _lock:
            place = 0
            for kind, value, axes in zip(kinds, arguments, inner, strict=True):
                if kind == _ARRAY:
                    now = (value.__array_interface__["data"][0], value.shape[: value.ndim - axes])
                    if last.get(place) != now:
                        context.set_arg_external_array_with_shape((place,), now[0], value.nbytes, now[1], 0)
                        last[place] = now
                elif kind == _FLOAT:
                    context.set_arg_float((place,), float(value))
                elif kind == _INTEGER:
                    context.set_arg_int((place,), int(value))
                else:
                    continue
                place += 1
            program.launch_kernel(code, context)
        return None

    return cast(Function, launch)


@dataclass(frozen=True)
class _Compiling:
    """Compilation options of a kernel; see `kernel`."""

    whole_vectors: bool
    flow_analysis: bool

    @contextlib.contextmanager
    def configured(self) -> Iterator[None]:
        """Configure the compiler so in the body, and collect no garbage: most of what is made there is kept."""
        config = ti.lang.impl.current_cfg()
        chosen = {"real_matrix_scalarize": not self.whole_vectors or traffic.on_device}
        if TESTED:
            chosen["cfg_optimization"] = self.flow_analysis or traffic.on_device
        before, collects = {name: getattr(config, name) for name in chosen}, gc.isenabled()
        gc.disable()
        for name, value in chosen.items():
            setattr(config, name, value)
        try:
            yield
        finally:
            if collects:
                gc.enable()
            for name, value in before.items():
                setattr(config, name, value)


def constant(array: npt.NDArray[Number]) -> npt.NDArray[Number]:
    """Declare that an array does not change any more: it is sent to a GPU once, however many kernels read it.

    Returns the array, which can no longer be written.
    """
    array.flags.writeable = False
    key = id(array)
    _constants[key] = [weakref.ref(array, lambda _: _constants.pop(key, None)), None]
    return array


def is_constant(array: object) -> bool:
    """Return whether an array was declared to be constant."""
    known = _constants.get(id(array))
    return known is not None and known[0]() is array


def _on_device(argument: Any) -> Any:
    """Return the buffer of an array that was declared to be constant, anything else as it is."""
    if not is_constant(argument):
        return argument
    known = _constants[id(argument)]
    if known[1] is None:
        buffer: Any = ti.ndarray(DEVICE_TYPES[argument.dtype.name], argument.shape)
        buffer.from_numpy(argument)
        traffic.sent_bytes += argument.nbytes
        known[1] = buffer
    return known[1]


def forget() -> None:
    """Let go of everything that belongs to the device; to be called before another one is started."""
    for known in list(_constants.values()):  # one may go while they are looked at
        known[1] = None
    for kept in _kept:
        kept.clear()


def close(why: str) -> None:
    """Refuse every launch from now on, and say why."""
    global _closed
    _closed = why
    for kept in _kept:
        kept.clear()


def check_open() -> None:
    """Check that kernels can be launched.

    Raises
    ------
    DeviceNotReady
        They no longer can.
    """
    if _closed is not None:
        raise DeviceNotReady(_closed)


def _kind(annotation: Any) -> int | None:
    """Return how an argument of a kernel is set; None: not here."""
    if isinstance(annotation, ti.template):
        return _CONSTANT
    if isinstance(annotation, ti.types.ndarray):
        return _ARRAY
    if id(annotation) in ti.types.primitive_types.real_type_ids:
        return _FLOAT
    return _INTEGER if annotation in (ti.i32, ti.u1) else None
