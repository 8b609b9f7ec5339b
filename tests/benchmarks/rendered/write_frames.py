"""Write frames with their truth as files.

    python tests/benchmarks/rendered/write_frames.py FOLDER [SCENE ...] [--patterns plain] [--projector lamp]

Of every scene: SCENE_PATTERN_16.png (noise-free, 16 bits), SCENE_PATTERN_8.png (noise, 8 bits), SCENE_truth.npz
(projector_row, depth_mm, lit, surface, mm_per_rad) and SCENE_surfaces.json; and calibration_PROJECTOR.json, the true
geometry with matrix and response as ramps tell them, and spectra.json, the reflectance of every paint.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
from camera_film import Optics, Sensor, noise_free
from rendered_scenes import scenes
from spectra import CAMERAS, INDUSTRIAL, LED, PAINTS, PROJECTORS, WAVELENGTHS, reflectance
from studio import FIELDS, PATTERNS, Rig, Studio

from tikernels import runtime


def main() -> None:
    """Write the frames that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scene", nargs="*", help=f"of {', '.join(scenes())}; none: all")
    parser.add_argument("--patterns", nargs="+", choices=(*PATTERNS, *FIELDS), default=PATTERNS)
    parser.add_argument("--projector", choices=PROJECTORS, default=LED.name)
    parser.add_argument("--camera", choices=CAMERAS, default=INDUSTRIAL.name)
    parser.add_argument("--gamma", type=float, default=2.0)
    parser.add_argument("--cache", type=Path)
    arguments = parser.parse_args()
    runtime.init("cpu")
    studio = Studio(arguments.cache)
    taken_with = Rig(arguments.projector, arguments.camera, Optics(gamma=arguments.gamma))
    folder = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    spectra = {name: reflectance(name).round(5).tolist() for name in PAINTS}
    described = {"wavelengths_nm": WAVELENGTHS.tolist(), "reflectance": spectra}
    (folder / "spectra.json").write_text(json.dumps(described) + "\n", encoding="utf-8")
    studio.calibration(taken_with).write(folder / f"calibration_{arguments.projector.lower()}.json")
    for name in arguments.scene or scenes():
        np.savez_compressed(folder / f"{name}_truth.npz", **vars(studio.truth(name)))
        (folder / f"{name}_surfaces.json").write_text(json.dumps(scenes()[name].surfaces) + "\n", encoding="utf-8")
        for pattern in arguments.patterns:
            for sensor in (Sensor(), noise_free(Sensor())):
                levels = studio.frame(name, pattern, sensor, taken_with)
                cv2.imwrite(str(folder / f"{name}_{pattern}_{sensor.bits}.png"), levels[..., ::-1])
        print(name, flush=True)


if __name__ == "__main__":
    main()
