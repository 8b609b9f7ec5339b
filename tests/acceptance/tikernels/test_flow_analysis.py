"""Kernels are compiled without Taichi's flow analysis, in a child here: LLVM ends a process that it fails in."""

import os
import subprocess
import sys

import pytest

from tikernels._taichi import TESTED

pytestmark = [
    pytest.mark.skipif(not TESTED, reason="only Taichi 1.7.4 goes without"),
    pytest.mark.timeout(900),
]

# All fields and meshes of what makes kernels' variants: code, calibration, stripes, levels, period, and threads, which
# share larger frames.
_PROGRAM = """
import numpy as np
from pipeline import Decoder, DecodeSettings
from pipeline.decoding.frame import FIELDS
from pipeline.output.surface_mesh import frame_mesh
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

runtime.init("cpu", cpu_threads=2)
for code, stripes, known, levels, size, period_px in (
    (None, "horizontal", False, np.uint8, 160, 70.0),
    (None, "vertical", True, np.uint16, 160, 70.0),
    ("contrast", "horizontal", True, np.float32, 160, 70.0),
    ("contrast", "vertical", False, np.uint8, 160, 70.0),
    (None, "horizontal", True, np.uint8, 160, 38.0),
    ("contrast", "horizontal", False, np.uint8, 800, 14.0),
):
    rig = simulated_rig((size, size * 3 // 4), period_px=period_px, code=code, stripes=stripes)
    image = simulate_frame(rig, SimulationSettings(scene="objects")).image
    image = image if levels is np.uint8 else image.astype(levels) * (257 if levels is np.uint16 else levels(1 / 255))
    decoder = Decoder(DecodeSettings(code=code, stripes=stripes), rig if known else None)
    for frame in (first := decoder.decode(image), decoder.decode(image, previous=first)):
        for name in FIELDS:
            getattr(frame, name)
        frame_mesh(frame)
runtime.stop()
"""


def test_every_kernel_of_a_frame_is_compiled(tmp_path):
    """Anew: what is on the disk has been compiled before."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path)}
    command = [sys.executable, "-W", "ignore", "-c", _PROGRAM]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=800, check=False)
    assert done.returncode == 0, done.stderr
