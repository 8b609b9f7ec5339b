"""The study of absolute orders: five simulated scenes under both codes, against their truth.

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

#: What the frames differ by: surface and response.
SURFACES = (("skin, gamma 2", 2.0, SKIN), ("white, gamma 1", 1.0, WHITE))
#: Blur (px) of the projector and of the camera.
BLUR_PX = (1.0, 0.7)
SMOOTHING_PX = DecodeSettings().smoothing_px
CODES = ("contrast", "contrast2")


def main() -> None:
    """Print one row a scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arch", default="cpu")
    runtime.init(parser.parse_args().arch)
    warnings.simplefilter("ignore", DecodeWarning)  # the table says how much is flagged
    print("| scene | surface | absolute and right | wrong per 100,000 | ratio of phase errors | unsmoothed |")
    print("|---|---|---|---|---|---|")
    for name, gamma, color in SURFACES:
        for scene in SHAPES:
            row(scene, name, gamma, color)


def row(scene: str, name: str, gamma: float, color: tuple[float, float, float]) -> None:
    """Print the figures of one scene under each code, its phase errors relative to those of the plain pattern."""
    settings = SimulationSettings(
        scene=scene,
        gamma=gamma,
        reflectance=color,
        projector_blur_px=(BLUR_PX[0],) * 3,
        camera_blur_px=(BLUR_PX[1],) * 3,
    )
    figures, plain = [], np.zeros(2)
    square = np.ones((9, 9), np.uint8)
    for code in (None, *CODES):
        rig = simulated_rig(code=code)
        truth = simulate_frame(rig, settings)
        calibration = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})
        raw, frame = (
            Decoder(DecodeSettings(smoothing_px=px), calibration).decode(truth.image) for px in (0, SMOOTHING_PX)
        )
        errors = np.array([measure_against_truth(seen, truth)["phase_rms_rad"] for seen in (frame, raw)])
        if code is None:
            plain = errors
            continue
        inside = cv2.erode(truth.mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        lit = (inside != 0) & (truth.image.mean(axis=2) > 20)
        known = frame.absolute & lit
        wrong = known & (np.abs(np.nan_to_num(frame.unwrapped_phase) - truth.phase) > np.pi)
        right = known & ~wrong
        shares = right.sum() / lit.sum(), 1e5 * wrong.sum() / lit.sum(), *(errors / plain)
        figures.append([f"{share:{form}}" for share, form in zip(shares, (".4f", ".0f", ".2f", ".2f"), strict=True)])
    print(f"| {scene} | {name} | " + " | ".join(" / ".join(cell) for cell in zip(*figures, strict=True)) + " |")


if __name__ == "__main__":
    main()
