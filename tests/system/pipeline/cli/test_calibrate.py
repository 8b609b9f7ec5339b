"""`colorphase calibrate ...` as its user meets it; what simulate makes, in `test_practice_set.py`."""

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.posed_boards import CAMERA_PX, exact_poses
from support.slide_shows import film

from pipeline.acquisition import practice_set
from pipeline.acquisition.practice_set import practice_rig
from pipeline.calibration import Calibration
from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import MeasuredPoses
from pipeline.cli import calibrate
from pipeline.cli.calibrate import captures_and_target
from pipeline.cli.main import command_line
from pipeline.cli.project import BoardOptions
from pipeline.errors import SettingsError
from pipeline.footage.image_file import read_image
from pipeline.models import SensorPart
from pipeline.output.range_image import write_png
from pipeline.recording.recorder import Recorder
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels.raw.pixel_format import PixelFormat

ARGUMENTS = ("calibrate", "geometry", "poses", "--board", "chessboard", "--squares", "10x7", "--code", "none")
SECOND = ("--second-board", "second", "--second-square-mm", "20")


def test_a_board_of_another_size_keeps_its_markers_share():
    options = BoardOptions("9x6", square_mm=20.0, marker_mm=14.0).with_square(30.0)
    assert options.board("charuco").square_mm == 30 and options.board("charuco").marker_mm == 21
    assert BoardOptions().with_square(30.0).marker_mm is None
    with pytest.raises(SettingsError, match="marker_mm must be less than square_mm"):
        BoardOptions(square_mm=20.0, marker_mm=21.0).board("charuco")


def test_captures_without_a_target_are_refused():
    assert captures_and_target(Path("a"), Path("b")) == (Path("a"), Path("b"))
    with pytest.raises(SettingsError, match="--make and a folder, or a folder of captures and --out"):
        captures_and_target(Path("a"), None)


def test_radiometry_command(folder, command):
    """Pictures out, captures in: here of a perfect camera that sees a third of the light."""
    done = command("calibrate", "radiometry", "--make", "ramps", "--size", "64x48", cwd=folder)
    assert done.returncode == 0, done.stderr
    for path in sorted((folder / "ramps").glob("*.png")):
        write_png(path, (0.3 * read_image(path) + 20).astype(np.uint8))
    done = command("calibrate", "radiometry", "ramps", "--out", "light.json", "--exposure-s", "0.01", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "good: response and crosstalk leave a ripple of 0.00" in done.stdout and "gamma is 1.0" in done.stdout
    assert "camera's transfer: linear" in done.stdout
    assert done.stdout.endswith("wrote light.json and light-radiometry.png\n")
    assert (folder / "light-radiometry.png").read_bytes().startswith(b"\x89PNG")
    done = command("pattern", "bright.png", "--calibration", "light.json", cwd=folder)
    assert done.returncode == 0 and json.loads((folder / "bright.json").read_text())["compensated"] is True
    done = command("calibrate", "radiometry", "ramps", "--out", "light.json", cwd=folder)
    assert done.returncode == 1 and "exists already" in done.stderr
    (folder / "ramps" / "07-red-224.png").unlink()
    done = command("calibrate", "radiometry", "ramps", "--out", "other.json", cwd=folder)
    assert done.returncode == 1 and "07-red-224.png" in done.stderr and not (folder / "other.json").exists()
    done = command("pattern", "board.pdf", "--board", "charuco", "--squares", "9x6", cwd=folder)
    assert done.returncode == 0 and (folder / "board.pdf").read_bytes().startswith(b"%PDF")


def test_captures_without_names(folder, command):
    """A recording of a slide show, and pictures under names of a camera, tell of the light what named captures do."""
    done = command("calibrate", "radiometry", "--make", "shown", "--size", "64x48", cwd=folder)
    assert done.returncode == 0, done.stderr
    paths = sorted((folder / "shown").glob("*.png"))
    crosstalk = np.array([[0.6, 0.06, 0.01], [0.08, 0.55, 0.1], [0.01, 0.12, 0.6]])
    lights = [255 * ((read_image(path) / 255) ** 2 @ crosstalk.T) + 10 for path in paths]
    frames, alone = film([lights[20], *lights, lights[5]], 1)
    with Recorder(folder / "show.zarr", PixelFormat("rgb")) as recorder:
        for frame in frames:
            recorder.add(frame)
    for place in ("named", "camera"):
        (folder / place).mkdir()
    for number, path in enumerate(paths):
        image = frames[alone.index(number + 1) + 1]
        write_png(folder / "named" / path.name, image)
        write_png(folder / "camera" / f"IMG_{number + 95}.png", image)
    found = {}
    for place in ("named", "camera", "show.zarr"):
        done = command("calibrate", "radiometry", place, "--out", f"{place}.json", cwd=folder)
        assert done.returncode == 0, done.stderr
        found[place] = json.loads((folder / f"{place}.json").read_text())
    assert found["camera"]["crosstalk_matrix"] == found["named"]["crosstalk_matrix"]
    for key, tolerance in (("crosstalk_matrix", 0.001), ("response", 0.001)):
        # Noise of a level in 3072 pixels makes 0.0001 of full scale.
        np.testing.assert_allclose(found["show.zarr"][key], found["named"][key], atol=tolerance)
        assert found["show.zarr"][key] != found["named"][key]
    (folder / "camera" / "IMG_101.png").unlink()
    for words, message in (
        (("radiometry", "camera"), "camera (32 frames): "),
        (("geometry", "show.zarr", *ARGUMENTS[3:]), "but are not the 12 of a pose"),
    ):
        done = command("calibrate", *words, "--out", "none.json", cwd=folder)
        assert done.returncode == 1 and message in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1 and not (folder / "none.json").exists()


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
    assert done.returncode == 1 and "determines no wavelength" in done.stderr and not (folder / "colors.json").exists()


@pytest.fixture
def posed(monkeypatch):
    """Have the corners of boards with squares of 26 and 20 mm found in the folders, whatever they are said to be."""

    def measured(folder, board, size_px, white_level, least=8):
        true_mm, count = (20.0, least) if folder == Path("second") else (26.0, 10)
        seen = exact_poses(count, 0.01, Board(kind="chessboard", squares=(10, 7), square_mm=true_mm))
        said = [
            type(pose)(**{**pose.__dict__, "corners_mm": pose.corners_mm * (board.square_mm / true_mm)})
            for pose in seen
        ]
        part = SensorPart(sensor_px=(2000, 1500), offset_px=(8, 6), binning=(1, 1))
        return MeasuredPoses(said, ("pose_99: no board is seen",), CAMERA_PX, part)

    monkeypatch.setattr(calibrate, "measure_poses", measured)


def test_a_verdict_follows_the_figures(posed, command, tmp_path):
    coded = (*ARGUMENTS[:-1], "contrast2", "--period", "8")
    done = command(*coded, "--square-mm", "26", *SECOND, "--out", "rig.json")
    assert done.returncode == 0, done.stderr
    assert "depth bias to be expected" in done.stdout and "note: pose_99: no board is seen" in done.stdout
    worst, verdict, scale, wrote = done.stdout.strip().splitlines()[-4:]
    assert worst.startswith("worst pose: pose_0") and "it does not stand out" in worst
    assert verdict.startswith("good: 9") and "mm per point" in verdict
    assert scale == "scale proven by the second board; camera and projector stand 180.0 mm apart"
    assert wrote == "wrote rig.json and rig-geometry.png"
    assert (tmp_path / "rig-geometry.png").read_bytes().startswith(b"\x89PNG")
    rig = Calibration.read(tmp_path / "rig.json")
    assert rig.scale_proof == "second board" and rig.sensor.offset_px == (8, 6)
    assert (rig.pattern.code, rig.pattern.period_px) == ("contrast2", 8)
    assert rig.pattern.cell_px == pytest.approx(rig.with_pattern(code="contrast2").pattern.cell_px)
    assert rig.pattern.cell_px > 4, "by the geometry, which has just been found"


def test_a_picture_that_cannot_be_written_is_one_line(posed, command, tmp_path):
    (tmp_path / "rig-geometry.png").mkdir()
    done = command(*ARGUMENTS, "--square-mm", "26", "--out", "rig.json")
    assert done.returncode == 1 and (tmp_path / "rig.json").exists()
    assert done.stderr == "error: cannot write rig-geometry.png: it is a folder: name a file in it\n"


def test_squares_that_are_wrong_by_a_quarter(posed, command, tmp_path):
    """Unproven they pass, and are said to be unproven; either proof refuses them in one line, and writes nothing."""
    wrong = (*ARGUMENTS, "--square-mm", "32.5", "--out", "rig.json")
    for proof, message in (
        (SECOND, "mm, not 20; if the second's are 20 mm, the first's are 26.0"),
        (("--baseline-mm", "180"), "the squares are then 0.80"),
    ):
        done = command(*wrong, *proof)
        assert done.returncode == 1 and message in done.stderr and len(done.stderr.strip().splitlines()) == 1
        assert not (tmp_path / "rig.json").exists()
    done = command(*wrong)
    assert done.returncode == 0, done.stderr
    assert "scale unproven: only --square-mm determines it, and camera and projector stand 225 mm apart" in done.stdout
    found = json.loads((tmp_path / "rig.json").read_text())
    assert found["scale_proof"] is None
    assert abs(np.linalg.norm(found["translation_mm"]) - 225) < 0.5


def test_half_a_second_board_is_refused(command):
    for half in (SECOND[:2], SECOND[2:]):
        done = command(*ARGUMENTS, "--out", "rig.json", *half)
        assert done.returncode == 1 and "give --second-board and --second-square-mm" in done.stderr


def test_it_says_what_is_true_and_what_comes_next(monkeypatch, command, tmp_path):
    """Sides, baseline and radius; and commands that the program understands."""

    def made(folder, arch, notify):
        folder.mkdir()
        return practice_rig()

    monkeypatch.setattr(practice_set, "write_practice", made)  # which takes a minute
    done = command("calibrate", "simulate", "--out", "my practice")
    assert done.returncode == 0, done.stderr
    first, _, *commands = done.stdout.strip().splitlines()
    assert "squares are 22 mm, the second board's 18 mm" in first and "stand 180 mm apart" in first
    assert "the ball's radius is 85 mm" in first
    assert [line.split()[1] for line in commands] == ["calibrate", "calibrate", "calibrate", "decode"]
    for line in commands:
        words = shlex.split(line)[1:]
        command_line(words).parse_args(words, exit_on_error=False, print_error=False)


def test_a_folder_that_is_there_is_refused(command, tmp_path):
    (tmp_path / "practice").mkdir()
    done = command("calibrate", "simulate", "--out", "practice")
    assert done.returncode == 1 and done.stderr == "error: practice exists already: choose another name\n"


def test_check_and_fix(folder, command):
    """A flat plane is fine; a calibration without its crosstalk is named and mended; nothing is overwritten."""
    truth = simulate_frame(simulated_rig((400, 300), period_px=1.6 * 768 / 44), SimulationSettings(scene="plane"))
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
        ("plane.png", "swapped.json", (), "the two are swapped"),
        ("plane.png", "calibration.json", (), "plane.png is 400x300 but the calibration is for 320x240"),
        ("plane.png", "old.json", ("--radius-mm", "40"), "add --shape ball"),
        ("many", "old.json", ("--shape", "plane"), "give one picture"),
        ("empty", "old.json", (), "holds no pictures"),
    ):
        done = command(*arguments[:2], what, "--calibration", rig, *options, cwd=folder)
        assert done.returncode == 1 and message in done.stderr and len(done.stderr.strip().splitlines()) == 1
    done = command(*arguments[:2], "nothing.png", *arguments[3:], cwd=folder)
    assert done.returncode == 1 and "cannot read nothing.png" in done.stderr


def test_touch_up(command, tmp_path):
    """Three tenths of a pixel are told, and taken out; pictures of another thing are one line."""
    known = simulated_rig((320, 240), code="contrast", period_px=2 * 768 / 44)
    known = known.model_copy(update={"crosstalk_matrix": SimulationSettings().crosstalk_matrix})
    matrix = known.projector.matrix.copy()
    matrix[1, 2] += 0.3
    rig = known.model_copy(update={"projector": known.projector.model_copy(update={"matrix": matrix})})
    for name, each in (("before", known), ("now", rig)):
        write_png(tmp_path / f"{name}.png", simulate_frame(each, SimulationSettings(scene="plane")).image)
    known.write(tmp_path / "calibration.json")
    arguments = ("calibrate", "touch-up", "now.png", "--calibration", "calibration.json", "--arch", "cpu")
    done = command(*arguments, "--before", "before.png", "--out", "new.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "the pattern has moved across the stripes by +0.3" in done.stdout or "by +0.29" in done.stdout
    assert done.stdout.endswith("wrote new.json\n")
    new = Calibration.read(tmp_path / "new.json")
    assert 0 < new.uncertainty.depth_bias_mm < 0.1
    write_png(tmp_path / "small.png", read_image(tmp_path / "before.png")[:120])
    done = command(*arguments, "--before", "small.png", "--out", "other.json", cwd=tmp_path)
    assert done.returncode == 1 and "small.png is 320x120 but the calibration is for" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and not (tmp_path / "other.json").exists()


def test_its_commands_are_named_with_what_they_do(folder, command):
    done = command("calibrate", "--help")
    assert done.returncode == 0
    for name in ("simulate", "radiometry", "wavelengths", "geometry", "check", "touch-up"):
        assert f"│ {name} " in done.stdout, name


def test_a_calibration_is_converted_for_a_camera_that_bins_a_part_of_its_sensor(command, tmp_path):
    """In the region's pixels first, and then binned."""
    whole = simulated_rig((320, 240), code="contrast", period_px=2 * 768 / 44)
    whole.write(tmp_path / "calibration.json")
    options = ("--region", "32,16,256,208", "--binning", "2x2", "--out", "new.json")
    done = command("calibrate", "import", "calibration.json", *options, cwd=tmp_path)
    assert done.returncode == 0 and "camera 128x104, projector 1024x768, 180.0 mm apart" in done.stdout, done.stderr
    found = Calibration.read(tmp_path / "new.json")
    assert found.digest() == whole.cropped(32, 16, (256, 208)).binned(2, 2).digest()
    done = command(
        "calibrate", "import", "calibration.json", *options[:-1], "coded.json", "--code", "contrast2", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert Calibration.read(tmp_path / "coded.json").digest() == found.with_pattern(code="contrast2").digest()
    assert found.with_pattern(code="contrast2").pattern.cell_px > whole.with_pattern(code="contrast2").pattern.cell_px
    for wrong, message in (
        (("--region", "32,16,300,208"), "300x208 px at 32,16 stick out of the camera's 320x240"),
        (("--region", "32,16,0,208"), "give x,y,width,height in px"),
        (("--binning", "2"), "--binning is '2': give width and height"),
    ):
        done = command("calibrate", "import", "calibration.json", *wrong, "--out", "other.json", cwd=tmp_path)
        assert done.returncode == 1 and message in done.stderr
