"""Packages import their public names when they are first used."""

import subprocess
import sys
from importlib import import_module

import pytest

PACKAGES = [
    "colorphase",
    "tikernels",
    *(f"tikernels.{room}" for room in ("raw", "phase", "depth", "unwrapping", "order_evidence", "scene")),
    "hardware",
    "pipeline",
    *(f"pipeline.{room}" for room in ("footage", "recording", "calibration", "decoding", "orders")),
    *(f"pipeline.{room}" for room in ("planning", "output", "diagnosis", "batch", "acquisition")),
]


def test_every_public_name_is_there():
    for name in PACKAGES:
        package = import_module(name)
        assert set(package.__all__) <= set(dir(package)), name
        for public in package.__all__:
            assert getattr(package, public) is getattr(package, public), f"{name}.{public}"
        with pytest.raises(AttributeError, match=f"module '{name}' has no attribute 'nothing'"):
            _ = package.nothing


def test_importing_loads_neither_numpy_nor_the_kernel_language():
    program = (
        f"import sys, {', '.join(PACKAGES)}\n"
        "assert not {'numpy', 'taichi', 'quadrants', 'pydantic'} & set(sys.modules)\n"
        "import tikernels\nassert callable(tikernels.init)\n"
        "from pipeline import Calibration, DecodeSettings, Decoder\n"
        "assert {'numpy', 'tikernels.unwrapping.unwrapper'} <= set(sys.modules)\n"
        "assert not {'pipeline.output.mesh', 'hardware.rig'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, "")
