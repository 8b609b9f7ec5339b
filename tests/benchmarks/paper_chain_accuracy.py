"""What every step beyond the paper of 2004 buys: its chain and the decoder, step by step on the same frames.

python tests/benchmarks/paper_chain_accuracy.py [--arch cpu] [--rounds 30]

The frames are those of accuracy.py. A step's phase error is the RMS of what it leaves, one constant removed, over the
lit pixels that it gives a phase; the ratio is to the information limit of the same pixels; and its time is the least of
many alternating calls. docs/accuracy.md and docs/studies.md have the tables.
"""

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import FrameType
from typing import Any

import _tests_path  # noqa: F401 - puts support on the path
import cv2
import numpy as np
import numpy.typing as npt
from moving_scenes import surfaces
from support.best_times import best_ms
from support.phase_limit import phase_limit

import tikernels
from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.output.report import measure_against_truth
from pipeline.simulation import SKIN, WHITE, SimulatedFrame, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.phase import measure_frame
from tikernels.phase.balance_window import SIGMA_ACROSS, SIGMA_ALONG
from tikernels.phase.equalization import correction_table

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

SCENES = ("bust", "plane", "waves", "objects", "ball")
SURFACES = (("skin, gamma 2", 2.0, SKIN), ("white, gamma 1", 1.0, WHITE))
# The paper's window of the balance, px; of its pictures a cycle has 12 px, as here.
_BOX_PX = 25
# Darker pixels are not looked at, as a share of full scale.
_MIN_INTENSITY = 0.05
# Bins of the phase's histogram, and tiles of the picture both ways.
_BINS, _TILES = 256, 6


@dataclass(frozen=True)
class Unwrapped:
    """As much of a decoded frame as `measure_against_truth` looks at."""

    unwrapped_phase: npt.NDArray[np.float32]  # (H, W) rad
    mask: Mask  # (H, W)
    region: npt.NDArray[np.int32]  # (H, W) true surfaces, which the paper's chain does not tell apart
    points: None = None


@dataclass(frozen=True)
class Scene:
    """A simulated frame, and what a step is given of it."""

    name: str
    surface: str
    truth: SimulatedFrame
    calibration: Calibration
    limit: npt.NDArray[np.float64]  # (H, W) rad
    period_px: float
    light: Image  # (H, W, 3) linear light, 0..1
    mask: Mask  # (H, W) bright enough


def simulated(name: str, surface: str, gamma: float, color: tuple[float, float, float]) -> Scene:
    """Return one of the frames of accuracy.py."""
    settings = SimulationSettings.model_validate({"scene": name, "gamma": gamma, "reflectance": color})
    rig = simulated_rig()
    truth = simulate_frame(rig, settings)
    light = (truth.image / 255).astype(np.float32)
    period_px = measure_frame(truth.image).period_px
    if period_px is None:
        raise RuntimeError(f"no fringe stands out of {name}")
    calibration = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})
    mask = light.mean(axis=2) > _MIN_INTENSITY
    return Scene(name, surface, truth, calibration, phase_limit(truth, settings), period_px, light, mask)


def window_mean(light: Image, mask: Mask, blur: Callable[[Image], Image]) -> Image:
    """Return the mean colour of the masked pixels in a window around each, (H, W, 3)."""
    weight = mask.astype(np.float32)
    total = np.maximum(blur(weight), np.float32(1e-6))
    return np.asarray(blur(light * weight[..., None]) / total[..., None])


def balance(light: Image, mask: Mask, blur: Callable[[Image], Image]) -> Image:
    """Divide every channel by its mean in a window (section 3.1)."""
    return np.asarray(light / np.maximum(window_mean(light, mask, blur), np.float32(1e-6)))


def box(image: Image) -> Image:
    """Return the mean over the paper's window."""
    return np.asarray(cv2.blur(image, (_BOX_PX, _BOX_PX), borderType=cv2.BORDER_CONSTANT))


def smooth_window(image: Image, period_px: float) -> Image:
    """Return the mean over the decoder's window, a Gaussian of about a cycle."""
    deviations = {"sigmaX": SIGMA_ALONG * period_px, "sigmaY": SIGMA_ACROSS * period_px}
    return np.asarray(cv2.GaussianBlur(image, (0, 0), **deviations, borderType=cv2.BORDER_CONSTANT))


def arctangent(light: Image) -> Image:
    """Return the wrapped phase."""
    return np.asarray(tikernels.compute_wrapped_phase(light)[0])


def equalize_by_tiles(phase: Image, mask: Mask, period_px: float) -> Image:
    """Equalise by what the histograms of the picture's tiles have in common, as the decoder does."""
    height, width = phase.shape
    rows = np.arange(height)[:, None] * _TILES // height
    tile = rows * _TILES + np.arange(width) * _TILES // width
    place = np.clip((phase[mask] + np.pi) * (_BINS / (2 * np.pi)), 0, _BINS - 1).astype(np.int64)
    counts = np.bincount(tile[mask] * _BINS + place, minlength=_TILES**2 * _BINS).reshape(-1, _BINS)
    table = correction_table(counts, int(0.8 * period_px))
    return np.asarray(phase + np.interp(phase, np.linspace(-np.pi, np.pi, _BINS + 1), table), np.float32)


Steps = dict[str, Callable[[], Any]]
SMOOTHED, FITTED, DECODED = (
    "the paper's chain, smoothed",
    "fit of every pixel: the decoder, unsmoothed",
    "smoothing over 7 x 7 px: the decoder",
)


def paper_steps(scene: Scene) -> tuple[dict[str, Image], Steps]:
    """Return the wrapped phase after each step of the paper and beyond it, and each step's own work."""
    light, mask, matrix = scene.light, scene.mask, scene.calibration.crosstalk_matrix
    normalized = matrix / matrix.sum(axis=1, keepdims=True)
    gaussian = partial(smooth_window, period_px=scene.period_px)
    phases, work = {}, {}

    def step(name: str, body: Callable[[], Image], phase: Callable[[Image], Image] = arctangent) -> Image:
        result = body()
        phases[name], work[name] = phase(result), body
        return result

    def keep(phase: Image) -> Image:
        return phase

    step("plain arctangent", lambda: arctangent(light), keep)
    corrected = step("crosstalk undone", lambda: tikernels.correct_crosstalk(light, matrix))
    balanced = step("balance, 25x25 box (OpenCV)", lambda: balance(corrected, mask, box))
    bent = arctangent(balanced)
    flat = step("equalisation: the paper's chain", lambda: tikernels.equalize_phase(bent, mask), keep)
    step(SMOOTHED, lambda: tikernels.smooth_phase(flat, mask), keep)

    def equalized(image: Image) -> Image:
        return np.asarray(tikernels.equalize_phase(arctangent(image), mask))

    def undone(image: Image) -> Image:
        return np.asarray(tikernels.correct_crosstalk(image, normalized))

    step("balance before the crosstalk (OpenCV)", lambda: undone(balance(light, mask, box)), equalized)
    step("a smooth window (OpenCV)", lambda: undone(balance(light, mask, gaussian)), equalized)
    aware = step(
        "a second look that knows the phase",
        lambda: undone(tikernels.balance_color(light, scene.period_px, mask, crosstalk_matrix=matrix)),
        equalized,
    )
    bare = arctangent(aware)
    step("equalisation by tiles of the picture (NumPy)", lambda: equalize_by_tiles(bare, mask, scene.period_px), keep)
    return phases, work


def decoders(scene: Scene) -> dict[str, Decoder]:
    """Return the decoder as far as the fit of every pixel, and as it is."""
    return {
        FITTED: Decoder(DecodeSettings(smoothing_px=0), scene.calibration),
        DECODED: Decoder(DecodeSettings(), scene.calibration),
    }


def measured(scene: Scene, phase: Image, mask: Mask) -> tuple[float, float, float, float]:
    """Return phase error and constant (rad), the ratio to the information limit, and the coverage."""
    found = measure_against_truth(Unwrapped(phase, mask, surfaces(scene.truth, scene.mask)), scene.truth)
    square = np.ones((9, 9), np.uint8)
    inside = cv2.erode(scene.truth.mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    lit = (inside != 0) & (scene.truth.image.mean(axis=2) > 20) & mask
    limit = float(np.sqrt((scene.limit[lit] ** 2).mean()))
    return found["phase_rms_rad"], found["phase_constant_rad"], found["phase_rms_rad"] / limit, found["coverage"]


def print_phases(scenes: list[Scene], rounds: int) -> None:
    """Print the table of phase errors: one row a step, least and largest over the scenes of a surface, and its time."""
    rows: dict[str, dict[str, list[tuple[float, float, float, float]]]] = defaultdict(lambda: defaultdict(list))
    for scene in scenes:
        phases, work = paper_steps(scene)
        for name, phase in phases.items():
            rows[name][scene.surface].append(measured(scene, phase, scene.mask))
        for name, decoder in decoders(scene).items():
            frame = decoder.decode(scene.truth.image)
            rows[name][scene.surface].append(measured(scene, frame.wrapped_phase, frame.mask))
            if scene is scenes[0]:
                work[name] = partial(decoder.decode, scene.truth.image)
        if scene is scenes[0]:
            times = best_ms(work, rounds)
    heads = [f"{name}: {what}" for name, _, _ in SURFACES for what in ("error, rad", "of the limit", "constant, rad")]
    print(f"| step | {' | '.join(heads)} | coverage | ms |")
    print("|---" * (len(heads) + 3) + "|")
    for name, by_surface in rows.items():
        cells, least = [], 1.0
        for surface, _, _ in SURFACES:
            error, constant, ratio, coverage = np.array(by_surface[surface]).T
            cells += [f"{values.min():.{n}f} to {values.max():.{n}f}" for values, n in ((error, 3), (ratio, 2))]
            cells.append(f"{constant[np.abs(constant).argmax()]:+.3f}")
            least = min(least, coverage.min())
        print(f"| {name} | {' | '.join(cells)} | {least:.3f} | {times[name]:.1f} |")


def print_unwrapping(scenes: list[Scene], rounds: int) -> None:
    """Print wrong orders and coverage of each way to unwrap the same phase, and its time."""
    table: dict[str, list[str]] = defaultdict(list)
    for scene in scenes:
        phase = paper_steps(scene)[0][SMOOTHED]
        quality = np.asarray(tikernels.compute_wrapped_phase(scene.light)[1])
        whole = tikernels.unwrap_phase(phase, quality, scene.mask)
        work: Steps = {
            "votes": lambda p=phase, q=quality, s=scene: tikernels.unwrap_phase(p, q, s.mask),
            "votes, then the mean around (section 4.2)": lambda u=whole: tikernels.correct_fringe_order(
                u, np.isfinite(u)
            ),
        }
        for name, body in work.items():
            unwrapped = np.asarray(body())
            there = np.isfinite(unwrapped)
            found = measure_against_truth(Unwrapped(unwrapped, there, surfaces(scene.truth, there)), scene.truth)
            table[name].append(f"{found['wrong_orders']}, {found['coverage']:.3f}")
        frame = decoders(scene)[DECODED].decode(scene.truth.image)
        found = measure_against_truth(frame, scene.truth)
        table["the decoder"].append(f"{found['wrong_orders']}, {found['coverage']:.3f}")
        if scene is scenes[0]:
            times = best_ms(work, rounds)
    print(f"| wrong orders, coverage | {' | '.join(scene.name for scene in scenes)} | ms |")
    print("|---" * (len(scenes) + 2) + "|")
    for name, cells in table.items():
        print(f"| {name} | {' | '.join(cells)} | {f'{times[name]:.1f}' if name in times else ''} |")


def time_in_kernels(body: Callable[[], object]) -> dict[str, float]:
    """Return how long a call spends in each module of `tikernels`, ms; what one calls of another is the first one's."""
    spent: dict[str, float] = defaultdict(float)
    open_calls: list[tuple[FrameType, str, float]] = []

    def watch(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and not open_calls:
            module = str(frame.f_globals.get("__name__", ""))
            if module.startswith("tikernels."):
                open_calls.append((frame, module, time.perf_counter()))
        elif event == "return" and open_calls and open_calls[0][0] is frame:
            _, module, start = open_calls.pop()
            spent[module] += 1e3 * (time.perf_counter() - start)

    sys.setprofile(watch)
    try:
        body()
    finally:
        sys.setprofile(None)
    return spent


def print_decoder(scene: Scene, rounds: int) -> None:
    """Print how long the decoder spends in each module of `tikernels`, in the order in which it enters them."""
    decoder = decoders(scene)[DECODED]
    body = partial(decoder.decode, scene.truth.image)
    body()
    best: dict[str, float] = {}
    whole = np.inf
    for _ in range(rounds):
        whole = min(whole, best_ms({"": body}, 1)[""])
        for module, spent in time_in_kernels(body).items():
            best[module] = min(best.get(module, np.inf), spent)
    print("| the decoder's time in | ms |\n|---|---|")
    for module, spent in best.items():
        print(f"| `{module}` | {spent:.1f} |")
    print(f"| all of it, not watched | {whole:.1f} |")


def main() -> None:
    """Print the three tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arch", default="cpu")
    parser.add_argument("--rounds", type=int, default=30, help="calls of which the best time counts")
    options = parser.parse_args()
    runtime.init(options.arch)
    scenes = [simulated(scene, *surface) for surface in SURFACES for scene in SCENES]
    print_phases(scenes, options.rounds)
    for surface, _, _ in SURFACES:
        print(f"\n{surface}:\n")
        print_unwrapping([scene for scene in scenes if scene.surface == surface], options.rounds)
    print()
    print_decoder(scenes[0], options.rounds)


if __name__ == "__main__":
    main()
