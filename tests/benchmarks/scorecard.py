"""The scorecard: one table over about forty frames with truth, which shows what a change to the decoder does.

    python tests/benchmarks/scorecard.py                        the table; under ten minutes on two quiet cores
    python tests/benchmarks/scorecard.py bust-skin-2-coded      only these frames
    python tests/benchmarks/scorecard.py --against main         compare with another commit, pixel by pixel
    python tests/benchmarks/scorecard.py --without sharpness    with one mechanism of the decoder switched off
    python tests/benchmarks/scorecard.py --ablate               each mechanism in turn; writes a part of docs/studies.md
    python tests/benchmarks/scorecard.py --rigs 0-19            another table: scenes before rigs drawn at random

A pixel is judged that is lit, brighter than 20 of 255, and 4 px inside the lit area. RMS and constant are those of its
phase error (rad, modulo 2 pi, one constant removed). Error over sigma is the RMS of the error minus its surface's
constant over the RMS of `phase_sigma`, 4 px inside the surfaces. Coverage is the share of the judged pixels that are
valid. Wrong orders are valid pixels whose order is not their surface's commonest. Absolute and right: judged pixels
whose order is reported as absolute, and is right. Wrong and not flagged: reported as absolute, and wrong; or not their
region's commonest, where the region's order is relative. Depth is the depth error that the phase error makes, constant
included. CPU time, launches of kernels and reads (buffers that the host looks at) are those of a frame after the first,
with one kernel thread.
All but captures are means over noise seeds, with the standard deviation from seed to seed in brackets.

Each core has a process of its own. Frames and results are kept in a folder of the user's cache.
"""

import argparse
import contextlib
import hashlib
import importlib
import io
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Any
from zlib import crc32

import cv2
import numpy as np
import numpy.typing as npt

ROOT = Path(__file__).resolve().parents[2]
_LIT_LEVELS, _RIM_PX = 20.0, 4
# Smaller surfaces have no constant of their own, and no commonest order.
_LEAST_SURFACE_PX = 200
# The CPU time is the least of so many decodes of one image.
_TIMED = 3
# Fields that are compared with another commit's.
_COMPARED = ("mask", "fringe_order", "region", "absolute", "unwrapped_phase", "phase_sigma")
# A mechanism pays if some frame loses more than this without it: a share of an RMS, of coverage, and of wrong orders.
_RMS, _COVERAGE, _ORDERS = 0.03, 0.005, 0.1
# So it does if sigma gets worse by this factor.
_SIGMA = 1.1
# Fewer wrong orders per 100,000 than this are chance.
_FEW_ORDERS = 20.0

_PART = """\
## Mechanisms of the decoder

`python tests/benchmarks/scorecard.py --ablate --seeds {seeds}`, {date}, {seeds} noise seeds but for captures.

A cell lists the largest loss without a mechanism, and the largest gain (minus), among the frames of a kind:

| in a cell | loss of |
|---|---|
| RMS | phase error, of itself |
| coverage, right | covered, and absolute and right pixels, of the lit pixels |
| orders | wrong orders inside surfaces or without a flag, added per 100,000 pixels |
| sigma | distance of error over sigma from one, as a factor |

Lines are those of the code that only this mechanism needs. A mechanism stays if a frame loses {rms:.0%} of its RMS,
{coverage:.1%} of its coverage, or a tenth of its orders (and {orders:.0f} per 100,000) by more than two standard
deviations of the mean over seeds, or if sigma gets worse by a factor of {sigma}.
"""

Figures = dict[str, float]
#: Columns of the table: key, heading, factor, digits.
COLUMNS = (
    ("rms", "RMS, rad", 1, 4),
    ("constant", "constant", 1, 4),
    ("pull", "error / sigma", 1, 2),
    ("coverage", "coverage, %", 100, 2),
    ("wrong", "wrong orders / 1e5", 1e5, 0),
    ("right", "absolute and right, %", 100, 2),
    ("unflagged", "wrong, not flagged / 1e5", 1e5, 0),
    ("depth", "depth RMS, mm", 1, 3),
    ("depth999", "99.9 %", 1, 2),
    ("cpu_ms", "CPU, ms", 1, 0),
    ("launches", "launches", 1, 0),
    ("reads", "reads", 1, 0),
)


# --- a child: makes frames, or decodes and judges them -------------------------------------------------------------


def make(folder: Path, name: str, seed: int) -> dict[str, Any]:
    """Write a frame's images and its truth; one truth for all seeds where only the noise differs."""
    from scorecard_frames import frames

    frame = frames()[name]
    taken = frame.take(seed)
    truth = folder / f"{name}.truth{seed if frame.own_truth else 0}.npz"
    if frame.own_truth or seed == 0:
        np.savez(truth, **vars(taken.truth))
    calibrations = [None if c is None else json.loads(c.model_dump_json()) for c in taken.calibrations]
    described = {"calibrations": calibrations, "settings": taken.settings, "truth": truth.name}
    (folder / f"{name}.{seed}.json").write_text(json.dumps(described), encoding="utf-8")
    part = folder / f"{name}.{seed}.part.npz"
    np.savez(part, *taken.images)
    part.replace(folder / f"{name}.{seed}.npz")
    return {}


def decode(folder: Path, name: str, seed: int, fields: str | None, rounds: int) -> Figures:
    """Decode a frame, again so many times to measure what that costs, and return its figures; keep its fields."""
    from pipeline import Calibration, Decoder, DecodeSettings
    from tikernels import runtime
    from tikernels.traffic import traffic

    described = json.loads((folder / f"{name}.{seed}.json").read_text(encoding="utf-8"))
    with np.load(folder / f"{name}.{seed}.npz") as kept:
        images = [kept[f"arr_{number}"] for number in range(len(kept.files))]
    with np.load(folder / described["truth"]) as kept:
        truth = dict(kept)
    settings = DecodeSettings(**described["settings"])
    reads = [0]
    to_host = runtime.to_host

    def counted(buffer: Any) -> Any:
        reads[0] += 1
        return to_host(buffer)

    decoder, known, frame = None, None, None
    for image, values in zip(images, described["calibrations"], strict=True):
        if decoder is None or values != known:
            calibration = None if values is None else Calibration.model_validate_json(json.dumps(values))
            decoder, known = Decoder(settings, calibration, arch="cpu"), values
        previous, frame = frame, decoder.decode(image, previous=frame)
    assert decoder is not None and frame is not None
    figures = judge(frame, images[-1], truth)
    figures["digest"] = float(crc32(b"".join(np.ascontiguousarray(getattr(frame, key)).tobytes() for key in _COMPARED)))
    if fields is not None:
        path = folder / fields / f"{name}.npz"
        path.parent.mkdir(exist_ok=True)
        np.savez(path, **{key: getattr(frame, key) for key in _COMPARED})
    spent = []
    for _ in range(rounds if seed < 2 else 0):
        traffic.clear()
        reads[0], runtime.to_host = 0, counted
        start = time.process_time()
        again = decoder.decode(images[-1], previous=previous)
        _ = [getattr(again, key) for key in _COMPARED]
        spent.append(1e3 * (time.process_time() - start))
        runtime.to_host = to_host
    if spent:
        figures |= {"cpu_ms": min(spent), "launches": float(traffic.calls), "reads": float(reads[0])}
    return figures


def judge(frame: Any, image: npt.NDArray[Any], truth: dict[str, npt.NDArray[Any]]) -> Figures:
    """Return how far a decoded frame is from its truth; see the head of this file."""
    levels = image.mean(axis=2) * (255.0 if image.dtype.kind == "f" else 255.0 / np.iinfo(image.dtype).max)
    judged = deeper(truth["lit"], _RIM_PX) & (levels > _LIT_LEVELS)
    valid = judged & frame.mask
    n_judged, n_valid = np.count_nonzero(judged), np.count_nonzero(valid)
    figures: Figures = {"coverage": n_valid / max(n_judged, 1)}
    if n_valid == 0:
        return figures
    phase = np.where(valid, truth["phase"], 0.0)
    error = np.where(valid, np.nan_to_num(frame.unwrapped_phase), 0.0) - phase
    turn = np.angle(np.exp(1j * error))
    figures["rms"], figures["constant"] = spread(turn[valid])
    off = np.rint((error - figures["constant"]) / (2 * np.pi)).astype(np.int64)
    surface = truth["surface"]
    sizes = np.bincount(surface[valid])
    inner = valid & inside_surfaces(surface)
    squares = variances = wrong = 0.0
    for number in np.flatnonzero(sizes >= _LEAST_SURFACE_PX):
        if number == 0:
            continue
        here = valid & (surface == number)
        wrong += np.count_nonzero(off[here] != commonest(off[here]))
        deep = here & inner
        if np.count_nonzero(deep) >= _LEAST_SURFACE_PX:
            own, count = spread(turn[deep])[0], np.count_nonzero(deep)
            squares += own**2 * count
            variances += float((frame.phase_sigma[deep].astype(np.float64) ** 2).sum())
    figures["pull"] = float(np.sqrt(squares / variances)) if variances else np.nan
    figures["wrong"] = wrong / n_valid
    absolute = valid & frame.absolute
    figures["right"] = np.count_nonzero(absolute & (off == 0)) / n_judged
    unflagged = absolute & (off != 0)
    for number in np.unique(frame.region[valid & ~frame.absolute]):
        here = valid & (frame.region == number)
        unflagged |= here & (off != commonest(off[here]))
    figures["unflagged"] = np.count_nonzero(unflagged) / n_judged
    depth = np.abs(turn * truth["mm_per_rad"])[valid]
    if np.isfinite(depth).any():
        figures["depth"] = float(np.sqrt(np.nanmean(depth**2)))
        figures["depth999"] = float(np.nanquantile(depth, 0.999))
    if truth["orders_only"]:
        figures = {key: value for key, value in figures.items() if key not in ("rms", "constant", "pull")}
    return figures


def commonest(values: npt.NDArray[np.int64]) -> int:
    """Return the value that occurs most often."""
    found, counts = np.unique(values, return_counts=True)
    return int(found[counts.argmax()])


def deeper(mask: npt.NDArray[np.bool_], px: float) -> npt.NDArray[np.bool_]:
    """Return where a mask is further than a number of pixels from where it is not; the image's edge does not count."""
    return cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) > px


def inside_surfaces(surface: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
    """Return which pixels see only their own surface around them."""
    window, number = np.ones((2 * _RIM_PX + 1,) * 2), surface.astype(np.float32)
    return (surface > 0) & (cv2.dilate(number, window) == cv2.erode(number, window))


def spread(error: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Return the RMS of phase errors with one constant removed, and that constant."""
    constant = float(np.angle(np.exp(1j * error).mean()))
    return float(np.sqrt((np.angle(np.exp(1j * (error - constant))) ** 2).mean())), constant


def child(folder: Path, role: str, without: str | None) -> None:
    """Do what is read line by line from standard input."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print is no answer
    warnings.simplefilter("ignore")
    from tikernels import runtime

    runtime.init("cpu")
    if without is not None:
        from scorecard_mechanisms import MECHANISMS

        MECHANISMS[without].switch_off()
    for line in sys.stdin:
        name, seed, fields, rounds = json.loads(line)
        figures = make(folder, name, seed) if role == "make" else decode(folder, name, seed, fields, rounds)
        print(json.dumps(figures), file=answers, flush=True)


# --- the parent ----------------------------------------------------------------------------------------------------


@dataclass
class Run:
    """Figures of frames, decoded with one code and one set of mechanisms."""

    by_frame: dict[str, list[Figures]] = field(default_factory=dict)

    def mean(self, name: str, key: str) -> float:
        """Return the mean over seeds; NaN where there is none."""
        values = [figures[key] for figures in self.by_frame[name] if figures.get(key) is not None]
        return float(np.mean(values)) if values else np.nan

    def scatter(self, name: str, key: str) -> float:
        """Return the standard deviation from seed to seed."""
        values = [figures[key] for figures in self.by_frame[name] if figures.get(key) is not None]
        return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0

    def table(self) -> str:
        """Return the table."""
        lines = [
            "| frame | " + " | ".join(heading for _, heading, _, _ in COLUMNS) + " |",
            "|---" * (len(COLUMNS) + 1) + "|",
        ]
        for name in self.by_frame:
            cells = []
            for key, _, factor, digits in COLUMNS:
                mean, scatter = factor * self.mean(name, key), factor * self.scatter(name, key)
                cell = "-" if np.isnan(mean) else f"{mean:.{digits}f}"
                shown = len(self.by_frame[name]) > 1 and key not in ("launches", "reads", "cpu_ms") and cell != "-"
                cells.append(cell + (f" ({scatter:.{digits}f})" if shown else ""))
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        return "\n".join(lines)


def measured(
    folder: Path,
    names: list[str],
    seeds: int,
    *,
    code: Path = ROOT,
    without: str | None = None,
    fields: str | None = None,
    rounds: int = _TIMED,
    processes: int = 0,
) -> Run:
    """Decode frames in some processes, or one per core, and return their figures."""
    from scorecard_frames import frames

    everything = frames()
    wanted = [(name, seed) for name in names for seed in range(min(seeds, everything[name].seeds))]
    missing = [task for task in wanted if not (folder / f"{task[0]}.{task[1]}.npz").exists()]
    if missing:
        in_children(folder, "make", missing)
    answers = in_children(folder, "decode", wanted, code, without, fields, rounds, processes)
    run = Run()
    for (name, _), figures in zip(wanted, answers, strict=True):
        run.by_frame.setdefault(name, []).append(figures)
    return run


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_children(
    folder: Path,
    role: str,
    tasks: list[tuple[str, int]],
    code: Path = ROOT,
    without: str | None = None,
    fields: str | None = None,
    rounds: int = 0,
    processes: int = 0,
) -> list[Figures]:
    """Do tasks in some processes, or one per core."""
    count = min(processes or usable_cores(), len(tasks))
    threads = dict.fromkeys(("TI_CPU_MAX_NUM_THREADS", "QD_CPU_MAX_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    command = [sys.executable, str(Path(__file__).resolve()), "--child", role, "--folder", str(folder)]
    command += ["--without", without] if without else []
    environment = os.environ | threads | {"PYTHONPATH": str(code)}
    idle: SimpleQueue[subprocess.Popen[str]] = SimpleQueue()
    children = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=folder)
        for _ in range(count)
    ]
    for process in children:
        idle.put(process)

    def answer(task: tuple[str, int]) -> Figures:
        process = idle.get()
        assert process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps([*task, fields if task[1] == 0 else None, rounds]) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        finally:
            idle.put(process)
        if not line:
            raise SystemExit(f"{role} of {task[0]}, seed {task[1]}, failed: what it printed is above")
        return json.loads(line)

    try:
        with ThreadPoolExecutor(count) as pool:
            return list(pool.map(answer, tasks))
    finally:
        for process in children:
            process.kill()
            process.communicate()


@contextlib.contextmanager
def checked_out(ref: str) -> Iterator[Path]:
    """Write a commit's files into a temporary folder."""
    archive = subprocess.run(["git", "-C", str(ROOT), "archive", "--format=tar", ref], check=True, capture_output=True)
    with tempfile.TemporaryDirectory() as name, tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
        files.extractall(name, filter="data")
        yield Path(name)


def changes(folder: Path, now: Run, then: Run, fields: tuple[str, str]) -> str:
    """Return by how much figures differ, and how many pixels do; ratios are of now over then."""
    headings = ("RMS", "error / sigma", "coverage, %", "wrong orders / 1e5", "absolute and right, %",
                "wrong, not flagged / 1e5", "depth RMS", "CPU", "launches", "mask, px", "order, px", "region, px",
                "absolute, px", "phase, rad", "sigma")  # fmt: skip
    lines = ["| frame | " + " | ".join(headings) + " |", "|---" * (len(headings) + 1) + "|"]
    for name in now.by_frame:

        def ratio(key: str, name: str = name) -> str:
            value, other = now.mean(name, key), then.mean(name, key)
            return f"x {value / other:.3f}" if value > 0 and other > 0 else "-"

        def rise(key: str, factor: float, digits: int, name: str = name) -> str:
            return f"{factor * (now.mean(name, key) - then.mean(name, key)):+.{digits}f}"

        cells = [ratio("rms"), ratio("pull"), rise("coverage", 100, 2), rise("wrong", 1e5, 0), rise("right", 100, 2),
                 rise("unflagged", 1e5, 0), ratio("depth"), ratio("cpu_ms"), rise("launches", 1, 0)]  # fmt: skip
        with np.load(folder / fields[0] / f"{name}.npz") as a, np.load(folder / fields[1] / f"{name}.npz") as b:
            cells += [str(np.count_nonzero(a[key] != b[key])) for key in ("mask", "fringe_order", "region", "absolute")]
            both = a["mask"] & b["mask"]
            turn = np.angle(np.exp(1j * (a["unwrapped_phase"][both].astype(np.float64) - b["unwrapped_phase"][both])))
            sigma = np.abs(a["phase_sigma"][both] / b["phase_sigma"][both].astype(np.float64) - 1)
            cells += [f"{np.abs(turn).max(initial=0):.1e}", f"{np.nanmax(sigma, initial=0):.1e}"]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


# --- ablation ------------------------------------------------------------------------------------------------------


def ablate(folder: Path, names: list[str], seeds: int) -> None:
    """Switch every mechanism off in turn, keep each result as it comes, and write the table."""
    from scorecard_mechanisms import MECHANISMS

    kept = folder / f"ablation-{product_digest()}-{seeds}.json"
    results: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    measured(folder, names, seeds, rounds=0)  # makes frames that are not there, and compiles
    saving = Lock()

    def switched_off(mechanism: str) -> None:
        done = results.get(mechanism, {})
        left = [name for name in names if name not in done]
        if not left:
            return
        start = time.monotonic()
        try:
            found = measured(folder, left, seeds, without=mechanism or None, rounds=0, processes=1).by_frame
        except SystemExit as failure:  # of one mechanism, and the others go on
            print(f"without {mechanism}: {failure}", flush=True)
            return
        with saving:
            results[mechanism] = done | found
            part = kept.with_suffix(".part")
            part.write_text(json.dumps(results), encoding="utf-8")
            part.replace(kept)
            print(f"without {mechanism or 'nothing'}: {time.monotonic() - start:.0f} s", flush=True)

    with ThreadPoolExecutor(usable_cores()) as pool:
        list(pool.map(switched_off, ("", *MECHANISMS)))
    runs = {
        name: Run({frame: done[frame] for frame in names}) for name, done in results.items() if set(names) <= set(done)
    }
    from page_parts import write_part

    write_part("mechanisms", ablation_part(runs, seeds))


def ablation_part(runs: dict[str, Run], seeds: int) -> str:
    """Return the table of what each mechanism is worth, with its heading."""
    from scorecard_mechanisms import MECHANISMS

    base = runs[""]
    kinds = {"simulated": lambda n: n.split("-")[0] in ("plane", "waves", "bust", "objects", "ball"),
             "rendered": lambda n: n.startswith("r-"), "piles": lambda n: n.startswith(("pile", "touching")),
             "films": lambda n: n.startswith("film"), "captures": lambda n: n.startswith("capture")}  # fmt: skip
    head = _PART.format(date=date.today(), seeds=seeds, rms=_RMS, coverage=_COVERAGE, orders=_FEW_ORDERS, sigma=_SIGMA)
    columns = f"| mechanism | {' | '.join(kinds)} | lines | verdict |"
    lines = [head, columns, "|---" * (len(kinds) + 3) + "|"]
    for name, mechanism in MECHANISMS.items():
        if name not in runs:
            lines.append(f"| {name}: {mechanism.meaning} |" + " - |" * (len(kinds) + 1) + " not measured |")
            continue
        run, cells, buys = runs[name], [], False
        for belongs in kinds.values():
            frames = [frame for frame in base.by_frame if belongs(frame)]
            cell, pays = worth(base, run, frames)
            cells.append(cell)
            buys |= pays
        verdict = _verdict(base, run, mechanism) if not buys else "stays"
        lines.append(
            f"| **{name}**: {mechanism.meaning} | " + " | ".join(cells) + f" | {mechanism.lines()} | {verdict} |"
        )
    return "\n".join(lines) + "\n"


def _verdict(base: Run, run: Run, mechanism: Any) -> str:
    """Return what becomes of a mechanism that buys nothing."""
    found = [[[one["digest"] for one in of.by_frame[frame]] for frame in base.by_frame] for of in (base, run)]
    changes_nothing = "changes no pixel" if found[0] == found[1] else "buys nothing"
    return f"{changes_nothing}; stays: {mechanism.promise}" if mechanism.promise else changes_nothing


def worth(base: Run, run: Run, frames: list[str]) -> tuple[str, bool]:
    """Return what frames lose most without a mechanism, and whether any loses so much that the mechanism pays."""
    losses: dict[str, list[tuple[float, str]]] = {"RMS": [], "coverage": [], "right": [], "orders": [], "sigma": []}
    pays = False
    for frame in frames:
        usual = base.mean(frame, "rms")
        if not np.isnan(usual):
            rms, noise = _loss(base, run, frame, "rms")
            losses["RMS"].append((rms / usual, frame))
            pays |= rms > max(_RMS * usual, noise)
            far = [abs(np.log(max(of.mean(frame, "pull"), 1e-3))) for of in (base, run)]
            losses["sigma"].append((float(np.exp(far[1] - far[0])) - 1, frame))
            pays |= losses["sigma"][-1][0] > _SIGMA - 1
        for kind, key in (("coverage", "coverage"), ("right", "right")):
            lost, noise = _loss(base, run, frame, key, -1)
            losses[kind].append((lost, frame))
            pays |= lost > max(_COVERAGE, noise)
        for key in ("wrong", "unflagged"):
            orders, noise = _loss(base, run, frame, key)
            losses["orders"].append((1e5 * orders, frame))
            pays |= orders > max(_FEW_ORDERS / 1e5, _ORDERS * base.mean(frame, key), noise)
    parts = []
    for kind, found in losses.items():
        small = 1.0 if kind == "orders" else 0.002
        for value, frame in sorted({max(found), min(found)}, reverse=True) if found else []:
            if abs(value) > small:
                parts.append(f"{kind} {value:+.0f} ({frame})" if kind == "orders" else f"{kind} {value:+.1%} ({frame})")
    return "; ".join(parts) or "nothing", pays


def _loss(base: Run, run: Run, frame: str, key: str, sign: int = 1) -> tuple[float, float]:
    """Return by how much a figure gets worse, and two standard deviations of that: noise is the same in both."""
    pairs = zip(base.by_frame[frame], run.by_frame[frame], strict=True)
    found = [sign * (b.get(key, 0.0) - a.get(key, 0.0)) for a, b in pairs]
    return float(np.mean(found)), float(2 * np.std(found, ddof=1) / np.sqrt(len(found))) if len(found) > 1 else 0.0


# --- command line --------------------------------------------------------------------------------------------------


def digest(*paths: Path) -> str:
    """Return a digest of files, and of the Python files and kept frames below folders."""
    found = hashlib.sha256()
    for path in paths:
        for file in sorted([*path.rglob("*.py"), *path.rglob("*.xz")]) if path.is_dir() else [path]:
            found.update(file.read_bytes())
    return found.hexdigest()[:12]


def product_digest() -> str:
    """Return a digest of the decoder and of what switches its mechanisms off."""
    rooms = [ROOT / "pipeline" / name for name in ("decoder.py", "decoding", "orders")]
    return digest(ROOT / "tikernels", *rooms, Path(__file__).with_name("scorecard_mechanisms.py"))


def frames_folder(given: Path | None) -> Path:
    """Return where frames are kept: a folder for what they are made of; those of other code are removed."""
    parent = given or Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "colorphase-scorecard"
    here = Path(__file__)
    parts = (here.with_name("scorecard_frames.py"), here.with_name("frames"), ROOT / "pipeline" / "simulation.py")
    made_of = digest(*parts, ROOT / "tikernels" / "scene")
    folder = parent / f"frames-{made_of}"
    for other in parent.glob("frames-*"):
        if other != folder:
            shutil.rmtree(other)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def rigs_table(numbers: str, scenes: list[str], folder: Path) -> str:
    """Return the table of rigs drawn at random, "N-M", and some or all of their scenes."""
    from drawn_figures import study
    from drawn_rigs import rig_numbers
    from drawn_scenes import SCENES

    drawn = Path(__file__).with_name("rendered")
    names = ("drawn_rigs", "drawn_scenes", "drawn_frames", "ray_caster", "spectra")
    makers = [drawn / f"{name}.py" for name in names]
    makers += [ROOT / "pipeline" / name for name in ("calibration", "contrast_code.py", "pattern.py")]
    frames = folder / f"rigs-{digest(*makers)}"
    figures = frames / digest(drawn, ROOT / "pipeline", ROOT / "tikernels")
    return study(list(rig_numbers(numbers)), scenes or list(SCENES), frames, figures)


def main() -> None:
    """Print the table, a comparison, or write the ablation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("frame", nargs="*", help="names of frames; none: all")
    parser.add_argument("--against", metavar="REF", help="compare with another commit")
    parser.add_argument("--without", metavar="NAME", help="switch off one mechanism; ? lists them")
    parser.add_argument(
        "--ablate", action="store_true", help="switch off every mechanism in turn; continues after a kill"
    )
    parser.add_argument("--rigs", metavar="N-M", help="measure drawn rigs of these numbers; takes minutes for each")
    parser.add_argument("--seeds", type=int, default=8, help="noise seeds per frame")
    parser.add_argument("--folder", type=Path, help="where frames and results are kept")
    parser.add_argument("--child", choices=("make", "decode"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        child(options.folder, options.child, options.without)
        return
    from scorecard_frames import frames
    from scorecard_mechanisms import MECHANISMS

    if options.rigs:
        print(rigs_table(options.rigs, options.frame, frames_folder(options.folder)))
        return
    if options.without not in (None, *MECHANISMS):
        parser.exit(2, "\n".join(f"{name}: {mechanism.meaning}" for name, mechanism in MECHANISMS.items()) + "\n")
    unknown = set(options.frame) - set(frames())
    if unknown:
        parser.exit(2, f"no frame {', '.join(sorted(unknown))}: choose of {', '.join(frames())}\n")
    names, folder = options.frame or list(frames()), frames_folder(options.folder)
    if options.ablate:
        ablate(folder, names, options.seeds)
        return
    now = measured(folder, names, options.seeds, fields="now")
    print(now.table())
    if options.against:
        with checked_out(options.against) as code:
            then = measured(folder, names, options.seeds, code=code, fields="then")
        print(f"\n{options.against}:\n\n{then.table()}\n\nThis code compared with {options.against}:\n")
        print(changes(folder, now, then, ("now", "then")))
    if options.without:
        less = measured(folder, names, options.seeds, without=options.without, fields="without")
        print(f"\nWithout {options.without}:\n\n{less.table()}\n\nCompared with all mechanisms:\n")
        print(changes(folder, less, now, ("without", "now")))


if __name__ == "__main__":
    importlib.import_module("_tests_path")
    main()
