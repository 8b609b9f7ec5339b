"""Depth of the simulated portrait, captured and decoded as `colorphase capture --rig simulated` does it.

python tests/benchmarks/simulated_portrait.py [--bursts 8] [--frames 3] [--webcam]

Bursts are captured from the simulated rig and decoded by the calibration that it has found by itself. Some frames of
each burst are compared with the true head at the very place that they show. The last line is the part of the bias that
comes from the calibration: the bias of the depth that it computes from the true phase.
"""

import argparse
from functools import cache
from itertools import islice

import _tests_path  # noqa: F401 - puts support on the path
import numpy as np
from support.portrait_figures import WALL_FROM_MM, PortraitFigures, portrait_figures

from hardware.rig import Rig
from pipeline import Decoder
from pipeline.acquisition import simulated_capture
from pipeline.acquisition.simulated_camera import WEBCAM_NAME
from pipeline.acquisition.simulated_capture import SETTINGS, place_at, simulate_place, simulated_instruments
from tikernels import runtime
from tikernels.depth.triangulation import triangulate


def main() -> None:
    """Capture, decode, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bursts", type=int, default=8)
    parser.add_argument("--frames", type=int, default=3, help="decoded per burst")
    parser.add_argument("--webcam", action="store_true")
    options = parser.parse_args()
    settings = SETTINGS
    if options.webcam:
        camera = SETTINGS.camera.model_copy(update={"serial": WEBCAM_NAME})
        timing = SETTINGS.timing.model_copy(update={"period_s": 0.05})  # by a webcam's 30 frames a second
        settings = SETTINGS.model_copy(update={"camera": camera, "timing": timing})
    open_instruments, calibration = simulated_instruments(settings, "cpu", lambda step: None)
    with Rig(settings, open_instruments) as rig:
        bursts = list(islice(rig.bursts(), options.bursts))
    runtime.init("cpu")
    n_places = simulated_capture._PLACES
    true_place = cache(lambda place: simulate_place(place, n_places))
    decoder = Decoder(calibration=calibration, arch="cpu")
    print("| burst | pulse | place | " + " | ".join(PortraitFigures._fields) + " |")
    print("|---" * (3 + len(PortraitFigures._fields)) + "|")
    found = []
    for burst in bursts:
        for paired in burst.frames[:: -(-len(burst.frames) // options.frames)]:
            place = place_at(paired.frame.device_time_s, settings.timing.period_s, n_places)
            found.append(portrait_figures(decoder.decode(paired.image), true_place(place)))
            _show(str(burst.number), str(paired.pulse), str(place), found[-1])
    squares = np.sqrt(np.mean(np.square(found), axis=0))
    _show("RMS of all", "", "", PortraitFigures(*squares))
    _show("mean of all", "", "", PortraitFigures(*np.mean(found, axis=0)))
    truth, geometry = true_place(n_places // 2), calibration.geometry()
    rays, triangulation = geometry.camera.rays(), geometry.for_triangulation()
    points = runtime.to_host(triangulate(truth.phase.astype(np.float32), rays, triangulation))
    head = truth.mask & (truth.points[..., 2] < WALL_FROM_MM)
    print(f"\nthe calibration's part of the bias: {(points - truth.points)[head, 2].mean():.3f} mm")


def _show(burst: str, pulse: str, place: str, figures: PortraitFigures) -> None:
    print(f"| {burst} | {pulse} | {place} | " + " | ".join(f"{figure:.4f}" for figure in figures) + " |", flush=True)


if __name__ == "__main__":
    main()
