"""`colorphase certify` on the simulated rig, which it knows by that rig's own calibration only."""

import json
import shutil

import numpy as np
import pytest

from pipeline.acquisition.simulated_studio import LIGHT, BarView, ReliefView, SheetView
from pipeline.diagnosis.artefacts import BallBar, Relief, Volume, positions_in
from pipeline.diagnosis.certificate import under_cells
from pipeline.output.range_image import write_png
from pipeline.pattern import make_pattern
from pipeline.simulation import own_calibration, simulated_truth

BAR, TRUE_BAR = BallBar(60.0, 160.0), BallBar(60.01, 160.02)
OPTIONS = ("--calibration", "calibration.json", "--reference-mm", "0.02", "--arch", "cpu")
GIVEN = ("--diameter-mm", "60", "--spacing-mm", "160")


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """Return a folder with the pictures, which are taken with the true rig, and its own calibration."""
    folder = tmp_path_factory.mktemp("certified")
    known, truth = under_cells(own_calibration()), simulated_truth()
    geometry, rng = known.geometry(), np.random.default_rng(0)
    codes = np.rint(255 * make_pattern(geometry.projector.size_px, geometry.pattern, known.response)) / np.float32(255)
    (folder / "pictures").mkdir()
    volume = Volume.before(geometry, None)
    for position in positions_in(volume, BAR, relief=True):
        where = (position.turn, position.place_mm + rng.normal(0, 5, 3), LIGHT, 1)
        if position.name.startswith("bar"):
            view = BarView(truth, TRUE_BAR, *where)
        elif position.name.startswith("relief"):
            view = ReliefView(truth, Relief.within(volume), *where[:-1], 3)
        else:
            view = SheetView(truth, *where)
        write_png(folder / "pictures" / f"{position.name}.png", view.photograph(codes, rng))
    own_calibration().write(folder / "calibration.json")
    return folder


def test_a_rig_is_certified_blind(command, certified):
    done = command("certify", "pictures", *GIVEN, *OPTIONS, "--out", "certificate.json", cwd=certified)
    assert done.returncode == 0, done.stderr
    for words in ("probing error, form", "sphere spacing error", "flatness measurement error", "U (k = 2)"):
        assert words in done.stdout
    found = json.loads((certified / "certificate.json").read_text())
    true_mm = np.array(found["spacing_errors_mm"]) - (TRUE_BAR.spacing_mm - BAR.spacing_mm)
    assert len(true_mm) == 7 and np.abs(true_mm).max() < min(0.15, found["uncertainty_mm"])
    assert found["uncertainty_mm"] < 0.15 and set(found["budget_mm"]) == {
        "reference", "calibration", "noise of the fit", "position in the volume",
    }  # fmt: skip
    assert found["budget_mm"]["reference"] == pytest.approx(0.01)
    assert found["flatness"]["trueness_mm"] < 0.08 and found["form"]["trueness_mm"] < 0.08
    assert abs(found["size"]["trueness_mm"]) < 0.2
    assert 0.02 < found["noise_mm"] < 2 * found["noise_predicted_mm"]
    assert set(found["lateral"]) == {"across", "along"}
    for direction, lateral in found["lateral"].items():
        assert f"lateral resolution {direction} the stripes: {lateral['limit_mm']:.2f} mm, U (k = 2)" in done.stdout
        assert lateral["limit_mm"] == pytest.approx(lateral["predicted_mm"], rel=0.12)
        assert lateral["sigma_mm"] < 0.1 and len(lateral["transfer"]) == len(lateral["periods_mm"]) == 11


def test_without_a_corrugated_plate_lateral_resolution_is_not_measured(command, certified, tmp_path):
    ignored = shutil.ignore_patterns("relief-*")
    shutil.copytree(certified, tmp_path, ignore=ignored, dirs_exist_ok=True)
    done = command("certify", "pictures", *GIVEN, *OPTIONS, "--out", "without.json")
    assert done.returncode == 0, done.stderr
    assert "lateral resolution: not measured, as there are no pictures of a corrugated plate" in done.stdout
    assert json.loads((tmp_path / "without.json").read_text())["lateral"] == {}


@pytest.mark.parametrize(
    ("swapped", "given", "message"),
    [
        ((), ("--diameter-mm", "56", "--spacing-mm", "160"), "bar-1: a ball's diameter is 60.0 mm, not 56: give"),
        ((), ("--diameter-mm", "60", "--spacing-mm", "163"), "bar-1: the balls are 160.0 mm apart, not 163: give"),
        ((), ("--diameter-mm", "20", "--spacing-mm", "160"), "bar-1: no ball is found, 20 mm in diameter: show"),
        (("bar-1", "bar-4"), GIVEN, "bar-1: it is held as bar-4 should be"),
        (("bar-2", "plane-1"), GIVEN, "bar-2: no ball is found"),
        (
            ("plane-1", "plane-6"),
            GIVEN,
            "plane-1: it is held as plane-6 should be: hold it facing the camera",
        ),
        (("plane-2", "plane-3"), GIVEN, "plane-2 must be nearer than plane-1, and plane-3 farther: they are 9"),
        (("relief-1", "relief-2"), GIVEN, "relief-1: 0% of the height of corrugations 10 mm long is seen: show the"),
        (("relief-2", "plane-1"), GIVEN, "relief-2: 0% of the height of corrugations 10 mm long is seen: show the"),
        (
            ("relief-2", None),
            GIVEN,
            "pictures lacks relief-2.png: hold it facing the camera, its ridges at right angles",
        ),
        (("plane-1", None), GIVEN, "pictures lacks plane-1.png: hold it facing the camera, at the middle distance"),
    ],
)
def test_what_is_wrong_is_one_line(command, certified, tmp_path, swapped, given, message):
    shutil.copytree(certified / "pictures", tmp_path / "pictures")
    shutil.copy(certified / "calibration.json", tmp_path)
    if swapped:
        name, other = swapped
        (tmp_path / "pictures" / f"{name}.png").unlink()
        if other is not None:
            shutil.copy(certified / "pictures" / f"{other}.png", tmp_path / "pictures" / f"{name}.png")
    done = command("certify", "pictures", *given, *OPTIONS)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode == 1 and len(errors) == 1 and message in errors[0], done.stderr


def test_without_a_calibration_it_says_what_to_give(command):
    done = command("certify", "pictures", *GIVEN, "--reference-mm", "0.02")
    assert done.returncode == 1 and "give --calibration, or --rig" in done.stderr
