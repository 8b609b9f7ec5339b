"""What smoothing leaves of noise, relief and steps, and how near it brings the phase to the information limit.

python tests/benchmarks/smoothing_study.py [--frames 6]

First of phases made for it, 12 px a cycle: what is left of the noise, of waves of 7.25 px (5 mm on the usual rig) along
the stripes and across them, and the error of the pixels at a step of 0.7 rad (5 mm). Then of decoded frames, skin at
gamma 2 with the projector's blur, more than 15 px from any step: the error's RMS over that of the pixels' bounds of
Cramer and Rao, brightness to be found, too. Last of piles of objects, coded, whose pixels average over their area: the
error's median size over that of the same pixels unsmoothed, more than 15 px from a step, and two and three px from one.
"""

import argparse
import warnings

import _tests_path  # noqa: F401 - puts support on the path
import cv2
import numpy as np
import numpy.typing as npt
import reference
from support.phase_limit import phase_limit
from support.piled_objects import piled_objects

from pipeline import Decoder, DecodeSettings
from pipeline.simulation import (
    SKIN,
    TYPICAL_CROSSTALK,
    SimulatedFrame,
    SimulationSettings,
    simulate_frame,
    simulated_rig,
)
from tikernels import runtime
from tikernels.phase.phase_change import measure_rates
from tikernels.phase.smoothing import Smoother

PAIRS, WAVE_PX, STEP_RAD = 3, 7.25, 0.7
SHAPE = (200, 240)
# Surfaces whose depths differ by more than this from pixel to pixel, mm, are two.
MM_STEP = 4.0

Array = npt.NDArray[np.floating]


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=6)
    frames = parser.parse_args().frames
    warnings.simplefilter("ignore")
    runtime.init("cpu")
    print("| noise, rad | left | waves of half a sigma | of five | step along: last pixels, rad | across |")
    print("|---|---|---|---|---|---|")
    for sigma in (0.03, 0.06, 0.1):
        print(synthetic_row(sigma), flush=True)
    print("\n| scene | unsmoothed | smoothed |\n|---|---|---|")
    for scene in ("plane", "waves", "ball"):
        settings = SimulationSettings(scene=scene, reflectance=SKIN, projector_blur_px=(0.6,) * 3)
        truth = simulate_frame(simulated_rig(), settings)
        limit = phase_limit(truth, settings, brightness_known=False)
        judged = ~near_step(truth.points[..., 2], MM_STEP, 15) & np.isfinite(limit)
        rms = [np.sqrt(np.mean(errors(truth, judged, px) ** 2)) for px in (0, 2 * PAIRS + 1)]
        ratios = rms / np.sqrt(np.mean(limit[judged] ** 2))
        print(f"| {scene} | {ratios[0]:.2f} | {ratios[1]:.2f} |", flush=True)
    sizes: dict[tuple[str, int], list[Array]] = {}
    for seed in range(1, frames + 1):
        truth, which = piled_objects(seed, objects=4, cycles=(10, 20), gamma=2.0)
        lit = truth.mask & (cv2.blur(truth.image.mean(axis=2), (1, 25)) > 20)
        places = {"inside": ~near_step(which, 0, 15), "beside": near_step(which, 0, 3) & ~near_step(which, 0, 1)}
        for px in (0, 2 * PAIRS + 1):
            for name, place in places.items():
                sizes.setdefault((name, px), []).append(np.abs(errors(truth, lit & place, px)))
    medians = {key: np.median(np.concatenate(found)) for key, found in sizes.items()}
    ratios = [medians[name, 2 * PAIRS + 1] / medians[name, 0] for name in ("inside", "beside")]
    print(f"\nPiles: {ratios[0]:.2f} inside, {ratios[1]:.2f} beside steps")


def synthetic_row(sigma: float) -> str:
    """Return a row of the first table."""
    flat = reference.ramp(*SHAPE, 12.0)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    left = smoothed(flat, sigma, 0)[8:-8, 8:-8].std() / sigma
    waves = []
    for amplitude in (0.5, 5.0):
        for place in (x, y):
            wave = np.cos(2 * np.pi / WAVE_PX * place)
            found = np.mean([smoothed(flat + amplitude * sigma * wave, sigma, k) for k in range(4)], axis=0)
            kept = 1 + 2 * np.mean((found * wave)[8:-8, 8:-8]) / (amplitude * sigma)
            waves.append(f"{kept:.2f}")
    steps = []
    for place in (x, y):
        errors = [smoothed(flat + STEP_RAD * (place >= 100), sigma, k) for k in range(4)]
        rms = np.sqrt(np.mean(np.square(errors)[:, 8:-8, 8:-8], axis=(0, 1) if place is x else (0, 2)))
        steps.append(" ".join(f"{rms[91 - k]:.3f}" for k in range(4)))
    return f"| {sigma} | {left:.3f} | {waves[0]}, {waves[1]} | {waves[2]}, {waves[3]} | {steps[0]} | {steps[1]} |"


def smoothed(true: Array, sigma: float, seed: int) -> Array:
    """Return the error (rad) that is left of a phase with noise."""
    noise = sigma * np.random.default_rng(seed).standard_normal(true.shape)
    phase = reference.wrapped(true + noise).astype(np.float32)
    precision = np.full(true.shape, sigma**-2, np.float32)
    smoother, rates = Smoother(*true.shape, PAIRS), measure_rates(phase, precision)
    rows = runtime.to_host(smoother.along(phase, precision, rates)).copy()
    held = rows < 50  # the rest is between two surfaces
    found, _ = smoother.across(rows, held.astype(np.uint8), rates, wraps=True)
    return reference.wrapped_difference(np.where(held, runtime.to_host(found), phase), true)


def near_step(surface: Array, step: float, px: int) -> npt.NDArray[np.bool_]:
    """Return where, at most this far away, a number differs by more than a step; or is none."""
    square, values = np.ones((2 * px + 1,) * 2), surface.astype(np.float32)
    steps = [np.abs(np.diff(values, axis=axis, prepend=values.take([0], axis=axis))) <= step for axis in (0, 1)]
    return cv2.erode((steps[0] & steps[1]).astype(np.uint8), square) == 0


def errors(truth: SimulatedFrame, judged: npt.NDArray[np.bool_], smoothing_px: int) -> Array:
    """Return the decoded phase's errors, rad, one constant removed."""
    calibration = truth.rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    found = Decoder(DecodeSettings(smoothing_px=smoothing_px), calibration, arch="cpu").decode(truth.image)
    error = reference.wrapped_difference(found.wrapped_phase, truth.phase)[judged & found.mask]
    return error - np.median(error)


if __name__ == "__main__":
    main()
