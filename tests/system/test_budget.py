"""What a start costs, in counts: a number that rises fails here, and is raised only with the reason in the commit.

Each kernel costs a fresh process the reading of its Python, once for each call that it inlines, and its machine code;
without kernels on the disk also its compilation, many times as much. Lines of LLVM do not count here: processors with
narrower vectors have twice as many.
"""

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from pipeline.output.range_image import write_png
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels._taichi import TESTED

pytestmark = [
    pytest.mark.skipif(not TESTED, reason="counts what Taichi 1.7.4 does"),
    pytest.mark.filterwarnings("default"),  # numbers that have fallen
]

# Kernels, and functions inlined in them, as Taichi makes them for the program that follows.
_COUNT = """
import atexit, json, sys
import tikernels._taichi
from taichi.lang.kernel_impl import Func, Kernel

counts = {"kernels": 0, "inlined": 0}
call, materialize = Func.__call__, Kernel.materialize


def counted_call(self, *arguments, **named):
    counts["inlined"] += 1
    return call(self, *arguments, **named)


def counted_kernel(self, key=None, args=None, arg_features=None):
    counts["kernels"] += key not in self.compiled_kernels
    materialize(self, key=key, args=args, arg_features=arg_features)


Func.__call__, Kernel.materialize = counted_call, counted_kernel
"""
_FRAMES = """
import numpy as np
from pipeline import Decoder, DecodeSettings
from pipeline.simulation import TYPICAL_CROSSTALK

decoder = Decoder(DecodeSettings(crosstalk_matrix=np.array(TYPICAL_CROSSTALK)), arch="cpu")
image = np.load(sys.argv[1])


def count(image):
    before = dict(counts)
    frame = decoder.decode(image)
    _ = frame.mask, frame.unwrapped_phase
    return {name: counts[name] - before[name] for name in counts}


first = count(image)
print(json.dumps([first, count(np.ascontiguousarray(image[:400, :601]))]))
"""
_DECODE = """
from pipeline.cli.main import main

sys.argv[0] = "colorphase"
try:
    main()
finally:
    print(json.dumps(counts))
"""
_HELP = """
import json, sys
from pipeline.cli.start import main

sys.argv = ["colorphase", *sys.argv[1:]]
try:
    main()
except SystemExit:
    pass
print(json.dumps(sorted(sys.modules)))
"""


def last_line(program, *arguments):
    """Run a program, and return what it has printed last, as JSON."""
    command = [sys.executable, "-c", program, *(str(argument) for argument in arguments)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def check(found, budget):
    """Compare with the most that is allowed; what has fallen is to be lowered there."""
    risen = {name: count for name, count in found.items() if count > budget[name]}
    assert not risen, f"{risen}, of {budget}: a start costs more; raise the budget only with the reason in the commit"
    fallen = {name: count for name, count in found.items() if count < 0.97 * budget[name]}
    if fallen:
        warnings.warn(f"{fallen}, of {budget}: a start costs less; lower the budget", stacklevel=2)


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    """Return a folder with a simulated frame, as an array and as a picture."""
    folder = tmp_path_factory.mktemp("budget")
    image = simulate_frame(simulated_rig(), SimulationSettings()).image
    np.save(folder / "image.npy", image)
    write_png(folder / "frame.png", image)
    return folder


def test_a_first_frame(picture):
    first, other_size = last_line(_COUNT + _FRAMES, picture / "image.npy")
    check(first, {"kernels": 38, "inlined": 719})
    check(other_size, {"kernels": 2, "inlined": 28})


def test_a_picture_with_all_its_files(picture, tmp_path):
    words = ("decode", picture / "frame.png", "--out", tmp_path / "out", "--arch", "cpu")
    check(last_line(_COUNT + _DECODE, *words), {"kernels": 55, "inlined": 849})
    assert Path(tmp_path / "out" / "mesh.ply").exists()


def test_the_version_and_the_help():
    """They load neither NumPy nor the kernel language, and no command."""
    for words, most in ((("--version",), 90), (("--help",), 350)):
        loaded = last_line(_HELP, *words)
        assert not {name.split(".")[0] for name in loaded} & {"numpy", "taichi", "pydantic", "hardware"}
        assert len(loaded) <= most, f"colorphase {words[0]} loads {len(loaded)} modules"
        ours = {name for name in loaded if name.split(".")[0] in ("pipeline", "tikernels")}
        assert ours <= {
            *("pipeline", "pipeline.cli", "pipeline.cli.console", "pipeline.cli.main", "pipeline.cli.start"),
            *("pipeline.errors", "pipeline.text", "tikernels", "tikernels.errors", "tikernels.lazy_names"),
        }
