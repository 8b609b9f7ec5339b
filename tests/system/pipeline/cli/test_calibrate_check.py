"""`colorphase calibrate check` as its user meets it."""

import json
import shutil

import numpy as np

from pipeline.output.range_image import write_png
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig


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
        ("empty", "old.json", (), "holds no pictures"),
    ):
        done = command(*arguments[:2], what, "--calibration", rig, *options, cwd=folder)
        assert done.returncode == 1 and message in done.stderr and len(done.stderr.strip().splitlines()) == 1
    done = command(*arguments[:2], "nothing.png", *arguments[3:], cwd=folder)
    assert done.returncode == 1 and "cannot read nothing.png" in done.stderr
