"""Taichi where it imports, its fork Quadrants where it does not: the one place that chooses.

Taichi needs X11's libraries even on a machine without a screen and has no wheels for Python 3.14; Quadrants speaks the
same language without either. Every kernel file takes ``ti`` and its array types from here.
"""

import atexit
import contextlib
import ctypes
import importlib
import os
import shutil
import sys
from typing import TYPE_CHECKING, Any, TypeAlias

# Importing must print nothing; both languages greet on import otherwise.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")
os.environ.setdefault("ENABLE_QUADRANTS_HEADER_PRINT", "False")
# Once a day Taichi would send its makers' server a number that identifies this machine, to check for new versions.
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")


def _is_usable(folder: str) -> bool:
    """Return whether a folder exists, even read-only, or can be made."""
    with contextlib.suppress(OSError):
        os.makedirs(folder, exist_ok=True)
        return os.access(folder, os.R_OK | os.X_OK)
    return False


def _temporary_folder() -> str:
    """Make a folder that lives as long as this process, for it and those that it starts; `NOWHERE` if none can be."""
    import tempfile  # slow to import, and seldom needed

    try:
        folder = tempfile.mkdtemp(prefix="colorphase-kernels-")
    except OSError:
        return NOWHERE
    owner = os.getpid()  # not a fork of it
    atexit.register(lambda: shutil.rmtree(folder, ignore_errors=True) if os.getpid() == owner else None)
    return folder


def _provide_cache(name: str) -> bool:
    """Make sure that a language has a folder for what it compiles; return whether that stays.

    Without a home it ends the process as soon as it is imported, and without a folder when it ends: services and
    containers may have neither.
    """
    if os.name == "nt":
        return True
    prefix = "ti" if name == "taichi" else "qd"
    variable = f"{prefix}_offline_cache_file_path".upper()
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.environ.get("HOME", ""), ".cache")
    if not os.path.isabs(home):  # kernels are programs, and must not come from the current folder
        home = ""
    folder = os.environ.get(variable) or (home and os.path.join(home, name, f"{prefix}cache"))
    stays = bool(folder) and _is_usable(str(folder))
    if not stays:
        os.environ[variable] = _temporary_folder()
    if not home:
        os.environ["XDG_CACHE_HOME"] = os.environ[variable]
    return stays


def _import_language() -> tuple[Any, str, bool]:
    reasons = []
    for name in ("taichi", "quadrants"):
        try:
            if name == "taichi" and sys.platform == "linux":
                # Asked first, because a failing import prints advice that is of no help here.
                ctypes.CDLL("libX11.so.6")
            stays = _provide_cache(name)
            return importlib.import_module(name), name, stays
        except (ImportError, OSError) as error:
            reasons.append(f"{name}: {error}")
    raise ImportError(
        f"neither Taichi nor Quadrants can be imported ({'; '.join(reasons)}): pip install 'colorphase[headless]'"
    )


#: The cache folder where none can be made: one that is there, as the language wants it.
NOWHERE = os.path.abspath(os.sep)
#: The language, its name, and whether kernels are kept for the processes to come.
ti, language, keeps_kernels = _import_language()
#: Versions whose inner parts we know; others are used as they are. What is done outside their public interface must not
#: change what kernels compute.
TESTED = (language, tuple(ti.__version__)) == ("taichi", (1, 7, 4))


if TESTED:
    from tikernels._front_end import read_sooner

    read_sooner()

#: Element types of a device's buffers, by NumPy's names.
DEVICE_TYPES: dict[str, Any] = {
    name: getattr(ti, short)
    for name, short in (("float32", "f32"), ("int32", "i32"), ("uint8", "u8"), ("uint16", "u16"), ("uint32", "u32"))
}

# Array arguments of kernels (element type and number of axes), and small vectors; types that mypy treats as Any.
if TYPE_CHECKING:
    F32Array1: TypeAlias = Any
    F32Array2: TypeAlias = Any
    F32Array3: TypeAlias = Any
    F32Array4: TypeAlias = Any
    I32Array1: TypeAlias = Any
    I32Array2: TypeAlias = Any
    I32Array3: TypeAlias = Any
    U8Array2: TypeAlias = Any
    U8Array3: TypeAlias = Any
    AnyArray2: TypeAlias = Any
    AnyArray3: TypeAlias = Any
    vec2: TypeAlias = Any
    vec3: TypeAlias = Any
    vec4: TypeAlias = Any
    vec5: TypeAlias = Any
    vec6: TypeAlias = Any
    vec8: TypeAlias = Any
    vec16: TypeAlias = Any
    vec21: TypeAlias = Any
    vec32: TypeAlias = Any
    Vec16Array1: TypeAlias = Any
    Vec16Array2: TypeAlias = Any
    Vec16Array3: TypeAlias = Any
    ivec2: TypeAlias = Any
    ivec4: TypeAlias = Any
    mat3: TypeAlias = Any
    mat4: TypeAlias = Any
    mat5: TypeAlias = Any
    mat6: TypeAlias = Any
    f32: TypeAlias = Any
    i32: TypeAlias = Any
    u1: TypeAlias = Any
    Static: TypeAlias = Any
else:
    F32Array1, F32Array2, F32Array3, F32Array4 = (ti.types.ndarray(dtype=ti.f32, ndim=n) for n in (1, 2, 3, 4))
    I32Array1, I32Array2, I32Array3 = (ti.types.ndarray(dtype=ti.i32, ndim=n) for n in (1, 2, 3))
    U8Array2, U8Array3 = (ti.types.ndarray(dtype=ti.u8, ndim=n) for n in (2, 3))
    AnyArray2, AnyArray3 = (ti.types.ndarray(ndim=n) for n in (2, 3))
    vec2, vec3, vec4, vec5, vec6, vec8, vec16, vec21, vec32 = (
        ti.types.vector(n, ti.f32) for n in (2, 3, 4, 5, 6, 8, 16, 21, 32)
    )
    # A CPU loads and adds all sixteen at once: of an array of numbers it does not know that they lie in a row.
    Vec16Array1, Vec16Array2, Vec16Array3 = (ti.types.ndarray(dtype=vec16, ndim=n) for n in (1, 2, 3))
    ivec2, ivec4 = (ti.types.vector(n, ti.i32) for n in (2, 4))
    mat3, mat4, mat5, mat6 = (ti.types.matrix(n, n, ti.f32) for n in (3, 4, 5, 6))
    f32, i32, u1 = ti.f32, ti.i32, ti.u1
    Static = ti.template()  # known when the kernel is compiled
