"""What is put in place of parts of Taichi: kernels compute the same, and errors are the same but for their drawings."""

import subprocess
import sys

import pytest

from tikernels._taichi import TESTED

pytestmark = pytest.mark.skipif(not TESTED, reason="only parts of Taichi 1.7.4 are replaced")

# Everything whose reading is different: functions called several times and with other types, a function that calls
# itself, methods, the methods of vectors and of objects at one node, kernels of two types, and errors.
_PROGRAM = """
import taichi as ti

vec3 = ti.types.vector(3, ti.f32)


class Fixed:
    def norm(self):
        return 7.0


fixed = Fixed()


@ti.func
def norm_of(thing: ti.template()):
    return thing.norm()


@ti.func
def power(base: ti.f32, count: ti.template()) -> ti.f32:
    result = 1.0
    if ti.static(count > 0):
        result = base * 1.5 + power(base + 1.0, count - 1) * base
    return result


def scaled(factor):
    @ti.func
    def scale(x):
        return factor * x

    return scale


double, triple = scaled(2.0), scaled(3.0)


@ti.data_oriented
class Owner:
    def __init__(self, offset):
        self.offset = offset

    @ti.func
    def shifted(self, x):
        return x + self.offset

    @ti.kernel
    def total(self, values: ti.types.ndarray(ndim=1)) -> ti.f32:
        total = 0.0
        for i in range(values.shape[0]):
            total += self.shifted(double(values[i])) + self.shifted(triple(values[i]))
        return total


@ti.kernel
def compute(values: ti.types.ndarray(ndim=1), out: ti.types.ndarray(ndim=1)):
    for i in values:
        x = ti.cast(values[i], ti.f32)
        out[i] = power(x, 4) + norm_of(vec3(x, 1.0, 2.0)) + norm_of(fixed)
        for k in ti.static(range(3)):
            out[i] += power(double(power(x, k)), 1) * max(x, max(x + k, k))


@ti.func
def unknown_name(x):
    y = x
    return y + nowhere


@ti.func
def wrong_type(x):
    return x + ti.cast(
        ti.i32, x
    )


def broken(function):
    @ti.kernel
    def kernel() -> ti.f32:
        return function(1.0)

    return kernel


@ti.kernel
def unsupported() -> ti.f32:
    lambda: 1
    return 1.0


def results():
    import numpy as np

    found = []
    for dtype in (np.float32, np.int32):
        values, out = np.arange(5).astype(dtype), np.zeros(5, np.float32)
        compute(values, out)
        found += [out.tobytes(), Owner(2.5).total(values), Owner(-1.0).total(values)]
    for kernel in (broken(unknown_name), broken(wrong_type), unsupported):
        try:
            kernel()
        except Exception as error:
            found.append((type(error).__name__, str(error)))
    return found
"""
_COMPARED = """
import importlib.util
import warnings

import taichi as ti

ti.init(arch=ti.cpu, offline_cache=False, log_level=ti.ERROR)
warnings.simplefilter("ignore")


def results():
    spec = importlib.util.spec_from_file_location("program", "program.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.results()


def without_drawings(found):
    if not isinstance(found, tuple):
        return found
    lines = [line for line in found[1].splitlines() if line]
    return found[0], [line for line in lines if line.startswith("File ")], lines[-1]


plain = results()
import tikernels._taichi
from taichi.lang import kernel_impl
from tikernels import _front_end

assert kernel_impl._inside_class is _front_end._inside_class
sooner = results()
for before, after in zip(plain, sooner, strict=True):
    assert without_drawings(before) == without_drawings(after), f"{before}\\n{after}"
print(*(found[1] for found in sooner if isinstance(found, tuple)))
"""


def test_kernels_and_errors_are_the_same(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(_PROGRAM, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", _COMPARED], cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = _PROGRAM.splitlines()
    for statement, function in (
        ("    return y + nowhere", "unknown_name"),
        ("    return x + ti.cast(", "wrong_type"),
        ("    lambda: 1", "unsupported"),
    ):
        assert f'File "{program}", line {lines.index(statement) + 1}, in {function}:' in done.stdout
