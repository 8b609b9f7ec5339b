"""From a large picture to all its files, and meshes to PLY: python tests/benchmarks/shapes_to_files.py.

`colorphase decode` turns a picture of 4000x3000, coded and calibrated, into all its files, three times, starting Python
included. The PLY is that of a 640x480 frame, written ten times.
"""

import resource
import tempfile
import time
from pathlib import Path

import _tests_path  # noqa: F401 - puts support on the path
import numpy as np
from support.command_line import colorphase

from pipeline import Calibration, Decoder
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import write_mesh
from pipeline.output.range_image import write_png
from pipeline.output.surface_mesh import frame_mesh
from pipeline.simulation import SimulatedFrame, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

LARGE_PX, SMALL_PX = (4000, 3000), (640, 480)


def main() -> None:
    """Measure both, and say how fast."""
    runtime.init("cpu")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth, calibration = photographed(LARGE_PX)
        write_png(folder / "photo.png", np.asarray(truth.image, np.uint8))
        calibration.write(folder / "calibration.json")
        times = [decode_s(folder, number) for number in range(3)]
        cpu_s = resource.getrusage(resource.RUSAGE_CHILDREN)
        print(
            f"{LARGE_PX[0]}x{LARGE_PX[1]}: {min(times):.1f} s from file to files, the best of {len(times)} (goal: 15)"
        )
        print(f"of CPU {cpu_s.ru_utime / 3:.1f} s, and {cpu_s.ru_stime / 3:.1f} s of the system's, each")
        truth, calibration = photographed(SMALL_PX)
        mesh = frame_mesh(Decoder(calibration=calibration, arch="cpu").decode(truth.image))
        times = [write_s(folder, mesh) for _ in range(10)]
        rates = [len(mesh.vertices) / seconds / 1e6 for seconds in (min(times), float(np.median(times)))]
        print(f"PLY: {rates[0]:.1f} M points/s at best, {rates[1]:.1f} usually, of {len(mesh.vertices)} (goal: 5)")


def photographed(size_px: tuple[int, int]) -> tuple[SimulatedFrame, Calibration]:
    """Return a frame of a bust, and the rig's calibration with its light."""
    rig, light = simulated_rig(size_px, code="contrast"), SimulationSettings()
    response = np.tile(np.linspace(0, 1, 256) ** light.gamma, (3, 1))
    known = {"crosstalk_matrix": light.crosstalk_matrix, "response": response}
    return simulate_frame(rig, light), rig.model_copy(update=known)


def decode_s(folder: Path, number: int) -> float:
    """Return how long the command takes, s."""
    start = time.perf_counter()
    done = colorphase("decode", "photo.png", "--out", f"out{number}", "--calibration", "calibration.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    return time.perf_counter() - start


def write_s(folder: Path, mesh: Mesh) -> float:
    """Return how long writing a mesh takes, s."""
    start = time.perf_counter()
    write_mesh(mesh, folder / "mesh.ply")
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
