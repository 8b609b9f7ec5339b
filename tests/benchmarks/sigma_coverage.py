"""The study of standard deviations: how many errors lie within one and two of them, in all, in bins, and of constants.

python tests/benchmarks/sigma_coverage.py [--arch cpu] [--frames 40]
"""

import argparse
import warnings
from collections.abc import Iterator

import cv2
import numpy as np
import numpy.typing as npt

from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.decoding.frame import DecodedFrame
from pipeline.errors import DecodeWarning
from pipeline.output.report import measure_against_truth
from pipeline.simulation import (
    SKIN,
    TYPICAL_CROSSTALK,
    WHITE,
    SimulatedFrame,
    SimulationSettings,
    simulate_frame,
    simulated_rig,
)
from tikernels import runtime
from tikernels.scene.scene_shapes import SHAPES

#: Bins of fewer pixels say nothing.
_MIN_PX = 500
#: What random rigs differ by: errors of the calibration's crosstalk, and periods in projector px.
CASES = (
    ("crosstalk known", 0.0, (12, 26)),
    ("each leak off by 0.005", 0.005, (12, 26)),
    ("each leak off by 0.02", 0.02, (12, 26)),
    ("4 to 10 cycles in view", 0.0, (60, 150)),
    ("crosstalk unknown", None, (12, 26)),
)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arch", default="cpu")
    parser.add_argument("--frames", type=int, default=40, help="random frames for each row of the second table")
    arguments = parser.parse_args()
    runtime.init(arguments.arch)
    warnings.simplefilter("ignore", DecodeWarning)  # what is not known is what is measured
    print("| scene | surface | smoothing, px | all | modulation | distance to the edge | phase |")
    print("|---|---|---|---|---|---|---|")
    for gamma, color, name in ((2.0, SKIN, "skin, gamma 2"), (1.0, WHITE, "white, gamma 1")):
        for scene in SHAPES:
            truth = simulate_frame(
                simulated_rig(), SimulationSettings(scene=scene, gamma=gamma, reflectance=color, seed=1)
            )
            for smoothing in (0, 7):
                pixels(truth, name, scene, smoothing)
    print("\n| frames | constant, rad RMS | its sigma, rad RMS | within one | within two |")
    print("|---|---|---|---|---|")
    for name, error, periods in CASES:
        constants(name, arguments.frames, error, periods)


def pixels(truth: SimulatedFrame, name: str, scene: str, smoothing_px: int) -> None:
    """Print how many errors of one frame lie within one and two sigma; of bins, the lowest and the highest share."""
    calibration = truth.rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    frame = Decoder(DecodeSettings(smoothing_px=smoothing_px), calibration).decode(truth.image)
    inside = cv2.distanceTransform(truth.mask.astype(np.uint8), cv2.DIST_L2, 5)
    lit = frame.mask & (inside > 4) & (truth.image.mean(axis=2) > 20)
    error = np.angle(np.exp(1j * (frame.wrapped_phase[lit] - truth.phase[lit])))
    pull = np.abs(error - np.median(error)) / frame.phase_sigma[lit]
    edge = cv2.distanceTransform((frame.mask & truth.mask).astype(np.uint8), cv2.DIST_L2, 5)[lit]
    modulation = frame.modulation[lit]
    bins = (
        np.digitize(modulation, np.quantile(modulation, (0.2, 0.4, 0.6, 0.8))),
        np.digitize(edge, (6, 10, 20, 40)),
        np.digitize(frame.wrapped_phase[lit], np.arange(-3, 4) * np.pi / 4),
    )
    print(
        f"| {scene} | {name} | {smoothing_px} | {shares(pull)} | "
        + " | ".join(f"{extremes(pull, numbers)}" for numbers in bins)
        + " |"
    )


def shares(pull: npt.NDArray[np.floating]) -> str:
    """Return the percentages within one and two sigma."""
    return f"{100 * (pull < 1).mean():.0f} / {100 * (pull < 2).mean():.0f}"


def extremes(pull: npt.NDArray[np.floating], numbers: npt.NDArray[np.int_]) -> str:
    """Return the percentages of the bins with the lowest and the highest share within one sigma."""
    parts = [pull[numbers == k] for k in np.unique(numbers) if (numbers == k).sum() >= _MIN_PX]
    parts.sort(key=lambda part: (part < 1).mean())
    return f"{shares(parts[0])} to {shares(parts[-1])}"


def random_frames(
    count: int, matrix_error: float | None, periods: tuple[float, float]
) -> Iterator[tuple[SimulatedFrame, Calibration]]:
    """Yield random frames, each with the calibration to decode it with."""
    rng = np.random.default_rng(7)
    for _ in range(count):
        settings = SimulationSettings(
            scene=str(rng.choice(SHAPES)),
            gamma=rng.uniform(1, 2.4),
            reflectance=tuple(rng.uniform(0.3, 0.9, 3)),
            texture=rng.uniform(0, 0.3),
            crosstalk_matrix=np.clip(np.array(TYPICAL_CROSSTALK) + rng.normal(0, 0.02, (3, 3)), 0, 1),
            ambient=rng.uniform(0, 0.15),
            noise_levels=rng.uniform(0.5, 3),
            object_motion_mm=tuple(rng.uniform(-20, 20, 3)),
            object_turn_deg=rng.uniform(-30, 30),
            seed=int(rng.integers(2**31)),
        )
        truth = simulate_frame(simulated_rig(period_px=rng.uniform(*periods)), settings)
        matrix = settings.crosstalk_matrix + rng.normal(0, 1, (3, 3)) * (matrix_error or 0)
        yield (
            truth,
            truth.rig.model_copy(update={"crosstalk_matrix": None if matrix_error is None else matrix}),
        )


def constants(name: str, count: int, matrix_error: float | None, periods: tuple[float, float]) -> None:
    """Print how far the frames' constants are off, and how far they say that they may be."""
    found: list[tuple[float, DecodedFrame]] = []
    for truth, calibration in random_frames(count, matrix_error, periods):
        frame = Decoder(DecodeSettings(), calibration).decode(truth.image)
        found.append((float(measure_against_truth(frame, truth)["phase_constant_rad"]), frame))
    errors = np.abs([error for error, _ in found])
    sigmas = np.array([frame.constant_sigma for _, frame in found])
    root = [np.sqrt((values**2).mean()) for values in (errors, sigmas)]
    within = [(errors < k * sigmas).mean() for k in (1, 2)]
    print(f"| {name} | {root[0]:.4f} | {root[1]:.4f} | {within[0]:.2f} | {within[1]:.2f} |", flush=True)


if __name__ == "__main__":
    main()
