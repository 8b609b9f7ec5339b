"""`colorphase calibrate` as its user meets it."""

import json
import shutil

import numpy as np

from pipeline.cli.calibrate import _scale_note
from pipeline.footage.image_file import read_image
from pipeline.output.range_image import write_png
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig


def test_radiometry_command(folder, command):
    """Pictures out, captures in: here of a perfect camera that sees a third of the light."""
    done = command("calibrate", "radiometry", "--make", "ramps", "--size", "64x48", cwd=folder)
    assert done.returncode == 0, done.stderr
    for path in sorted((folder / "ramps").glob("*.png")):
        write_png(path, (0.3 * read_image(path) + 20).astype(np.uint8))
    done = command("calibrate", "radiometry", "ramps", "--out", "light.json", "--exposure-s", "0.01", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "camera's transfer: linear" in done.stdout and (folder / "light-radiometry.png").exists()
    done = command("pattern", "bright.png", "--calibration", "light.json", cwd=folder)
    assert done.returncode == 0 and json.loads((folder / "bright.json").read_text())["compensated"] is True
    done = command("calibrate", "radiometry", "ramps", "--out", "light.json", cwd=folder)
    assert done.returncode == 1 and "exists already" in done.stderr
    (folder / "ramps" / "07-red-112.png").unlink()
    done = command("calibrate", "radiometry", "ramps", "--out", "other.json", cwd=folder)
    assert done.returncode == 1 and "07-red-112.png" in done.stderr and not (folder / "other.json").exists()
    done = command("pattern", "board.pdf", "--board", "charuco", "--squares", "9x6", cwd=folder)
    assert done.returncode == 0 and (folder / "board.pdf").read_bytes().startswith(b"%PDF")


def test_wavelengths_command(folder, command):
    """Pictures out; a chart of greys alone tells nothing, nine numbers from data sheets do."""
    done = command("calibrate", "wavelengths", "--make", "fields", "--size", "64x48", cwd=folder)
    assert done.returncode == 0 and sorted(path.name for path in (folder / "fields").glob("*.png")) == [
        "0-black.png",
        "1-red.png",
        "2-green.png",
        "3-blue.png",
    ]
    simulated_rig().model_copy(update={"crosstalk_matrix": np.eye(3)}).write(folder / "uncolored.json")
    known = ("calibrate", "wavelengths", "--calibration", "uncolored.json", "--out", "nine.json")
    nine = ("625", "553", "462", "622", "536", "468", "628", "515", "462")
    done = command(*known, "--nm", *nine, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert json.loads((folder / "nine.json").read_text())["wavelengths_nm"][1] == [622, 536, 468]
    done = command(*known[:-1], "colors.json", "--nm", *nine[::-1], cwd=folder)
    assert done.returncode == 1 and "wavelengths_nm must lie from 380 to 780" in done.stderr
    done = command(*known[:-1], "colors.json", "fields", cwd=folder)
    assert done.returncode == 1 and "--spectra and --corners" in done.stderr
    rows = [",".join([str(nm), *["0.5"] * 24]) for nm in range(400, 701, 50)]
    (folder / "chart.csv").write_text("\n".join(rows) + "\n")
    chart = ("--spectra", "chart.csv", "--corners", "5", "5", "58", "5", "58", "42", "5", "42")
    for path in (folder / "fields").glob("*.png"):
        write_png(path, (0.3 * read_image(path) + 20).astype(np.uint8))
    done = command(*known[:-1], "colors.json", "fields", *chart, cwd=folder)
    assert done.returncode == 1 and "tells no wavelength" in done.stderr and not (folder / "colors.json").exists()


def test_check_and_fix(folder, command):
    """A flat plane is fine; a calibration without its crosstalk is named and mended; nothing is overwritten."""
    truth = simulate_frame(simulated_rig(), SimulationSettings(scene="plane"))
    write_png(folder / "plane.png", truth.image)
    truth.rig.model_copy(update={"crosstalk_matrix": np.eye(3)}).write(folder / "old.json")
    arguments = ("calibrate", "check", "plane.png", "--calibration", "old.json", "--arch", "cpu")
    done = command(*arguments, "--shape", "plane", "--fix", "new.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "flatness" in done.stdout and "crosstalk" in done.stdout and "response" in done.stdout
    matrix = np.array(json.loads((folder / "new.json").read_text())["crosstalk_matrix"])
    np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-6)
    assert 0.05 < matrix[1, 0] < 0.15
    done = command(*arguments, "--fix", "new.json", cwd=folder)
    assert done.returncode == 1 and "exists already" in done.stderr and "Traceback" not in done.stderr
    (folder / "many").mkdir()
    for k in range(12):
        shutil.copy(folder / "frame.png", folder / "many" / f"{k:02d}.png")
    done = command(*arguments[:2], "many", "--calibration", "calibration.json", cwd=folder)
    assert done.returncode == 0 and "12 frames: nothing found" in done.stdout, done.stderr
    assert "to and fro" in done.stdout  # frames of what stands still tell nothing of motion
    swapped = truth.rig.model_copy(update={"camera": truth.rig.projector, "projector": truth.rig.camera})
    swapped.write(folder / "swapped.json")
    (folder / "empty").mkdir()
    for what, rig, options, message in (
        ("plane.png", "swapped.json", (), "camera and projector are swapped"),
        ("plane.png", "calibration.json", (), "plane.png is 640x480 px but the calibration is for a camera of 320x240"),
        ("plane.png", "old.json", ("--radius-mm", "40"), "add --shape ball"),
        ("many", "old.json", ("--shape", "plane"), "take one picture"),
        ("empty", "old.json", (), "holds 0 pictures"),
    ):
        done = command(*arguments[:2], what, "--calibration", rig, *options, cwd=folder)
        assert done.returncode == 1 and message in done.stderr and len(done.stderr.strip().splitlines()) == 1
    done = command(*arguments[:2], "nothing.png", *arguments[3:], cwd=folder)
    assert done.returncode == 1 and "cannot read nothing.png" in done.stderr


def test_a_scale_that_only_the_squares_tell_is_said_to_be_so():
    note = _scale_note(np.array([-180.0, 0.0, 20.0]))
    assert "camera and projector stand 181 mm apart by it; measure that, and give it as --baseline-mm" in note
