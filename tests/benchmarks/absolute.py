"""The study of absolute orders: five simulated scenes with and without the code, measured against their truth.

python tests/benchmarks/absolute.py [--arch cpu]
"""

import argparse
import warnings

import cv2
import numpy as np

from pipeline import Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.output.report import measure_against_truth
from pipeline.simulation import SKIN, WHITE, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.scene.scene_shapes import SHAPES

#: What the frames differ by: surface and response, and blur (px) of the projector and of the camera.
SURFACES = (("skin, gamma 2", 2.0, SKIN), ("white, gamma 1", 1.0, WHITE))
BLURS = ((0.0, 0.0), (1.0, 0.7))


def main() -> None:
    """Print one row a scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arch", default="cpu")
    runtime.init(parser.parse_args().arch)
    warnings.simplefilter("ignore", DecodeWarning)  # the table says how much is flagged
    print(
        "| scene | surface | blur, px | absolute and right | absolute but wrong | flagged | phase error, rad | ratio |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for blur in BLURS:
        for name, gamma, color in SURFACES:
            for scene in SHAPES:
                row(scene, name, gamma, color, blur)


def row(scene: str, name: str, gamma: float, color: tuple[float, float, float], blur_px: tuple[float, float]) -> None:
    """Print what one scene comes to, its phase error relative to that of the pattern without the code."""
    settings = SimulationSettings(
        scene=scene,
        gamma=gamma,
        reflectance=color,
        projector_blur_px=(blur_px[0],) * 3,
        camera_blur_px=(blur_px[1],) * 3,
    )
    errors = []
    for code in (None, "contrast"):
        rig = simulated_rig(code=code)
        truth = simulate_frame(rig, settings)
        calibration = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})
        frame = Decoder(DecodeSettings(), calibration).decode(truth.image)
        errors.append(measure_against_truth(frame, truth)["phase_rms_rad"])
    square = np.ones((9, 9), np.uint8)
    inside = cv2.erode(truth.mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    lit = (inside != 0) & (truth.image.mean(axis=2) > 20)
    known = frame.absolute & lit
    wrong = known & (np.abs(np.nan_to_num(frame.unwrapped_phase) - truth.phase) > np.pi)
    shares = [float(part.sum() / lit.sum()) for part in (known & ~wrong, wrong, lit & frame.mask & ~frame.absolute)]
    print(
        f"| {scene} | {name} | {blur_px[0]:g}, {blur_px[1]:g} | {shares[0]:.4f} | {shares[1]:.5f} | {shares[2]:.4f} "
        f"| {errors[1]:.4f} | {errors[1] / errors[0]:.2f} |"
    )


if __name__ == "__main__":
    main()
