"""Decode frames of drawn rigs, judge them against what is true, and put the figures of all rigs into one table.

Each rig is calibrated by its own ramps (`colorphase calibrate radiometry`); its geometry is the true one. A pixel is
lit if the true amplitude of its fringe, the mean of the channels, is 8 of 255 levels or more. Phases are judged there,
4 px inside the lit area and inside surfaces that hold 2000 such pixels. "Clean" frames have 16 bits and no noise.
"""

import json
import os
import tempfile
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from drawn_frames import PATTERNS, Taken, kept, sensed
from drawn_rigs import DrawnRig
from drawn_scenes import SCENES
from ray_caster import NOTHING

from pipeline import Calibration, DecodedFrame, Decoder, DecodeSettings
from pipeline.calibration.model import choose_pattern
from pipeline.decoding.footage_light import with_transfer_of
from pipeline.errors import DecodeWarning
from pipeline.footage.opening import open_footage
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat

_RIM_PX, _LEAST_PX = 4, 2000
Mask = npt.NDArray[np.bool_]


def deeper(mask: Mask, px: float) -> Mask:
    """Return where a mask is further than a number of pixels from where it is not; the image's edge does not count."""
    return cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) > px


def calibration_for(measured: Calibration, pattern: str) -> Calibration:
    """Return a rig's, with what is known of the pattern."""
    code, compensated = PATTERNS[pattern]
    known = choose_pattern(measured, None, None, code).model_copy(update={"compensated": compensated})
    return measured.model_copy(update={"capture": None, "pattern": known})


def decode(taken: Taken, pattern: str, noise: bool = True, known: bool = True) -> DecodedFrame:
    """Return a frame of a pattern, decoded."""
    rig = taken.rig
    levels = sensed(rig, taken.light[pattern], taken.exposure, taken.seed if noise else None)
    calibration: Calibration | None = calibration_for(taken.measured, pattern) if known else None
    settings = DecodeSettings(
        stripes=rig.calibration.pattern.stripes,
        **({} if known else {"code": PATTERNS[pattern][0]}),
    )
    image, settings = delivered(rig, levels, settings, calibration) if noise else (levels, settings)
    decoder = Decoder(settings, calibration, arch="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecodeWarning)
        return decoder.decode(image)


def delivered(
    rig: DrawnRig, levels: npt.NDArray[Any], settings: DecodeSettings, calibration: Calibration | None
) -> tuple[Any, DecodeSettings]:
    """Return what a decoder is given of what the sensor says, and with which settings."""
    if rig.delivery in ("jpeg", "mjpeg"):
        return _by_file(rig, levels, settings, calibration)
    if rig.delivery == "bayer":
        return develop((levels,), PixelFormat("bayer", rig.bits, bayer="rggb"), stripes=settings.stripes), settings
    if rig.bits not in (8, 16):
        settings = settings.model_copy(update={"white_level": 2.0**rig.bits - 1})
    return levels, settings


def _by_file(
    rig: DrawnRig, mosaic: npt.NDArray[Any], settings: DecodeSettings, calibration: Calibration | None
) -> tuple[Any, DecodeSettings]:
    """Return a frame as a JPEG of the camera's holds it."""
    color = cv2.cvtColor(mosaic, cv2.COLOR_BayerRGGB2RGB_EA).astype(np.float64) / 255
    encoded = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    halved = rig.delivery == "mjpeg"
    sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420 if halved else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    options = [cv2.IMWRITE_JPEG_QUALITY, 88 if halved else 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frame.jpg"
        cv2.imwrite(str(path), np.rint(encoded * 255).astype(np.uint8)[..., ::-1], options)
        source = open_footage(path)
        settings, _ = with_transfer_of(source, settings, calibration)
        (stored,) = source.frames()
        return develop(stored.planes, stored.format, stripes=settings.stripes), settings


def phase_error(frame: DecodedFrame, taken: Taken) -> npt.NDArray[np.float64]:
    """Return (H, W) rad, modulo 2 pi; nonsense outside the mask."""
    return np.angle(np.exp(1j * (np.where(frame.mask, frame.wrapped_phase, 0.0) - taken.phase)))


def judge(taken: Taken) -> dict[str, Any]:
    """Return all figures of a scene."""
    truth, scene, lit = taken.truth, taken.scene, taken.lit
    begin = time.process_time()
    frames = {"clean": decode(taken, "plain", noise=False), "noisy": decode(taken, "plain")}
    frames["nothing"] = decode(taken, "plain", known=False)
    inner_lit = deeper(lit, _RIM_PX)
    result: dict[str, Any] = {"surfaces": {}, "lit": int(lit.sum())}
    for name in ("noisy", "nothing"):
        result[f"covered {name}"] = float((frames[name].mask & lit).sum() / max(lit.sum(), 1))
    errors = {name: phase_error(frame, taken) for name, frame in frames.items()}
    everywhere = np.zeros(lit.shape, np.bool_)
    for number, name in enumerate(scene.names):
        whole = lit & (truth.paint == number) & (truth.body != NOTHING)
        inside = inner_lit & deeper((truth.paint == number) & (truth.body != NOTHING), _RIM_PX)
        everywhere |= inside
        if inside.sum() < _LEAST_PX:
            continue
        row: dict[str, float] = {
            "px": int(inside.sum()),
            "covered": float((frames["noisy"].mask & whole).sum() / whole.sum()),
            "covered nothing": float((frames["nothing"].mask & whole).sum() / whole.sum()),
        }
        for kind, error in errors.items():
            valid = inside & frames[kind].mask
            if valid.sum() < 200:
                continue
            constant = float(np.angle(np.exp(1j * error[valid]).mean()))
            centred = np.angle(np.exp(1j * (error[valid] - constant)))
            row[f"rms {kind}"], row[f"constant {kind}"] = float(np.sqrt((centred**2).mean())), constant
            if kind == "noisy":
                sigma = frames[kind].phase_sigma[valid]
                row["pull"] = float(np.sqrt((centred**2).mean() / (sigma**2).mean()))
        result["surfaces"][name] = row
    both = everywhere & frames["noisy"].mask & frames["nothing"].mask
    if both.any():
        result["calibrated over nothing"] = float(
            np.sqrt((errors["noisy"][both] ** 2).mean() / (errors["nothing"][both] ** 2).mean())
        )
    for pattern in CODED:
        result[pattern] = judge_orders(decode(taken, pattern), taken, inner_lit)
    result["CPU s"] = time.process_time() - begin
    return result


def judge_orders(frame: DecodedFrame, taken: Taken, inner_lit: Mask) -> dict[str, float]:
    """Return what is absolute and right, wrong and not flagged, and how far phases and depths are off."""
    lit, known = taken.lit, frame.mask & frame.absolute
    off = np.rint((np.nan_to_num(frame.unwrapped_phase) - taken.phase) / (2 * np.pi)) != 0
    wrong = known & off & (taken.truth.body != NOTHING)
    count, _, sizes, _ = cv2.connectedComponentsWithStats(wrong.astype(np.uint8))
    phase = phase_error(frame, taken)[frame.mask & inner_lit]
    depth = (frame.points[..., 2] - taken.truth.depth_mm)[frame.mask & (taken.truth.body != NOTHING)]
    depth = np.abs(depth[np.isfinite(depth)])
    return {
        "covered": float((frame.mask & lit).sum() / max(lit.sum(), 1)),
        "right": float((known & ~off & lit).sum() / max(lit.sum(), 1)),
        "wrong": float(wrong.sum() / max(known.sum(), 1)),
        "wrong regions": int((sizes[1:, cv2.CC_STAT_AREA] >= 20).sum()) if count > 1 else 0,
        "rms": float(np.sqrt((phase**2).mean())) if len(phase) else np.nan,
        "depth rms": float(np.sqrt((depth**2).mean())) if len(depth) else np.nan,
        "depth 99.9": float(np.quantile(depth, 0.999)) if len(depth) else np.nan,
    }


def measured(seed: int, names: list[str], frames: Path, figures: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the figures of a rig, scene by scene; frames and figures are kept in folders."""
    for name in names:
        path = figures / f"{seed}-{name.replace(' ', '_')}.json"
        if not path.exists():
            path.write_text(json.dumps(judge(kept(seed, name, frames))))
        yield name, json.loads(path.read_text())


CODED = tuple(name for name, (code, _) in PATTERNS.items() if code != "none")
OPAQUE = tuple(name for name in SCENES if name != "scattering face")
_SATURATED = ("dark face", "objects", "parcel", "balls", "bars")
_UNIFORM = ("hand", "objects", "balls", "bars")


def rows_of(found: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Return the worst of each figure over a rig's scenes."""

    def surfaces(scenes: tuple[str, ...], key: str) -> list[float]:
        rows = [row for name in scenes if name in found for row in found[name]["surfaces"].values()]
        return [abs(row[key]) for row in rows if key in row] or [np.nan]

    opaque = [found[name] for name in OPAQUE if name in found]
    pulls = surfaces(tuple(found), "pull")
    result = {
        "covered: saturated, dark, dim surfaces": min(surfaces(_SATURATED, "covered")),
        **order_rows(opaque, "coded"),
        **order_rows(opaque, "coded2"),
        "plane: RMS": max(surfaces(("plane",), "rms clean")),
        "plane: constant": max(surfaces(("plane",), "constant clean")),
        "uniform surfaces: RMS": max(surfaces(_UNIFORM, "rms clean")),
        "uniform surfaces: constant": max(surfaces(_UNIFORM, "constant clean")),
        "painted faces: RMS": max(surfaces(("light face", "dark face"), "rms clean")),
        "fine checks: RMS": max(surfaces(("fine checks",), "rms clean")),
        "checks: RMS": max(surfaces(("checks",), "rms clean")),
        "error over sigma: least": min(pulls),
        "error over sigma: most": max(pulls),
        "calibrated over nothing known": max(scene.get("calibrated over nothing", np.nan) for scene in found.values()),
        "depth: RMS, mm": max(scene["coded"]["depth rms"] for scene in opaque),
        "depth: 99.9 %, mm": max(scene["coded"]["depth 99.9"] for scene in opaque),
    }
    if "scattering face" in found:
        skin = found["scattering face"]
        result["scattering skin: RMS"] = abs(skin["surfaces"]["skin"]["rms clean"])
        result["scattering skin: bias"] = abs(skin["surfaces"]["skin"]["constant clean"])
        result["scattering skin: coded coverage"] = skin["coded"]["covered"]
    return result


def order_rows(scenes: list[dict[str, Any]], code: str) -> dict[str, float]:
    """Return the worst figures of the orders that a code tells, its response undone or not."""
    judged = [scene[pattern] for scene in scenes for pattern in (code, f"compensated {code}")]
    return {
        f"{code}: absolute and right": min(row["right"] for row in judged),
        f"{code}: wrong and not flagged": max(row["wrong"] for row in judged),
        f"{code}: such regions per 1,000 frames": 1000 * float(np.mean([row["wrong regions"] for row in judged])),
    }


def table(rigs: list[dict[str, float]]) -> str:
    """Return the median and the worst of each figure over the rigs, as Markdown."""
    lines = ["| worst scene of each rig | median rig | worst rig |", "|---|---|---|"]
    for name in rigs[0]:
        values = [rig[name] for rig in rigs if np.isfinite(rig.get(name, np.nan))]
        if not values:  # of scenes that were not asked for
            continue
        good_is_high = name.startswith("covered") or name.endswith(("and right", "sigma: least", "coverage"))
        worst = min(values) if good_is_high else max(values)
        lines.append(f"| {name} | {np.median(values):.4g} | {worst:.4g} |")
    return "\n".join(lines)


def line(name: str, found: dict[str, Any]) -> str:
    """Return what a scene came to, for somebody who waits."""
    worst = {
        key: max((abs(row[key]) for row in found["surfaces"].values() if key in row), default=np.nan)
        for key in ("rms clean", "constant clean", "rms noisy", "pull")
    }
    right, wrong = (" ".join(f"{found[name][key]:.5f}" for name in CODED) for key in ("right", "wrong"))
    return (
        f"{name:16} covered {found['covered noisy']:.3f}, nothing known {found['covered nothing']:.3f}; "
        f"clean {worst['rms clean']:.4f} {worst['constant clean']:.4f}; noisy {worst['rms noisy']:.4f}, "
        f"over sigma {worst['pull']:.2f}; calibrated over nothing {found.get('calibrated over nothing', np.nan):.2f}; "
        f"right {right}, wrong {wrong}; {found['coded']['depth rms']:.2f} mm"
    )


def _figures_of(seed: int, names: list[str], frames: Path, figures: Path) -> dict[str, float]:
    """Return the worst figures of a rig, in a process of its own."""
    os.environ["TI_CPU_MAX_NUM_THREADS"] = "1"
    runtime.init("cpu")
    found = {}
    for name, row in measured(seed, names, frames, figures):
        found[name] = row
        print(f"{seed:3} {line(name, row)}", flush=True)
    return rows_of(found)


def study(seeds: list[int], names: list[str], frames: Path, figures: Path) -> str:
    """Measure rigs, one on each core, and return the table; what was measured before is kept in the folders."""
    for folder in (frames, figures):
        folder.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        return table(list(pool.map(partial(_figures_of, names=names, frames=frames, figures=figures), seeds)))
