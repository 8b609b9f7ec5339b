"""Taichi where it imports, its fork Quadrants where it does not: the one place that chooses.

Taichi needs X11's libraries even on a machine without a screen and has no wheels for Python 3.14; Quadrants speaks the
same language without either. Every kernel file takes ``ti`` and its array types from here.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

# Importing must print nothing; both languages greet on import otherwise.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")
os.environ.setdefault("ENABLE_QUADRANTS_HEADER_PRINT", "False")


def _import_language() -> tuple[Any, str]:
    reasons = []
    for name in ("taichi", "quadrants"):
        try:
            return importlib.import_module(name), name
        except ImportError as error:
            reasons.append(f"{name}: {error}")
    raise ImportError(
        f"neither Taichi nor Quadrants can be imported ({'; '.join(reasons)}): pip install 'colorphase[headless]'"
    )


ti, language = _import_language()

# Array arguments of kernels: element type and number of axes.
if TYPE_CHECKING:
    F32Array1 = F32Array2 = F32Array3 = I32Array1 = I32Array2 = I32Array3 = U8Array1 = U8Array2 = AnyArray3 = Any
else:
    F32Array1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
    F32Array2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
    F32Array3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
    I32Array1 = ti.types.ndarray(dtype=ti.i32, ndim=1)
    I32Array2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
    I32Array3 = ti.types.ndarray(dtype=ti.i32, ndim=3)
    U8Array1 = ti.types.ndarray(dtype=ti.u8, ndim=1)
    U8Array2 = ti.types.ndarray(dtype=ti.u8, ndim=2)
    AnyArray3 = ti.types.ndarray(ndim=3)
