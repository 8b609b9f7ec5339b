"""The accuracy study: five simulated scenes, two surfaces, measured against their truth.

python tests/benchmarks/accuracy.py [--arch cpu]
"""

import argparse

from pipeline import Decoder, DecodeSettings
from pipeline.output.report import measure_against_truth
from pipeline.simulation import SKIN, WHITE, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.scene.scene_shapes import SHAPES


def main() -> None:
    """Print one row a scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arch", default="cpu")
    runtime.init(parser.parse_args().arch)
    print("| scene | surface | phase error, rad | constant, rad | coverage | wrong orders | depth error, mm |")
    print("|---|---|---|---|---|---|---|")
    for gamma, color, name in ((2.0, SKIN, "skin, gamma 2"), (1.0, WHITE, "white, gamma 1")):
        for scene in SHAPES:
            settings = SimulationSettings(scene=scene, gamma=gamma, reflectance=color)
            rig = simulated_rig()
            truth = simulate_frame(rig, settings)
            calibration = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})
            m = measure_against_truth(Decoder(DecodeSettings(), calibration).decode(truth.image), truth)
            print(
                f"| {scene} | {name} | {m['phase_rms_rad']:.4f} | {m['phase_constant_rad']:+.4f} | {m['coverage']:.3f} "
                f"| {m['wrong_orders']} | {m['depth_rms_order_known_mm']:.3f} |"
            )


if __name__ == "__main__":
    main()
