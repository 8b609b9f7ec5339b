"""Certificates of drawn rigs that have calibrated themselves, beside the truth, which only this table sees.

The rigs of `calibration_accuracy.py`. Each measures its light and geometry from simulated captures, and then a ball bar
and a plate in the positions that `colorphase certify` asks for, held by hand. The bar is the longest of 100 to 160 mm
that the rig sees whole; its true spacing is off its certificate by 0.005 mm (one standard deviation).

Spacing: the largest true error of the seven positions, and the mean. Flatness: the largest range of all points, and
what is left of it without noise, RMS. Then the certified U (k = 2), and the true errors of the bar in three other
places of the volume, which U should contain.

Lateral resolution: the lateral period limit over the predicted one, across and along the stripes, on a corrugated plate
in the two positions that are asked for; and, with the plate in exactly these places, for lenses with other blurs.

python tests/benchmarks/certify.py [--rigs 20] [--folder FOLDER]    FOLDER keeps captures: stopped, it goes on there
"""

import argparse
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import _tests_path  # noqa: F401
import cv2
import numpy as np
from calibration_accuracy import BOARD, CAMERA_PX, DISTANCE_MM, PERIOD_PX, PROJECTOR_PX, drawn_rig

from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.acquisition.guided_capture import GuidedCapture
from pipeline.acquisition.simulated_studio import BarView, ReliefView, SimulatedStudio
from pipeline.calibration.captures import CapturedFolder
from pipeline.calibration.model import Pattern
from pipeline.calibration.pose_guide import PoseGuide
from pipeline.calibration.radiometry import measure_radiometry, radiometry_sequence
from pipeline.calibration.rig_geometry import solve_geometry
from pipeline.calibration.simulated_board import CaptureLight
from pipeline.diagnosis.artefacts import BallBar, Plate, Relief, Volume, positions_in
from pipeline.diagnosis.certificate import (
    Certificate,
    certify,
    measure_balls,
    measure_relief,
    open_pictures,
    under_cells,
)
from pipeline.diagnosis.lateral_resolution import LateralResolution
from pipeline.errors import CalibrationError
from pipeline.pattern import make_pattern
from pipeline.simulation import TYPICAL_CROSSTALK

Row = tuple[BallBar, float, Certificate, np.ndarray, list[tuple[LateralResolution, LateralResolution]]]
DIAMETER_MM, SPACINGS_MM = 60.0, (160.0, 140.0, 120.0, 100.0)
OFF_MM, ELSEWHERE = 0.005, 3
#: Blurs of the camera's lens that the corrugated plate is also seen through, px; captures have 0.5.
BLURS_PX = (0.3, 0.7, 1.0)


def main() -> None:
    """Print a row a rig, and what holds for all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=20)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    print("| rig | bar, mm | spacing | mean | flatness | without noise | U | elsewhere | contained | across | along |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    errors, flatness, ratios, laterals, blurred = [], [], [], [], []
    with TemporaryDirectory() as scratch, ProcessPoolExecutor(2) as pool:
        rows = pool.map(partial(certified_or_refused, options.folder or Path(scratch)), range(options.rigs))
        for seed, row in enumerate(rows):
            if isinstance(row, str):
                print(f"| {seed} | refused: {row} | | | | | | | | | |", flush=True)
                continue
            bar, off_mm, found, elsewhere, others = row
            true = np.array(found.spacing_errors_mm) - off_mm
            inside = np.abs(elsewhere) <= found.uncertainty_mm
            errors.append(np.abs(true).max())
            flatness.append((found.flatness.largest_mm, found.flatness.trueness_mm))
            ratios += [*(np.abs(elsewhere) / found.uncertainty_mm)]
            laterals.append([over_predicted(lateral) for lateral in found.lateral.values()])
            blurred.append([[over_predicted(lateral) for lateral in pair] for pair in others])
            print(
                f"| {seed} | {bar.spacing_mm:.0f} | {errors[-1]:.3f} | {true.mean():+.3f} | {flatness[-1][0]:.3f} "
                f"| {flatness[-1][1]:.3f} | {found.uncertainty_mm:.3f} | "
                f"{', '.join(f'{error:+.3f}' for error in elsewhere)} | {inside.sum()} of {len(inside)} "
                f"| {laterals[-1][0]:.2f} | {laterals[-1][1]:.2f} |",
                flush=True,
            )
    for name, of in (("median", np.median), ("worst", np.max)):
        largest, left = of(flatness, axis=0)
        print(f"| {name} | | {of(errors):.3f} | | {largest:.3f} | {left:.3f} | | | | | |")
    print(f"U contains {np.mean(np.array(ratios) <= 1):.1%} of the true errors, whose RMS is {rms(ratios):.2f} U")
    for blur_px, pairs in zip((0.5, *BLURS_PX), (laterals, *np.swapaxes(blurred, 0, 1)), strict=True):
        low, middle, high = np.quantile(pairs, (0, 0.5, 1), axis=0).round(2)
        print(f"lateral period limit over predicted, lens's blur {blur_px} px: median {middle}, {low} to {high}")


def over_predicted(lateral: LateralResolution) -> float:
    """Return the measured lateral period limit over the predicted one; NaN where it is shorter than all periods."""
    return np.nan if lateral.limit_mm is None else lateral.limit_mm / lateral.predicted_mm


def certified_or_refused(folder: Path, seed: int) -> Row | str:
    """Return what `certified` does, or why it refused the rig or its pictures."""
    try:
        return certified(folder, seed)
    except CalibrationError as error:
        return str(error)


def certified(folder: Path, seed: int) -> Row:
    """Return the bar, how much longer than certified it is, its certificate, its true errors elsewhere, and blurs'."""
    warnings.simplefilter("ignore")
    rng = np.random.default_rng([46, seed])
    truth = drawn_rig(rng)
    light = CaptureLight(gamma=rng.uniform(1.8, 2.4), crosstalk=np.array(TYPICAL_CROSSTALK), blur_px=0.5, noise=1.5)
    folder = folder / f"rig-{seed:02d}"
    file = folder / "calibration.json"
    if not file.exists():
        calibrated(folder, truth, light, seed).write(file)
    known = under_cells(Calibration.read(file))
    volume = Volume.before(known.geometry(), DISTANCE_MM)
    bar = next(bar for spacing in SPACINGS_MM if fits(bar := BallBar(DIAMETER_MM, spacing), volume))
    rng = np.random.default_rng([50, seed])
    true = BallBar(DIAMETER_MM, bar.spacing_mm + OFF_MM * rng.standard_normal())
    codes = make_pattern(PROJECTOR_PX, known.pattern, known.response)
    plate, relief = Plate.within(volume), Relief.within(volume)
    for artefact, held in ((bar, true), (plate, plate), (relief, relief)):
        capture = guided(folder, SimulatedStudio(held, truth=truth, light=light, seed=seed))
        capture.take_positions(list(artefact.positions(volume)), codes)
    pictures = open_pictures(folder, positions_in(volume, bar, relief=True))
    settings = DecodeSettings()
    found = certify(pictures, bar, 2 * OFF_MM, known, settings, "cpu", DISTANCE_MM)
    decoder, shown, elsewhere = Decoder(settings, known, arch="cpu"), np.rint(255 * codes) / np.float32(255), []
    for turn, place in places_in(volume, bar, rng):
        image = BarView(truth, true, turn, place, light, samples=3).photograph(shown, rng)
        frame, camera = decoder.decode(image), known.geometry().camera
        first, second = measure_balls(frame, bar.diameter_mm, 2, camera, settings.smoothing_px)
        elsewhere.append(np.linalg.norm(second.centre_mm - first.centre_mm) - true.spacing_mm)
    others = []
    for blur_px in BLURS_PX:
        for at in relief.positions(volume):
            view = ReliefView(truth, relief, at.turn, at.place_mm, replace(light, blur_px=blur_px), samples=3)
            frame = decoder.decode(view.photograph(shown, rng))
            others.append(measure_relief(frame, at, known.geometry(), settings.smoothing_px))
    pairs = list(zip(others[::2], others[1::2], strict=True))
    return bar, true.spacing_mm - bar.spacing_mm, found, np.array(elsewhere), pairs


def calibrated(folder: Path, truth: Calibration, light: CaptureLight, seed: int) -> Calibration:
    """Return a rig's calibration, by its own pictures of a sheet and a board."""
    sheet = guided(folder, SimulatedStudio(None, truth=truth, light=light, seed=seed))
    measured = measure_radiometry(CapturedFolder(sheet.take_light(), radiometry_sequence(PROJECTOR_PX).names))
    pattern = Pattern(period_px=PERIOD_PX, code="contrast")
    guide = PoseGuide(BOARD, CAMERA_PX, PROJECTOR_PX, pattern)
    guided(folder, SimulatedStudio(BOARD, truth=truth, light=light, seed=seed)).take_poses(BOARD, guide)
    return solve_geometry(guide.poses, CAMERA_PX, PROJECTOR_PX, pattern, measured.add_to(None)).calibration


def guided(folder: Path, studio: SimulatedStudio) -> GuidedCapture:
    """Return a capture whose rig is checked."""
    capture = GuidedCapture(studio, folder, {}, lambda line: None, lambda line: None)
    capture.check_rig()
    return capture


def fits(bar: BallBar, volume: Volume) -> bool:
    """Return whether a rig sees a bar whole in every position."""
    try:
        return bool(list(bar.positions(volume)))
    except CalibrationError:
        return False


def places_in(volume: Volume, bar: BallBar, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield turns and places of a bar that are drawn in the volume."""
    count = 0
    while count < ELSEWHERE:
        lean, spin = np.array([0, rng.uniform(-0.8, 0.8), 0]), np.array([0, 0, rng.uniform(-np.pi, np.pi)])
        turn = cv2.Rodrigues(cv2.Rodrigues(spin)[0] @ cv2.Rodrigues(lean)[0])[0].ravel()
        part = rng.uniform(0.92, 1.1)
        place = volume.middle_mm(part) + np.array([*rng.uniform(-1, 1, 2) * volume.half_field_mm(part), 0])
        if volume.holds(bar.outline_mm() @ cv2.Rodrigues(turn)[0].T + place):
            count += 1
            yield turn, place


def rms(values: list[float]) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
