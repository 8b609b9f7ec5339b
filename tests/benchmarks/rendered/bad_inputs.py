"""Light that no calibration foresees, before drawn rigs: how far a frame is off, and whether it says so.

Each row is one fault: the share of its pixels that are measured; the error of their phase, constant included; that over
sigma, the constant's included; and on how many rigs a warning names it. Medians over the rigs.

python tests/benchmarks/rendered/bad_inputs.py [--rigs 0-5] [--folder FOLDER]
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from drawn_figures import Mask, decode, deeper, phase_error
from drawn_frames import F32, Taken, kept, photographer_of
from drawn_rigs import rig_numbers

from tikernels import runtime

_SCENE = "light face"
# By how much of the blue that comes back a paint that fluoresces adds to red and green.
_FLUORESCES = (0.1, 0.16, 0.0)


def another_calibration(taken: Taken, seed: int) -> Taken:
    """Take the light of the next rig for this one's."""
    other = photographer_of(seed + 1).calibration
    known = {"crosstalk_matrix": other.crosstalk_matrix, "response": other.response}
    return replace(taken, measured=taken.measured.model_copy(update=known))


def fluorescent_paint(taken: Taken, seed: int) -> Taken:
    """Let the wall's paint send blue back as green and red."""
    wall = taken.truth.paint == taken.scene.names.index("wall")
    return with_light(taken, lambda light: light + wall[..., None] * light[..., 2:] * np.array(_FLUORESCES, np.float32))


def room_light(taken: Taken, seed: int) -> Taken:
    """Add the light of an orange lamp: half of the mean under the pattern to red, a fifth to green."""
    mean = taken.light["plain"].mean(axis=(0, 1)) * np.array([0.5, 0.2, 0.02], np.float32)
    return with_light(taken, lambda light: light + mean)


def lit_screen(taken: Taken, seed: int) -> Taken:
    """Hang a screen on the wall that shows a picture as bright as the wall."""
    at, picture = square(taken), colors_of(taken, seed, blur_px=12.0)
    level = 0.5 * float(taken.light["plain"][at].mean())
    return with_light(taken, lambda light: np.where(at[..., None], 0.3 * light + level * picture, light))


def printed_photograph(taken: Taken, seed: int) -> Taken:
    """Hang a print on the wall that has all colours, in spots of a cycle."""
    at, picture = square(taken), colors_of(taken, seed, blur_px=4.0)
    return with_light(taken, lambda light: np.where(at[..., None], light * picture, light))


def mirror(taken: Taken, seed: int) -> Taken:
    """Polish a part of the wall: three tenths of its light is the fringe of another place."""
    at = square(taken)
    return with_light(taken, lambda light: np.where(at[..., None], 0.7 * light + 0.3 * light[::-1, ::-1], light))


FAULTS: dict[str, tuple[Callable[[Taken, int], Taken], bool]] = {
    "another rig's calibration": (another_calibration, False),
    "paint that fluoresces": (fluorescent_paint, False),
    "coloured room light": (room_light, False),
    "a lit screen": (lit_screen, True),
    "a printed photograph": (printed_photograph, True),
    "a mirror": (mirror, True),
}


def with_light(taken: Taken, changed: Callable[[F32], F32]) -> Taken:
    """Return a scene whose light is changed, whatever the pattern."""
    return replace(taken, light={name: changed(light).astype(np.float32) for name, light in taken.light.items()})


def square(taken: Taken) -> Mask:
    """Return a corner of the picture, where the wall is, (H, W) bool."""
    height, width = taken.lit.shape
    at = np.zeros((height, width), bool)
    at[height // 16 : height // 16 + height // 4, width // 16 : width // 16 + width // 4] = True
    return at


def colors_of(taken: Taken, seed: int, blur_px: float) -> F32:
    """Return spots of all colours, (H, W, 3) 0.1..1."""
    noise = np.random.default_rng(seed).normal(size=(*taken.lit.shape, 3)).astype(np.float32)
    spots = cv2.GaussianBlur(noise, (0, 0), blur_px)
    return np.clip(0.5 + 0.25 * spots / spots.std(), 0.1, 1.0)


def main() -> None:
    """Print one row a fault."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", default="0-5")
    parser.add_argument("--folder", type=Path, required=True, help="where rendered frames are kept")
    options = parser.parse_args()
    runtime.init("cpu")
    print("| fault | measured | error, rad | over sigma | rigs that warn | of |\n|---|---|---|---|---|---|")
    for name, (fault, local) in FAULTS.items():
        rows = []
        for seed in rig_numbers(options.rigs):
            taken = kept(seed, _SCENE, options.folder)
            frame = decode(fault(taken, seed), "plain")
            here = deeper(taken.lit & (square(taken) if local else True), 4)
            there = here & frame.mask
            if not there.any():
                rows.append((0.0, np.nan, np.nan, len(frame.warnings) > 0))
                continue
            error = phase_error(frame, taken)[there]
            sigma = np.hypot(frame.phase_sigma[there], frame.constant_sigma)
            rms = np.sqrt(np.mean(error**2))
            rows.append((there.sum() / here.sum(), rms, rms / np.sqrt(np.mean(sigma**2)), len(frame.warnings) > 0))
            print(name, seed, np.round(rows[-1], 3), [w[:160] for w in frame.warnings], file=sys.stderr, flush=True)
        measured, rms, pull, _ = np.nanmedian(rows, axis=0)
        print(
            f"| {name} | {measured:.2f} | {rms:.3f} | {pull:.2f} | {sum(r[3] for r in rows)} | {len(rows)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
