"""The calibration of the simulated rig, by its own pictures alone, and how far it is off the truth.

The demo and `colorphase capture --rig simulated` decode by what this writes.

python tests/benchmarks/simulated_calibration.py [--write] [--seed 1]
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import _tests_path  # noqa: F401
import numpy as np
from calibration_accuracy import depth_error_mm

from pipeline.acquisition import simulated_studio
from pipeline.acquisition.guided_capture import GuidedCapture
from pipeline.acquisition.simulated_studio import SimulatedStudio
from pipeline.calibration.board import Board
from pipeline.calibration.captures import CapturedFolder
from pipeline.calibration.pose_guide import PoseGuide
from pipeline.calibration.radiometry import measure_radiometry, radiometry_sequence
from pipeline.calibration.rig_geometry import solve_geometry
from pipeline.simulation import OWN_CALIBRATION, simulated_truth

BOARD = Board(kind="chessboard", squares=(11, 8), square_mm=24.0)


def main() -> None:
    """Calibrate, compare, and write if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    truth = simulated_truth()
    camera_px, projector_px = truth.geometry().camera.size_px, truth.geometry().projector.size_px
    with TemporaryDirectory() as folder:
        capture = GuidedCapture(SimulatedStudio(None, seed=options.seed), Path(folder), {}, lambda line: None, print)
        capture.check_rig()
        light = measure_radiometry(CapturedFolder(capture.take_light(), radiometry_sequence(projector_px).names))
        guide = PoseGuide(BOARD, camera_px, projector_px, truth.geometry().pattern)
        capture = GuidedCapture(SimulatedStudio(BOARD, seed=options.seed), Path(folder), {}, lambda line: None, print)
        capture.check_rig()
        capture.take_poses(BOARD, guide)
    found = solve_geometry(
        guide.poses, camera_px, projector_px, truth.geometry().pattern, light.add_to(None)
    ).calibration
    print(f"depth is off by {depth_error_mm(found.geometry(), truth.geometry()):.3f} mm RMS", end=", ")
    print(f"{found.uncertainty.depth_bias_mm:.3f} mm predicted")
    print("crosstalk is off by", np.abs(found.crosstalk_matrix - 0.8 * simulated_studio.LIGHT.crosstalk).max().round(5))
    if options.write:
        found.write(OWN_CALIBRATION, force=True)


if __name__ == "__main__":
    main()
