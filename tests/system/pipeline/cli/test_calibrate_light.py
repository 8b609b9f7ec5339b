"""`colorphase calibrate radiometry` and `wavelengths` as their user meets them."""

import json

import numpy as np

from pipeline.footage.image_file import read_image
from pipeline.output.range_image import write_png
from pipeline.simulation import simulated_rig


def test_radiometry_command(folder, command):
    """Pictures out, captures in: here of a perfect camera that sees a third of the light."""
    done = command("calibrate", "radiometry", "--make", "ramps", "--size", "64x48", cwd=folder)
    assert done.returncode == 0, done.stderr
    for path in sorted((folder / "ramps").glob("*.png")):
        write_png(path, (0.3 * read_image(path) + 20).astype(np.uint8))
    done = command("calibrate", "radiometry", "ramps", "--out", "light.json", "--exposure-s", "0.01", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "good: response and crosstalk leave a ripple of 0.00" in done.stdout and "gamma is 1.0" in done.stdout
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
