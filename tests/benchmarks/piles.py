"""The study of orders on piles of objects: how many pixels are absolute, and how many are wrong without a flag.

Small and large objects before a wall, under the coded pattern; and, under the plain one, plates that touch the wall at
a step of whole cycles: there a pixel is wrong whose order is not that of most of its region. Pixels within 2 px of
another surface and those in the dark are not judged.

python tests/benchmarks/piles.py [--frames 20] [--seed 1] [--arch cpu]
"""

import argparse
import warnings

import _tests_path  # noqa: F401 - puts support on the path
import cv2
import numpy as np
import numpy.typing as npt
from support.piled_objects import piled_objects

from pipeline import DecodedFrame, Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.simulation import TYPICAL_CROSSTALK, SimulatedFrame
from tikernels import runtime

KINDS = {
    "ten small, gamma 1": {"objects": 10, "cycles": (5, 8), "gamma": 1.0},
    "ten small, gamma 2": {"objects": 10, "cycles": (5, 8), "gamma": 2.0},
    "four large, gamma 2": {"objects": 4, "cycles": (10, 20), "gamma": 2.0},
    "four large, painted": {"objects": 4, "cycles": (10, 20), "gamma": 2.0, "painted": True},
    "five touching, painted": {"objects": 5, "cycles": (6, 14), "gamma": 2.0, "painted": True, "touching": True},
    "five touching, painted, plain pattern": {
        "objects": 5,
        "cycles": (6, 14),
        "gamma": 2.0,
        "painted": True,
        "touching": True,
        "code": None,
    },
}


def main() -> None:
    """Print one row a kind of pile."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arch", default="cpu")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    runtime.init(options.arch)
    warnings.simplefilter("ignore", DecodeWarning)  # the table says how much is flagged
    print("| pile | decoded | absolute and right | wrong, not flagged | worst frame | frames above .0005 |")
    print("|---|---|---|---|---|---|")
    for name, kind in KINDS.items():
        shares = np.array([study(kind, seed) for seed in range(options.seed, options.seed + options.frames)])
        decoded, right, wrong = shares.mean(axis=0)
        worst, many = shares[:, 2].max(), np.count_nonzero(shares[:, 2] > 0.0005)
        print(f"| {name} | {decoded:.4f} | {right:.4f} | {wrong:.5f} | {worst:.4f} | {many} |", flush=True)


def study(kind: dict, seed: int) -> tuple[float, float, float]:
    """Decode one pile, and return which shares of it are decoded, right, and wrong without a flag."""
    truth, which = piled_objects(seed, **kind)
    calibration = truth.rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    frame = Decoder(DecodeSettings(), calibration, arch=runtime.started()).decode(truth.image)
    square, number = np.ones((5, 5)), which.astype(np.float32)
    judged = truth.mask & (cv2.dilate(number, square) == cv2.erode(number, square))
    judged &= cv2.blur(truth.image.mean(axis=2), (1, 25)) > 20
    decoded, right, wrong = (
        orders_of_regions(frame, truth, judged)
        if truth.rig.pattern.code is None
        else (orders_of_pixels(frame, truth, judged))
    )
    return tuple(float(np.count_nonzero(part) / np.count_nonzero(judged)) for part in (decoded, right, wrong))


def cycles_off(frame: DecodedFrame, truth: SimulatedFrame) -> npt.NDArray[np.int64]:
    """Return (H, W) by how many cycles the orders are off."""
    return np.rint((np.nan_to_num(frame.unwrapped_phase) - truth.phase) / (2 * np.pi)).astype(np.int64)


def orders_of_pixels(frame: DecodedFrame, truth: SimulatedFrame, judged: npt.NDArray[np.bool_]) -> tuple:
    """Return which pixels are decoded, absolute and right, and absolute and wrong."""
    off = cycles_off(frame, truth)
    absolute = frame.mask & frame.absolute & judged
    return frame.mask & judged, absolute & (off == 0), absolute & (off != 0)


def orders_of_regions(frame: DecodedFrame, truth: SimulatedFrame, judged: npt.NDArray[np.bool_]) -> tuple:
    """Return which pixels are decoded, have the order of most of their region, and have another one."""
    off, decoded = cycles_off(frame, truth), frame.mask & judged
    wrong = np.zeros(decoded.shape, np.bool_)
    for region in range(1, int(frame.region.max()) + 1):
        inside = decoded & (frame.region == region)
        if inside.any():
            values, counts = np.unique(off[inside], return_counts=True)
            wrong |= inside & (off != values[counts.argmax()])
    return decoded, decoded & ~wrong, wrong


if __name__ == "__main__":
    main()
