"""Kernels that are compiled without Taichi's flow analysis, in a child: LLVM ends a process that it fails in."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tikernels import runtime
from tikernels._taichi import TESTED

pytestmark = pytest.mark.skipif(not TESTED, reason="only Taichi 1.7.4 goes without")

_KERNELS = Path(runtime.__file__).parent
# Both patterns, one with a calibration, all fields and a mesh.
_PROGRAM = """
import json
import tikernels._taichi
from taichi.lang.kernel_impl import Kernel

compiled = set()
materialize = Kernel.materialize


def noted(self, key=None, args=None, arg_features=None):
    compiled.add(self.func.__name__)
    materialize(self, key=key, args=args, arg_features=arg_features)


Kernel.materialize = noted

from pipeline import Decoder, DecodeSettings
from pipeline.decoding.frame import FIELDS
from pipeline.output.surface_mesh import frame_mesh
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

runtime.init("cpu")
for code in (None, "contrast"):
    rig = simulated_rig((160, 120), period_px=4 * 768 / 44, code=code)
    image = simulate_frame(rig, SimulationSettings(scene="objects")).image
    frame = Decoder(DecodeSettings(code=code), rig if code else None).decode(image)
    for name in FIELDS:
        getattr(frame, name)
    frame_mesh(frame)
runtime.stop()
print(json.dumps(sorted(compiled)))
"""


def kernels_without():
    """Yield the names of the kernels that are declared to go without."""
    for path in _KERNELS.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for decorator in getattr(node, "decorator_list", []):
                if "flow_analysis=False" in ast.unparse(decorator):
                    yield node.name


def test_every_one_is_compiled(tmp_path):
    """Anew: what is on the disk has been compiled before."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path)}
    command = [sys.executable, "-W", "ignore", "-c", _PROGRAM]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stderr
    without = set(kernels_without())
    assert without
    assert without <= set(json.loads(done.stdout.splitlines()[-1]))
