"""What meshes of simulated scenes are worth, against the surfaces they were made from.

python tests/benchmarks/surface_quality.py [--rendered FOLDER]

Each scene is lit, photographed and decoded as in `colorphase demo`, and meshed as it is and smoothed. Of the
vertices that were measured: which share lies within three of their standard deviations of the true surface, and which
beyond six; of the lit pixels, which share are vertices; how many triangles join what lies 5 mm or more apart; which
share of the rims lies within 1.5 px of an edge of what is lit and seen; and how far depth and normals are off. Vertices
that were filled, or have moved to a rim, are counted apart. Under a plain pattern a frame before, of the coded one,
tells the orders. `--rendered` adds frames that another renderer made, if there is such a folder: calibration.json, and
NAME_coded.png with NAME_truth.npz (depth_mm, lit). Last what meshing takes, in ms.
"""

import argparse
import time
import warnings
from pathlib import Path

import _tests_path  # noqa: F401 - puts support on the path
import cv2
import numpy as np
from support.mesh_truth import MeshQuality, judge_mesh

from pipeline import Calibration, Decoder
from pipeline.decoding.frame import DecodedFrame
from pipeline.output.surface_mesh import MeshOptions, frame_mesh
from pipeline.simulation import SimulatedFrame, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

# Scene, seed, size, code.
CASES = [
    ("bust", 0, (640, 480), "contrast"),
    ("bust", 1, (640, 480), "contrast"),
    ("bust", 2, (640, 480), "contrast"),
    ("ball", 0, (640, 480), "contrast"),
    ("waves", 0, (640, 480), "contrast"),
    ("objects", 0, (640, 480), "contrast"),
    ("plane", 0, (640, 480), "contrast"),
    ("bust", 0, (320, 240), "contrast"),
    ("bust", 0, (640, 480), None),
    ("objects", 0, (640, 480), None),
]
HEAD = (
    "| scene | vertices | filled | within 3 | beyond 6 | filled within 3 | at rims within 3 | lit | across steps | "
    "rims | median mm | RMS mm | normals deg | at rims deg |\n" + "|---" * 14 + "|"
)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rendered", type=Path)
    rendered = parser.parse_args().rendered
    warnings.simplefilter("ignore")
    runtime.init("cpu")
    for smoothed in (False, True):
        print(f"\n{'smoothed' if smoothed else 'as measured'}\n\n{HEAD}")
        for case in CASES:
            truth, frame = decoded(*case)
            quality = judge_mesh(
                frame_mesh(frame, MeshOptions(smoothed=smoothed)), truth.points[..., 2], truth.mask, truth.rig.camera
            )
            scene, seed, size, code = case
            show(f"{scene} {seed}, {size[0]}x{size[1]}, {'coded' if code else 'plain'}", quality)
        if rendered is not None:
            for name in ("face", "plane"):
                show_rendered(rendered, name, smoothed)
    frame = decoded(*CASES[0])[1]
    took = []
    for _ in range(6):
        start = time.perf_counter()
        frame_mesh(frame)
        took.append(time.perf_counter() - start)
    print(f"\nmeshing 640x480 takes {1000 * min(took[1:]):.0f} to {1000 * max(took[1:]):.0f} ms")


def decoded(scene: str, seed: int, size_px: tuple[int, int], code: str | None) -> tuple[SimulatedFrame, DecodedFrame]:
    """Return a simulated frame and what is decoded of it."""
    settings = SimulationSettings(scene=scene, pixel_rays=3, projector_blur_px=(0.6, 0.6, 0.6), seed=seed)
    # Half the pixels a side see a pattern of twice the period as finely.
    period_px = 2 * 768 / 44 * 640 / size_px[0] / 2
    previous = None if code is not None else decoded(scene, seed, size_px, "contrast")[1]
    truth = simulate_frame(simulated_rig(size_px, code=code, period_px=period_px), settings)
    known = truth.rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})
    return truth, Decoder(calibration=known, arch="cpu").decode(truth.image, previous=previous)


def show_rendered(folder: Path, name: str, smoothed: bool) -> None:
    """Judge a frame that another renderer made."""
    calibration = Calibration.read(folder / "calibration.json")
    pattern = calibration.pattern.model_copy(update={"code": "contrast", "compensated": False})
    calibration = calibration.model_copy(update={"pattern": pattern, "capture": None})
    image = np.ascontiguousarray(cv2.imread(str(folder / f"{name}_coded.png"), cv2.IMREAD_UNCHANGED)[..., ::-1])
    truth = np.load(folder / f"{name}_truth.npz")
    frame = Decoder(calibration=calibration, arch="cpu").decode(image)
    mesh = frame_mesh(frame, MeshOptions(smoothed=smoothed))
    show(f"rendered {name}", judge_mesh(mesh, truth["depth_mm"], truth["lit"], calibration.camera))


def show(name: str, found: MeshQuality) -> None:
    """Print a row."""
    print(
        f"| {name} | {found.vertices} | {found.filled} | {found.within_three:.2%} | {found.beyond_six:.1e} | "
        f"{found.filled_within_three:.0%} | {found.rim_within_three:.1%} | {found.complete:.1%} | "
        f"{found.across_steps} | {found.rims:.1%} | {found.depth_median_mm:.3f} | {found.depth_rms_mm:.3f} | "
        f"{found.normal_deg:.2f} | {found.rim_normal_deg:.1f} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
