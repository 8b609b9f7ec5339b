"""Does `colorphase expose` name what is wrong? Simulated rigs with one to three faults, and rigs without.

python tests/benchmarks/exposure_faults.py [FIRST_SEED [RIGS [PROCESSES]]]

A row for each fault: the rigs that have it, those of them on which it is named, and the others on which it is named.
Then the rigs on which every fault is named, and the rigs without faults on which one is named; and how far times of
colours and rows are off on those, compared with the uncertainty that is stated. A rig is drawn from its seed: gamma,
crosstalk, noise, refresh rate, the way in which colours are lit, their order, lengths and gaps, the time from row to
row, how exact the times of frames are, the camera's curve (linear or sRGB), brightness, and whether a sheet or a board
is before it. Faults that hide each other are not drawn together (`HIDING`).
"""

import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.acquisition.exposure import ExposureFinder, ExposureReport
from pipeline.acquisition.light_fields import MeasuredFields
from pipeline.acquisition.simulated_camera import CameraFaults
from pipeline.acquisition.simulated_studio import SimulatedStudio, StudioFaults
from pipeline.calibration.board import Board
from pipeline.calibration.simulated_board import CaptureLight
from pipeline.simulation import DEFAULT_PERIOD_PX, TYPICAL_CROSSTALK, simulated_rig

#: A camera of fewer pixels than usual, which takes less time.
TRUTH = simulated_rig(
    (400, 300),
    camera_distortion=(-0.12, 0.08, 0.001, -0.0008, 0.0),
    projector_distortion=(-0.06, 0.05, -0.001, 0.0005, 0.0),
    code="contrast",
)
BOARD = Board(kind="charuco", squares=(10, 7), square_mm=45.0)
FAULTS = (
    "too dark",
    "too bright",
    "exposure off the cycle",
    "automatic exposure",
    "automatic white balance",
    "tone curve",
    "black clipped",
    "sharpening",
    "compression",
    "chroma subsampling",
    "room light",
    "focus",
    "swapped colours",
    "mirrored picture",
    "resampled picture",
)
#: The names of what room light does.
ROOM_LIGHT = {"flickering room light", "bright black"}
#: Automatic exposure sets the brightness itself; an S-curve makes black darker; a tone curve needs single pixels.
HIDING = (
    {"automatic exposure", "too dark"},
    {"automatic exposure", "too bright"},
    {"too dark", "too bright"},
    {"tone curve", "black clipped"},
    {"tone curve", "resampled picture"},
)


@dataclass(frozen=True)
class DrawnRig:
    """A simulated rig."""

    faults: frozenset[str]
    exposure_s: float
    light: CaptureLight
    studio: StudioFaults
    board: Board | None

    def open(self, seed: int) -> SimulatedStudio:
        """Return the rig, ready."""
        return SimulatedStudio(
            self.board, self.exposure_s, truth=TRUTH, light=self.light, faults=self.studio, seed=seed
        )


def draw_faults(rng: np.random.Generator) -> frozenset[str]:
    """Return one to three faults that do not hide each other."""
    while True:
        drawn = frozenset(rng.choice(FAULTS, rng.integers(1, 4), replace=False).tolist())
        if not any(pair <= drawn for pair in HIDING):
            return drawn


def draw_rig(seed: int, faults: frozenset[str] | None = None) -> DrawnRig:
    """Return a rig with faults; None: one to three."""
    rng = np.random.default_rng([seed, 2004])
    faults = draw_faults(rng) if faults is None else faults
    crosstalk = np.array(TYPICAL_CROSSTALK) * rng.uniform(0.8, 1.2, (3, 3))
    crosstalk *= 1.03 / crosstalk.sum(axis=1, keepdims=True)
    light = CaptureLight(
        gamma=rng.uniform(1.8, 2.4), crosstalk=crosstalk, blur_px=rng.uniform(0.3, 0.6), noise=rng.uniform(1, 2.5)
    )
    kinds = ("turns", "turns", "at once") if "exposure off the cycle" in faults else ("turns", "at once", "constant")
    kind = rng.choice(kinds)
    cycle_s = 1 / rng.uniform(50, 120) / (rng.choice([1, 2, 4]) if kind == "turns" else 1)
    cycles = max(1, round(rng.uniform(1 / 100, 1 / 40) / cycle_s))
    if "exposure off the cycle" in faults:
        cycles += rng.uniform(0.2, 0.5) * rng.choice([-1, 1])
    exposure_s = float(min(cycles * cycle_s, 1 / 31))
    brightness = rng.uniform(0.5, 0.95)
    if "too dark" in faults:
        brightness = rng.uniform(0.12, 0.28)
    if "too bright" in faults:
        brightness = rng.uniform(1.5, 2.5)
    studio: dict[str, Any] = {
        "colour_cycle_s": None if kind == "constant" else float(cycle_s),
        "at_once": kind == "at once",
        "light": brightness,
        "mirrored": "mirrored picture" in faults,
        "swapped": "swapped colours" in faults,
    }
    if "resampled picture" in faults:
        studio |= {"scale": rng.uniform(0.85, 0.97)} if rng.random() < 0.5 else {"keystone": rng.uniform(0.05, 0.15)}
    if "room light" in faults:
        turns = np.pi * 100 * exposure_s
        flickers = 0.6 * abs(np.sin(turns)) / turns / np.sqrt(2)  # of its own mean
        studio["room"] = float(min(rng.uniform(0.02, 0.04) * min(brightness, 1) / max(flickers, 1e-3), 0.3))
        if flickers * studio["room"] < 0.015 * brightness:
            studio["room"] = 0.45 * min(brightness, 1)  # it does not flicker at this exposure, so it is bright
    camera = draw_camera(rng, faults)
    if "focus" in faults:
        if rng.random() < 0.5:
            studio["focus_px"] = rng.uniform(4, 7)
        else:
            camera = replace(camera, blur_px=rng.uniform(1.7, 3))
    studio |= draw_times(np.random.default_rng([seed, 2005]))
    board = BOARD if rng.random() < 0.35 else None
    return DrawnRig(faults, exposure_s, light, StudioFaults(**studio, camera=camera), board)


def draw_times(rng: np.random.Generator) -> dict[str, Any]:
    """Return when colours are on, and times of rows and frames."""
    lengths = rng.uniform(0.2, 0.34, 3)
    gaps = rng.dirichlet(np.ones(3)) * (1 - lengths.sum()) * rng.choice([0, 1])
    lengths *= (1 - gaps.sum()) / lengths.sum()
    on = np.cumsum(np.append(0, (lengths + gaps)[:2]))
    shown = np.stack([on, on + lengths], axis=1)[rng.permutation(3)]
    row_s = rng.uniform(5e-6, 7e-5) * rng.choice([0, 1])
    return {"shown": shown, "row_s": float(row_s), "jitter_s": float(rng.choice([1e-6, 2e-4]))}


def draw_camera(rng: np.random.Generator, faults: frozenset[str]) -> CameraFaults:
    """Return a camera with those of the faults that are its own."""
    return CameraFaults(
        auto_exposure="automatic exposure" in faults,
        auto_white_balance="automatic white balance" in faults,
        curve="s" if "tone curve" in faults else "srgb" if rng.random() < 0.3 else "linear",
        curve_strength=rng.uniform(0.6, 1.0),
        sharpening=rng.uniform(0.4, 1.2) if "sharpening" in faults else 0.0,
        jpeg_quality=int(rng.integers(70, 86)) if "compression" in faults else None,
        chroma=str(rng.choice(["replicated", "interpolated"])) if "chroma subsampling" in faults else None,
        black_levels=-rng.uniform(8, 14) if "black clipped" in faults else rng.uniform(5, 8),
    )


def errors_of(found: ExposureReport, rig: StudioFaults) -> tuple[float, ...] | None:
    """Return the errors of the cycle (part), of edges and rows (s), and uncertainties of these; None: not measured."""
    fields, cycle_s, shown = found.fields, rig.colour_cycle_s, rig.shown
    if not isinstance(fields, MeasuredFields) or fields.doubt is not None or cycle_s is None or shown is None:
        return None
    edges = fields.shown_s / cycle_s - (shown - shown[0, 0])
    edge_s = cycle_s * float(np.abs(edges - np.rint(edges)).max())
    row_s = abs(fields.row_s - rig.row_s)
    return abs(fields.period_s / cycle_s - 1), edge_s, row_s, fields.shown_sigma_s, fields.row_sigma_s


def named_on(seed: int, faulty: bool) -> tuple[frozenset[str], list[str], str, bool, tuple[float, ...] | None]:
    """Return the faults of a rig, those named, what else there is to see, whether colours come in turn, and errors."""
    rig = draw_rig(seed, None if faulty else frozenset())
    finder = ExposureFinder(rig.open(seed), rig.exposure_s, 0.0, DEFAULT_PERIOD_PX, 0)
    found = finder.find()
    cycle_s = rig.studio.colour_cycle_s
    off = "no cycle" if cycle_s is None or found.cycle is None else f"{found.cycle.period_s / cycle_s - 1:+.1e}"
    detail = f"{off} of {cycle_s and 1 / cycle_s:.5} Hz" if cycle_s else off
    seen = f"cycle {detail}, {found.transfer} ({rig.studio.camera.curve}), level {found.level:.2f}"
    words = "; ".join(f"{fault.key} {fault.cost_rad:.3f}" for fault in found.faults)
    keys = ["room light" if fault.key in ROOM_LIGHT else fault.key for fault in found.faults]
    in_turns = found.cycle is not None and found.cycle.in_turns
    right = in_turns == (cycle_s is not None and not rig.studio.at_once)
    errors = errors_of(found, rig.studio) if in_turns else None
    times = "" if errors is None else "; cycle {:.1e}, edges {:.1e} s, rows {:.1e} s; {:.1e}, {:.1e} s".format(*errors)
    doubt = found.fields.doubt if in_turns and isinstance(found.fields, MeasuredFields) else found.fields
    return rig.faults, keys, f"{seen}; {words}{times}" + (f"; {doubt}" if isinstance(doubt, str) else ""), right, errors


def main(first_seed: int = 100, rigs: int = 30, processes: int = 1) -> None:
    """Print the table."""
    seeds = range(first_seed, first_seed + rigs)
    jobs = [(seed, faulty) for faulty in (True, False) for seed in seeds]
    present, named, besides, complete, alarms = Counter[str](), Counter[str](), Counter[str](), 0, 0
    right, measured = 0, []
    with ProcessPoolExecutor(processes) as pool:
        for (seed, faulty), (faults, found, seen, kind, errors) in zip(
            jobs, pool.map(named_on, *zip(*jobs, strict=True)), strict=True
        ):
            missed, more = faults - set(found), set(found) - faults
            complete += faulty and not missed
            alarms += not faulty and bool(found)
            right += not faulty and kind
            measured += [errors] if errors is not None and not faulty else []
            present.update(faults)
            named.update(faults & set(found))
            besides.update(more)
            mark = "" if not missed and not more else f"  MISSED {sorted(missed)} BESIDES {sorted(more)}"
            print(f"{seed} {'faulty' if faulty else 'clean '} {sorted(faults)}{mark}\n      {seen}", flush=True)
    print(f"\n{'fault':<26}{'present':>8}{'named':>8}{'besides':>9}")
    for fault in sorted({*FAULTS, *besides}):
        print(f"{fault:<26}{present[fault]:>8}{named[fault]:>8}{besides[fault]:>9}")
    print(f"every fault is named on {complete} of {rigs} rigs; of {rigs} without, something is named on {alarms}")
    print(
        f"of these {right} are rightly named as showing colours in turn or at once; times are found on {len(measured)}"
    )
    if measured:
        cycle, edges_s, rows_s, edge_sigma_s, row_sigma_s = np.array(measured).T
        for name, errors_s, sigma_s in (("edges", edges_s, edge_sigma_s), ("rows", rows_s, row_sigma_s)):
            off = 1e6 * np.percentile(errors_s, (50, 100))
            inside = (errors_s < 2 * sigma_s).mean()
            print(f"{name}: median {off[0]:.3f}, worst {off[1]:.3f} us; within 2 sigma {inside:.0%}")
        print(f"cycle: worst {cycle.max():.1e}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
