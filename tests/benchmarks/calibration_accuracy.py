"""The depth error that calibrations of drawn rigs leave, from captures of a board alone, beside the predicted one.

A 640x480 camera and a 1024x768 projector with lenses, axes and places of their own, 180 mm or so apart; a chessboard of
11x8 squares of 24 mm in the poses that the guide asks for, ten at most, near 900 mm; a projector's gamma of 1.8 to
2.4, crosstalk, a blur of half a pixel and noise of 1.5 levels. For each rig: the RMS depth error over the picture
900 mm away, the predicted one, and the RMS error of its parameters in their standard deviations.

python tests/benchmarks/calibration_accuracy.py [--rigs 20]
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import _tests_path  # noqa: F401
import cv2
import numpy as np

from pipeline import Calibration
from pipeline.acquisition.guided_capture import GuidedCapture
from pipeline.acquisition.simulated_studio import SimulatedStudio
from pipeline.calibration.board import Board
from pipeline.calibration.model import Geometry, Pattern
from pipeline.calibration.multishot import multishot_sequence
from pipeline.calibration.pose_guide import PoseGuide
from pipeline.calibration.rig_geometry import solve_geometry
from pipeline.calibration.simulated_board import CaptureLight
from pipeline.simulation import TYPICAL_CROSSTALK, simulated_rig

BOARD = Board(kind="chessboard", squares=(11, 8), square_mm=24.0)
CAMERA_PX, PROJECTOR_PX = (640, 480), (1024, 768)
DISTANCE_MM, PERIOD_PX = 900.0, 768 / 44


def main() -> None:
    """Print a row a rig, and the table's last rows over all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=20)
    options = parser.parse_args()
    print(f"{len(multishot_sequence(PROJECTOR_PX).names)} pictures a pose")
    print("| rig | depth off, mm | predicted, mm | parameters, sigmas |\n|---|---|---|---|")
    with ProcessPoolExecutor(2) as pool:
        rows = []
        for seed, row in enumerate(pool.map(calibrated, range(options.rigs))):
            print(f"| {seed} | {row[0]:.3f} | {row[1]:.3f} | {np.sqrt(np.mean(row[2] ** 2)):.2f} |", flush=True)
            rows.append(row)
    depth = np.array([row[0] for row in rows])
    pulls = np.abs(np.concatenate([row[2] for row in rows]))
    print(f"| RMS; worst | {np.sqrt((depth**2).mean()):.3f}; {depth.max():.3f} | | |")
    print(f"within two sigmas {(pulls < 2).mean():.1%} of the parameters, within four {(pulls < 4).mean():.1%}")


def calibrated(seed: int) -> tuple[float, float, np.ndarray]:
    """Return a rig's depth error and what is predicted of it, mm, and its parameters' errors, in sigmas."""
    rng = np.random.default_rng([46, seed])
    truth = drawn_rig(rng)
    light = CaptureLight(
        gamma=rng.uniform(1.8, 2.4), crosstalk=np.array(TYPICAL_CROSSTALK), blur_px=0.5, noise=1.5
    )  # fmt: skip
    pattern = Pattern(period_px=PERIOD_PX)
    studio = SimulatedStudio(BOARD, truth=truth, light=light, seed=seed)
    guide = PoseGuide(BOARD, CAMERA_PX, PROJECTOR_PX, pattern)
    with TemporaryDirectory() as folder:
        capture = GuidedCapture(studio, Path(folder), {}, lambda line: None, lambda line: None)
        capture.check_rig()
        capture.take_poses(BOARD, guide)
    found = solve_geometry(guide.poses, CAMERA_PX, PROJECTOR_PX, pattern).calibration
    off, predicted = [], found.uncertainty
    for name in ("camera", "projector"):
        values = [np.array([*lens.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *lens.distortion]) for lens in (
            getattr(found, name), getattr(truth, name))]  # fmt: skip
        off.append((values[0] - values[1]) / getattr(predicted, name))
    off.append((found.translation_mm - truth.translation_mm) / predicted.translation_mm)
    return depth_error_mm(found.geometry(), truth.geometry()), predicted.depth_bias_mm, np.concatenate(off)


def drawn_rig(rng: np.random.Generator) -> Calibration:
    """Return the usual rig with other focal lengths, axes, lenses and places."""
    rig = simulated_rig(
        CAMERA_PX,
        camera_distortion=(*rng.normal([-0.1, 0.05], [0.05, 0.04]), *rng.normal(0, 1e-3, 2), 0.0),
        projector_distortion=(*rng.normal([-0.05, 0.03], [0.03, 0.03]), *rng.normal(0, 1e-3, 2), 0.0),
    )
    for name, reach in (("camera", 12.0), ("projector", 15.0)):
        lens = getattr(rig, name)
        matrix = lens.matrix.copy()
        matrix[[0, 1], [0, 1]] *= rng.uniform(0.95, 1.08)
        matrix[:2, 2] += rng.normal(0, reach, 2)
        rig = rig.model_copy(update={name: lens.model_copy(update={"matrix": matrix})})
    turn = cv2.Rodrigues(rng.normal(0, 0.01, 3))[0]
    moved = turn @ rig.translation_mm * rng.uniform(0.8, 1.3)
    return rig.model_copy(update={"rotation": turn @ rig.rotation, "translation_mm": moved})


def depth_error_mm(found: Geometry, truth: Geometry) -> float:
    """Return the RMS over the picture of what depth comes out too large for a surface at the distance, mm."""
    width, height = CAMERA_PX
    grid = np.stack(np.meshgrid(np.linspace(0.2, 0.8, 7) * width, np.linspace(0.2, 0.8, 7) * height), -1).reshape(-1, 2)

    def cycles(geometry: Geometry, depth_mm: float) -> np.ndarray:
        rays = np.column_stack([geometry.camera.rays_through(grid), np.ones(len(grid))])
        return np.asarray(geometry.pattern_cycles(depth_mm * rays))

    seen = cycles(truth, DISTANCE_MM)
    slope = (cycles(found, DISTANCE_MM + 1) - cycles(found, DISTANCE_MM - 1)) / 2
    return float(np.sqrt((((seen - cycles(found, DISTANCE_MM)) / slope) ** 2).mean()))


if __name__ == "__main__":
    main()
