"""The study of depth ranges: what true and false ones make of a plain pattern's orders, over the five scenes.

python tests/benchmarks/depth_ranges.py [--arch cpu]
"""

import argparse
import warnings

import numpy as np

from pipeline import Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.scene.scene_shapes import SHAPES

#: Depths that are off by more than this, mm, have another order.
_OTHER_ORDER_MM = 15.0


def ranges(nearest: float, middle: float, farthest: float) -> dict[str, tuple[float, float]]:
    """Return what somebody may say of things that are between two depths, mm, half of them beyond the middle."""
    return {
        "as it is": (nearest, farthest),
        "10 mm more": (nearest - 10, farthest + 10),
        "30 mm about the median": (middle - 15, middle + 15),
        "25 mm too far": (nearest + 25, farthest + 25),
        "50 mm too far": (nearest + 50, farthest + 50),
        "55 mm behind": (farthest + 30, farthest + 85),
        "55 mm before": (nearest - 85, nearest - 30),
        "the nearest 60 mm": (nearest, nearest + 60),
    }


def main() -> None:
    """Print what each range made of each scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arch", default="cpu")
    arch = parser.parse_args().arch
    runtime.init(arch)
    print("| scene | range, mm | holds it | absolute | absolute and wrong | told |\n|---|---|---|---|---|---|")
    for scene in SHAPES:
        rig, settings = simulated_rig(), SimulationSettings(scene=scene)
        truth = simulate_frame(rig, settings)
        depth = truth.points[..., 2][truth.mask]
        ends = float(depth.min()), float(depth.max())
        for said in ranges(ends[0], float(np.median(depth)), ends[1]).values():
            known = {"crosstalk_matrix": settings.crosstalk_matrix, "depth_range_mm": said}
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always", DecodeWarning)
                frame = Decoder(DecodeSettings(), rig.model_copy(update=known), arch=arch).decode(truth.image)
            assert frame.points is not None
            seen = frame.mask & truth.mask
            wrong = np.abs(frame.points - truth.points)[..., 2] > _OTHER_ORDER_MM
            shares = ((frame.absolute & seen).sum() / seen.sum(), (frame.absolute & seen & wrong).sum() / seen.sum())
            holds = said[0] <= ends[0] + 1 and said[1] >= ends[1] - 1
            print(
                f"| {scene} | {said[0]:.0f} to {said[1]:.0f} | {'yes' if holds else 'no'} "
                f"| {shares[0]:.3f} | {shares[1]:.3f} | {'yes' if told else 'no'} |"
            )


if __name__ == "__main__":
    main()
