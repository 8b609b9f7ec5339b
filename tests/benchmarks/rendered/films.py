"""Decode films of things that move before rigs as people have them, in order, and judge them against the truth.

    python tests/benchmarks/rendered/films.py [--films ...] [--rigs ...] [--speeds ...] [--frames 1000] [--folder F]

A row is a film before a rig at a speed, mm/s; 0 is the reference: at rest while a frame is exposed. The geometry is the
true one, matrix and response are measured on the rig's own ramps, the pattern is the coded one with its response
undone, the settings are the default ones but for what a rig file says of colours and rows, and every frame has the one
before as `previous`. Figures:

- RMS, 99.9 % and bias of the depth of what moves (of the head where a hand passes), mm, inside its surfaces: further
  from every edge than 4 px and half of what the fastest things move while all rows are exposed. Of pixels that are
  absolute and right; "all" are all decoded ones, whose RMS without whole cycles is that of the phase. The truth is that
  of the middle of the middle row's exposure.
- right: share of the lit pixels there that are absolute and right; covered: share of all lit pixels that are decoded.
- noise/sigma: of what stands still, standard deviation over time over what `point_sigma` says, both along the ray.
- flicker: frames with 20 connected pixels or more inside a surface that are absolute and on a wrong cycle.
- regained: passes of the hand after which the head's commonest order error is the one before.
- CPU: ms a frame, median and 99th percentile, of decoding and reading the fields that are judged; without
  the first frame.
"""

import argparse
import os
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from drawn_figures import delivered
from drawn_frames import Photographer
from filmed import FILMS, RAYS, Drawn, Filming, film_rigs

from pipeline import DecodedFrame, Decoder
from pipeline.errors import DecodeWarning
from tikernels import runtime

_FLICKER_PX = 20
# Bins of the errors' histogram, mm: 1 % apart.
_BINS = np.geomspace(1e-3, 1e4, 1621)
# A still pixel counts that is absolute and right in this part of the frames.
_MOSTLY = 0.8


class Errors:
    """Figures of errors that come frame by frame, mm."""

    def __init__(self) -> None:
        self.moments = np.zeros(3)
        self.histogram = np.zeros(len(_BINS) - 1)

    def add(self, errors: npt.NDArray[np.floating]) -> None:
        """Count more of them."""
        errors = errors[np.isfinite(errors)].astype(np.float64)
        self.moments += len(errors), errors.sum(), (errors**2).sum()
        self.histogram += np.histogram(np.clip(np.abs(errors), _BINS[0], _BINS[-1]), _BINS)[0]

    def summary(self) -> tuple[float, float, float]:
        """Return RMS, the 99.9 % quantile of their sizes, and mean."""
        count, total, squares = self.moments
        if count == 0:
            return np.nan, np.nan, np.nan
        most = np.searchsorted(np.cumsum(self.histogram), 0.999 * count)
        return float(np.sqrt(squares / count)), float(_BINS[most + 1]), float(total / count)


@dataclass
class Verdict:
    """What a film comes to."""

    known: Errors = field(default_factory=Errors)
    decoded: Errors = field(default_factory=Errors)
    phase: Errors = field(default_factory=Errors)
    counts: Counter[str] = field(default_factory=Counter)
    warned: Counter[str] = field(default_factory=Counter)
    cpu_ms: list[float] = field(default_factory=list)
    still: npt.NDArray[np.float64] | None = None  # (4, H, W) frames, range less the first, its square, sigma squared
    first_mm: npt.NDArray[np.floating] | None = None
    order: float | None = None  # of the judged body when nothing was last in front of it
    hidden: bool = False

    def add(self, frame: DecodedFrame, drawn: Drawn, filming: Filming, number: int) -> None:
        """Judge one frame."""
        film, period = filming.film, filming.calibration.pattern.period_px
        mask, absolute, points = frame.mask, frame.absolute, frame.points
        phase = np.nan_to_num(2 * np.pi / period * drawn.place)
        off = np.nan_to_num(frame.unwrapped_phase) - phase
        order = np.rint(off / (2 * np.pi))
        right, judged = mask & absolute & (order == 0), drawn.inside & (drawn.body == film.judged)
        error = points[..., 2] - drawn.depth_mm
        self.known.add(error[judged & right])
        self.decoded.add(error[judged & mask])
        self.phase.add(((off - 2 * np.pi * order) * drawn.mm_per_rad)[judged & mask])
        wrong = mask & absolute & (order != 0) & drawn.inside
        _, _, sizes, _ = cv2.connectedComponentsWithStats(wrong.astype(np.uint8))
        self.counts.update(
            frames=1,
            flicker=int((sizes[1:, cv2.CC_STAT_AREA] >= _FLICKER_PX).any()),
            judged=int(judged.sum()),
            right=int((judged & right).sum()),
            lit=int(drawn.lit.sum()),
            covered=int((drawn.lit & mask).sum()),
        )
        self.warned.update({str(cause.key) for cause in frame.warnings})
        self._add_still(right & drawn.inside & (drawn.body == film.still), points, frame.point_sigma)
        self._add_pass(film.hides(filming.pace * number * filming.shutter.frame_s), order[judged & mask])

    def _add_still(
        self, here: npt.NDArray[np.bool_], points: npt.NDArray[np.floating], sigma: npt.NDArray[np.floating]
    ) -> None:
        reach = np.linalg.norm(points, axis=2).astype(np.float64)
        if self.still is None or self.first_mm is None:
            self.still, self.first_mm = np.zeros((4, *here.shape)), np.full(here.shape, np.nan)
        self.first_mm = np.where(np.isnan(self.first_mm) & here, reach, self.first_mm)
        off = (reach - self.first_mm)[here]
        self.still[:, here] += np.stack([np.ones_like(off), off, off**2, sigma[here].astype(np.float64) ** 2])

    def _add_pass(self, hidden: bool, order: npt.NDArray[np.floating]) -> None:
        """Compare the commonest order error with that of before the hand came."""
        if not hidden:
            values, votes = np.unique(order, return_counts=True)
            now = float(values[votes.argmax()]) if len(order) else None
            if self.hidden and self.order is not None:
                self.counts.update(passes=1, regained=int(now == self.order))
            self.order = now
        self.hidden = hidden

    def noise_over_sigma(self) -> float:
        """Return the RMS over the still pixels of their deviation over time, over that of their sigma."""
        frames, total, squares, sigma = self.still
        often = frames >= max(2, _MOSTLY * self.counts["frames"])
        n = frames[often]
        variance = (squares[often] - total[often] ** 2 / n) / (n - 1)
        return float(np.sqrt(variance.mean() / (sigma[often] / n).mean())) if often.any() else np.nan

    def cells(self) -> list[str]:
        """Return the figures."""
        (rms, most, bias), (rms_all, most_all, _) = self.known.summary(), self.decoded.summary()
        counts = self.counts
        passes = f"{counts['regained']} of {counts['passes']}" if counts["passes"] else "-"
        warned = ", ".join(f"{key} {times}" for key, times in self.warned.most_common()) or "-"
        return [
            f"{counts['frames']}", f"{rms:.3f}", f"{most:.2f}", f"{bias:+.3f}", f"{rms_all:.3f}",
            f"{self.phase.summary()[0]:.3f}", f"{most_all:.2f}",
            f"{counts['right'] / max(counts['judged'], 1):.4f}", f"{counts['covered'] / max(counts['lit'], 1):.4f}",
            f"{self.noise_over_sigma():.2f}", f"{counts['flicker']}", passes,
            "{:.0f}, {:.0f}".format(*np.quantile(self.cpu_ms, (0.5, 0.99))) if self.cpu_ms else "-", warned,
        ]  # fmt: skip


_HEAD = (
    "| film | rig | mm/s | frames | RMS | 99.9 % | bias | all: RMS | of the phase | 99.9 % | right "
    "| covered | noise/sigma | flicker | regained | CPU, ms: median, 99 % | frames with a warning |"
)


def drawn_frames(filming: Filming, frames: int, folder: Path | None) -> Iterator[Drawn]:
    """Yield the frames of a film; a folder keeps them: the sensor's mosaic as PNG, and the truth."""
    for number in range(frames):
        if folder is None:
            yield filming.draw(number)
            continue
        picture, truth = folder / f"{number:04}.png", folder / f"{number:04}.npz"
        if not truth.exists():
            drawn = asdict(filming.draw(number))
            cv2.imwrite(str(picture), drawn.pop("levels"))
            np.savez_compressed(truth, **drawn)
        with np.load(truth) as kept:
            yield Drawn(levels=cv2.imread(str(picture), cv2.IMREAD_UNCHANGED), **kept)


def judge(filming: Filming, frames: int, folder: Path | None) -> Verdict:
    """Decode a film in order and judge every frame."""
    rig, calibration, verdict = filming.photographer.rig, filming.calibration, Verdict()
    stripes = rig.calibration.pattern.stripes
    decoder: Decoder | None = None
    frame: DecodedFrame | None = None
    for number, drawn in enumerate(drawn_frames(filming, frames, folder)):
        image, settings = delivered(
            rig, drawn.levels, filming.shutter.settings(stripes, len(drawn.levels)), calibration
        )
        decoder = decoder or Decoder(settings, calibration, arch="cpu")
        start = time.process_time()
        frame = decoder.decode(image, previous=frame)
        _ = frame.mask, frame.absolute, frame.unwrapped_phase, frame.points, frame.point_sigma
        if number:
            verdict.cpu_ms.append(1e3 * (time.process_time() - start))
        verdict.add(frame, drawn, filming, number)
    return verdict


def main() -> None:
    """Print one row a film, rig and speed."""
    rigs = film_rigs(0)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--films", nargs="+", default=list(FILMS), choices=FILMS)
    parser.add_argument("--rigs", nargs="+", default=list(rigs), choices=rigs)
    parser.add_argument("--speeds", nargs="+", type=float, help="mm/s; left out: 0 and those of the film")
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="where frames and truth are kept, and taken from")
    options = parser.parse_args()
    os.environ["TI_CPU_MAX_NUM_THREADS"] = "1"
    runtime.init("cpu")
    warnings.simplefilter("ignore", DecodeWarning)
    print(_HEAD + "\n" + "|---" * (_HEAD.count("|") - 1) + "|")
    for rig_name in options.rigs:
        rig, shutter = film_rigs(options.seed)[rig_name]
        photographer = Photographer(rig, RAYS)
        for name in options.films:
            film = FILMS[name](rig, options.seed)
            for speed in options.speeds or (0.0, *film.speeds_mm_s):
                filming = Filming(photographer, shutter, film, speed, options.seed)
                folder = None
                if options.folder is not None:
                    folder = options.folder / f"{name} {rig_name} {speed:g} {options.seed}".replace(" ", "_")
                    folder.mkdir(parents=True, exist_ok=True)
                verdict = judge(filming, options.frames, folder)
                print("| " + " | ".join([name, rig_name, f"{speed:g}", *verdict.cells()]) + " |", flush=True)


if __name__ == "__main__":
    main()
