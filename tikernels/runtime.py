"""The only place that starts the device, and where its buffers come from."""

import atexit
import contextlib
import ctypes
import functools
import logging
import math
import os
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt

from tikernels._taichi import DEVICE_TYPES, NOWHERE, keeps_kernels, language, ti
from tikernels.arrays import Array, DeviceArray, E
from tikernels.compiled_kernels import list_locked
from tikernels.errors import DeviceNotReady, SlowStart
from tikernels.lanes import VECTOR_BYTES
from tikernels.launching import check_open, close, forget
from tikernels.traffic import traffic

_log = logging.getLogger("colorphase.runtime")

#: Every arch by name, in the order in which "auto" prefers them.
ARCHS = ("cuda", "metal", "vulkan", "cpu")

#: Taichi's and Quadrants' environment variables for the number of threads that share a kernel on the CPU.
THREAD_VARIABLES = ("TI_CPU_MAX_NUM_THREADS", "QD_CPU_MAX_NUM_THREADS")

#: Held while a frame is decoded, and while its results are read: kernels are to be launched by one thread at a time.
lock = threading.RLock()

_NOT_KEPT = (
    "compiled kernels are not kept, so that each start takes long: set XDG_CACHE_HOME to a folder that can be written"
)
_FORKED = (
    "this process was forked from one in which a device had been started, whose threads it lacks: start processes by "
    'spawn, as multiprocessing.get_context("spawn") does, or before the first frame'
)
# Of the environment variables that the language reads.
_PREFIX = "TI" if language == "taichi" else "QD"
# Twice the cores of the largest machines.
_MOST_THREADS = 1024

_started: str | None = None
_failed: str | None = None  # the arch that was named and could not be started
_cuda: "_CudaContext | None" = None


class _CudaContext:
    """The CUDA context of the thread that starts the device. Taichi allocates in that of the calling thread."""

    def __init__(self) -> None:
        self._driver = ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
        self._context = ctypes.c_void_p()
        self._driver.cuCtxGetCurrent(ctypes.byref(self._context))
        self._threads = threading.local()

    def enter(self) -> None:
        """Make it the calling thread's."""
        if not hasattr(self._threads, "inside"):
            self._driver.cuCtxSetCurrent(self._context)
            self._threads.inside = True


@dataclass(frozen=True)
class VulkanDevice:
    """A device that the Vulkan loader offers; `software` ones check correctness, never speed."""

    name: str
    software: bool


def init(arch: str = "auto", *, cpu_threads: int | None = None) -> str:
    """Start the device that every kernel runs on.

    Parameters
    ----------
    arch : {"auto", "cpu", "vulkan", "cuda", "metal"}
        "auto" takes the first of CUDA, Metal, Vulkan on real hardware, and the CPU. A named one never falls back.
    cpu_threads : int, optional
        Number of threads that share a kernel on the CPU; left out, one for each core. The environment variable
        TI_CPU_MAX_NUM_THREADS goes before it.

    Returns
    -------
    str
        The arch that runs. Calling again with the same arch, or with "auto", keeps the device and its buffers; another
        arch drops both.

    Raises
    ------
    DeviceNotReady
        The machine lacks the arch, or has not as many threads.

    Examples
    --------
    >>> arch = colorphase.init("cpu")
    >>> truth = colorphase.simulate_frame(colorphase.simulated_rig((160, 120)))
    >>> f"{np.nanmedian(truth.points[..., 2]):.0f} mm, on the {arch}"
    '977 mm, on the cpu'
    """
    global _started, _failed, _cuda
    check_open()
    if cpu_threads is not None and not 1 <= cpu_threads <= _MOST_THREADS:
        raise DeviceNotReady(f"cpu_threads is {cpu_threads}: give a number from 1 to {_MOST_THREADS}")
    if arch == "auto":
        if _started is not None:
            return _started
        # Mesa's software Vulkan is many times slower than the CPU kernels, so "auto" looks for hardware first.
        candidates = [a for a in ARCHS if a != "vulkan" or any(not d.software for d in vulkan_devices())]
    elif arch in ARCHS:
        candidates = [arch]
    else:
        raise DeviceNotReady(f"no arch is called {arch!r}: choose auto, {', '.join(sorted(ARCHS))}")
    if arch == _started:
        return arch
    reasons = []
    for candidate in candidates:
        reason = _start(candidate, cpu_threads)
        if reason is None:
            _started, _failed = candidate, None
            _cuda = _CudaContext() if candidate == "cuda" else None
            traffic.on_device = candidate != "cpu"
            traffic.clear()
            _warn_of_slow_starts()
            _log.info("kernels run on %s, compiled by %s", candidate, language)
            return candidate
        _started = None  # a failed start has already ended what ran before
        reasons.append(reason)
    _failed = arch
    why = "; ".join(dict.fromkeys(reasons))  # what is wrong with the environment is so for all
    raise DeviceNotReady(f"{arch} cannot be started here ({why}): `colorphase devices` lists what can")


@functools.cache
def _warn_of_slow_starts() -> None:
    """Warn once of a cache that does not stay."""
    if not keeps_kernels:
        warnings.warn(_NOT_KEPT, SlowStart, stacklevel=3)


def stop() -> None:
    """End the device, which drops its buffers, and keep on the disk what it has compiled for the processes to come."""
    global _started
    if _started is not None:
        forget()
        with list_locked():
            ti.reset()
        _started = None


# Taichi's own end, which was registered earlier and so comes later, does not always keep them: without this, footage
# that a script decodes in several processes had its kernels compiled at each start, 16 s of 25.
atexit.register(stop)


def _refuse_fork() -> None:
    """Refuse every launch in a process that was forked from one in which a device had been started."""
    global lock, _started
    if _started is not None:
        close(_FORKED)
        lock, _started = threading.RLock(), None  # another thread of the old process may have held it
        # When this process ends the program must not wait for its threads: it is never taken apart.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(ti.lang.impl.get_runtime().prog))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_refuse_fork)


def started() -> str:
    """Return the arch that runs; where none does yet, "auto" is started.

    Raises
    ------
    DeviceNotReady
        One that was named could not be started: nothing else takes its place.
    """
    if _started is None:
        check_open()
        if _failed is not None:
            raise DeviceNotReady(f"{_failed} could not be started: call tikernels.init with another arch, or with auto")
        return init("auto")
    if _cuda is not None:
        _cuda.enter()
    return _started


def require(arch: str) -> None:
    """Make sure that this arch runs: another one has dropped its buffers.

    Raises
    ------
    DeviceNotReady
        Another one runs, or none.
    """
    if started() != arch:
        raise DeviceNotReady(f"{_started} has been started since, and what lay on {arch} is gone: make a new decoder")


def is_started() -> bool:
    """Return whether `init` has started a device."""
    return _started is not None


def kernel_language() -> str:
    """Return the language the kernels are compiled by: "taichi", or "quadrants" where Taichi does not import."""
    return language


def supported_archs() -> list[str]:
    """Return the archs that this machine can start, without starting any.

    Examples
    --------
    >>> len(colorphase.supported_archs()) >= 1, colorphase.supported_archs().count("cpu")
    (True, 1)
    """
    supported = []
    for arch in ARCHS:
        if arch == "vulkan":
            available = bool(vulkan_devices()) and _built_with(arch)
        else:
            available = arch == "cpu" or _built_with(arch)
        if available:
            supported.append(arch)
    return supported


def vulkan_devices() -> list[VulkanDevice]:
    """Ask the Vulkan loader for its devices; an empty list where there is no loader or no driver."""
    loader = _load_vulkan()
    if loader is None:
        return []
    # VkInstanceCreateInfo: sType = 1, then nothing requested; portability drivers (macOS) are left to Metal.
    create_info = (ctypes.c_uint64 * 8)(1)
    instance = ctypes.c_void_p()
    if loader.vkCreateInstance(create_info, None, ctypes.byref(instance)) != 0:
        return []
    try:
        count = ctypes.c_uint32()
        loader.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
        handles = (ctypes.c_void_p * count.value)()
        loader.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), handles)
        devices = []
        for handle in handles[: count.value]:
            # VkPhysicalDeviceProperties is 824 bytes: five uint32, of which the fifth is the type, then the name.
            properties = (ctypes.c_uint8 * 1024)()
            loader.vkGetPhysicalDeviceProperties(ctypes.c_void_p(handle), properties)
            kind = int.from_bytes(bytes(properties[16:20]), sys.byteorder)
            name = bytes(properties[20:276]).split(b"\0", 1)[0].decode(errors="replace")
            devices.append(VulkanDevice(name, software=kind == 4))  # VK_PHYSICAL_DEVICE_TYPE_CPU
        return devices
    finally:
        loader.vkDestroyInstance(instance, None)


def empty(shape: tuple[int, ...], dtype: type[E]) -> Array[E]:
    """Allocate a buffer where the kernels reach it fastest.

    On the CPU that is a NumPy array (the kernels write it in place, and handing it out costs no copy); on a GPU it is
    a device ndarray. Both are taken by every kernel.
    """
    if started() == "cpu":
        return empty_on_host(shape, dtype)
    buffer: DeviceArray[E] = ti.ndarray(DEVICE_TYPES[np.dtype(dtype).name], shape)
    return buffer


def empty_on_host(shape: tuple[int, ...], dtype: type[E]) -> npt.NDArray[E]:
    """Allocate an array whose vectors of sixteen begin where a CPU loads them as a whole; see `lanes.py`."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.empty(size + VECTOR_BYTES, np.uint8)
    start = -memory.ctypes.data % VECTOR_BYTES
    return np.asarray(memory[start : start + size].view(dtype).reshape(shape))


def to_device(array: npt.NDArray[E]) -> Array[E]:
    """Return a NumPy array as a buffer where the kernels reach it fastest; itself on the CPU."""
    if started() == "cpu":
        return array
    buffer: DeviceArray[E] = ti.ndarray(DEVICE_TYPES[array.dtype.name], array.shape)
    write(array, buffer)
    return buffer


def write(array: npt.NDArray[E], buffer: Array[E]) -> None:
    """Copy a NumPy array to a buffer of its shape, unless it is the buffer itself."""
    if isinstance(buffer, np.ndarray):
        if array is not buffer:
            buffer[...] = array
        return
    traffic.sent_bytes += array.nbytes
    buffer.from_numpy(array)


def to_host(buffer: Array[E]) -> npt.NDArray[E]:
    """Return a buffer as a NumPy array: itself on the CPU, a copy from a GPU."""  # synchronises
    if isinstance(buffer, np.ndarray):
        return buffer
    check_open()
    array = buffer.to_numpy()
    traffic.reads += 1
    traffic.read_bytes += array.nbytes
    return array


def is_device_array(array: object) -> TypeGuard[DeviceArray[np.generic]]:
    """Return whether this is an ndarray of the kernel language."""
    return isinstance(array, ti.Ndarray)


def has_dtype(buffer: DeviceArray[E], dtypes: Sequence[type[np.generic]]) -> bool:
    """Return whether a device ndarray's element type is one of NumPy's."""
    return any(DEVICE_TYPES.get(dtype.__name__) == buffer.element_type for dtype in dtypes)


def dtype_name(array: Array[E]) -> str:
    """Return the NumPy name of an array's element type."""
    if isinstance(array, np.ndarray):
        return str(array.dtype.name)
    return next((name for name, kind in DEVICE_TYPES.items() if kind == array.element_type), str(array.element_type))


def synchronize() -> None:
    """Wait until the device has finished; for measuring."""
    ti.sync()


def _start(arch: str, cpu_threads: int | None) -> str | None:
    """Start one arch; the reason where it cannot be."""
    if arch == "vulkan" and not vulkan_devices():
        return "vulkan: no driver"  # checked first because the runtime writes to stderr before it gives up
    if (fault := _environment_fault(arch)) is not None:
        return fault
    threads: dict[str, int] = {}
    if cpu_threads is not None and not any(name in os.environ for name in THREAD_VARIABLES):
        threads = {"cpu_max_num_threads": cpu_threads}
    # Taichi greets on standard output, which belongs to the program that uses us.
    with contextlib.redirect_stdout(open(os.devnull, "w")) as sink, sink:
        forget()
        try:
            with list_locked(), bound_to_cores() if arch == "cpu" else contextlib.nullcontext():
                ti.init(
                    arch=getattr(ti, arch),
                    enable_fallback=False,
                    log_level=ti.ERROR,
                    offline_cache=os.environ.get(f"{_PREFIX}_OFFLINE_CACHE_FILE_PATH") != NOWHERE,
                    **threads,
                )
        except (RuntimeError, ValueError) as error:  # also of a variable that is no number
            return f"{arch}: {str(error).splitlines()[-1].strip()}"
    return None


def _environment_fault(arch: str) -> str | None:
    """Return what in the environment keeps an arch from being started; most such ends the process otherwise."""
    named = os.environ.get(f"{_PREFIX}_ARCH")
    if named is not None and named != getattr(ti, arch).name:
        return f"{arch}: the environment variable {_PREFIX}_ARCH asks for {named!r}"
    for name in THREAD_VARIABLES:
        said = os.environ.get(name)
        if said and not (said.isdecimal() and 1 <= int(said) <= _MOST_THREADS):
            return f"the environment variable {name} is {said!r}: give a number of threads from 1 to {_MOST_THREADS}"
    return None


@contextlib.contextmanager
def bound_to_cores() -> Iterator[None]:
    """Bind the threads that starting the CPU creates in the body, if there is one for every core of the process.

    A kernel takes a fraction of a millisecond, each thread its share of it. A scheduler that wakes several of them on
    one core and spreads them a few milliseconds later comes too late: on a virtual machine of two cores the kernels of
    a frame took 23 ms with their threads bound, and 30 to 34 without. With fewer threads than cores, which cores to
    leave to others is not known here, and they stay unbound; so they do where the operating system offers no binding.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = _threads()
    yield
    cores = sorted(os.sched_getaffinity(0))
    count = ti.lang.impl.current_cfg().cpu_max_num_threads
    # The compiler's threads are created before the kernels'.
    created = sorted(_threads() - before)[-count:]
    if not 1 < count == len(cores) == len(created):
        return
    for thread, core in zip(created, cores, strict=True):
        try:
            os.sched_setaffinity(thread, {core})
        except OSError:  # a core that has been taken away since, or a thread that has ended
            return


def _threads() -> set[int]:
    """Return the numbers of this process's threads."""
    return {int(name) for name in os.listdir("/proc/self/task")}


def _built_with(arch: str) -> bool:
    ti._logging.set_logging_level("error")  # asking for CUDA where there is none would be logged as a warning
    try:
        return bool(getattr(ti._lib.core, f"with_{arch}")())
    except (AttributeError, RuntimeError):
        return False


def _load_vulkan() -> Any | None:
    for name in ("libvulkan.so.1", "libvulkan.1.dylib", "vulkan-1.dll"):
        with contextlib.suppress(OSError):
            return ctypes.CDLL(name)
    return None
