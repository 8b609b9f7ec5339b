"""The command line as its user meets it: what it makes, what it refuses, and that nothing half-written stays."""

import json
import os
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import zarr

from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.decoding.frame import FIELDS
from pipeline.footage.image_file import read_image
from pipeline.output.mesh_files import read_mesh
from pipeline.output.range_image import write_png
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime


def colorphase(*arguments, cwd):
    """Run the command in a process of its own."""
    code = "import sys; from pipeline.cli.main import main; sys.argv[0] = 'colorphase'; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "COLUMNS": "200"},
        check=False,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a frame of our own simulator, its calibration, and a black picture."""
    runtime.init("cpu")
    folder = tmp_path_factory.mktemp("cli")
    rig = simulated_rig((320, 240), period_px=2 * 768 / 44)
    settings = SimulationSettings()
    write_png(folder / "frame.png", simulate_frame(rig, settings).image)
    rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix}).write(folder / "calibration.json")
    write_png(folder / "black.png", np.zeros((64, 64, 3), np.uint8))
    (folder / "settings.toml").write_text("smoothing_px = 3\n")
    (folder / "pictures").mkdir()
    shutil.copy(folder / "frame.png", folder / "pictures")
    return folder


def test_decode_with_a_calibration(folder):
    done = colorphase(
        *("decode", "frame.png", "--out", "mm", "--calibration", "calibration.json"),
        *("--settings", "settings.toml", "--arch", "cpu"),
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    out = folder / "mm"
    assert sorted(p.name for p in out.iterdir()) == [
        "mesh.ply",
        "range.png",
        "report.json",
        "result.zarr",
        "shaded.png",
    ]
    report = json.loads((out / "report.json").read_text())
    assert report["range_unit"] == "mm"
    assert report["settings"]["smoothing_px"] == 3
    assert report["warnings"] == []
    group = zarr.open_group(out / "result.zarr", mode="r")
    assert group.metadata.zarr_format == 3
    assert set(group.array_keys()) == {*FIELDS, "done"}
    assert group.attrs["calibration_sha256"] == report["calibration_sha256"]
    for name in FIELDS:
        assert group[name].shape[0] == 1
        assert group[name].chunks == group[name].shape
    mask = group["mask"][0]
    mesh = read_mesh(out / "mesh.ply")
    assert len(mesh.vertices) == mask.sum() == np.isfinite(group["points"][0]).all(axis=-1).sum()
    assert mesh.unit == "mm"
    assert read_image(out / "range.png").shape[0] == 240


def test_decode_without_one_is_relative(folder):
    done = colorphase("decode", "frame.png", "--out", "rad", "--arch", "cpu", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert json.loads((folder / "rad" / "report.json").read_text())["range_unit"] == "rad"
    assert read_mesh(folder / "rad" / "mesh.ply").unit == "rad"
    assert "points" not in set(zarr.open_group(folder / "rad" / "result.zarr", mode="r").array_keys())
    # Our own results may be replaced.
    again = colorphase("decode", "frame.png", "--out", "rad", "--arch", "cpu", cwd=folder)
    assert again.returncode == 0, again.stderr


def test_a_frame_without_fringes(folder):
    done = colorphase("decode", "black.png", "--out", "none", "--arch", "cpu", cwd=folder)
    assert done.returncode == 1
    assert "no fringe stands out" in done.stderr
    assert "Traceback" not in done.stderr
    assert json.loads((folder / "none" / "report.json").read_text())["valid_fraction"] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("decode", "no.png", "--out", "x"), "cannot read no.png"),
        (("decode", "settings.toml", "--out", "x"), "is not a video that can be read"),
        (("decode", "nowhere", "--out", "x"), "there is no such file"),
        (("decode", "pictures", "--out", "frame.png", "--arch", "cpu"), "its folder is a file"),
        (("decode", "pictures", "--out", "."), "holds something else"),
        (("decode", "black.png", "--out", "x", "--calibration", "calibration.json"), "recalibrate or crop"),
        (("decode", "frame.png", "--out", "x", "--calibration", "settings.toml"), "not what it should be"),
        (("decode", "frame.png", "--out", "x", "--settings", "calibration.json"), "not what it should be"),
        (("decode", "frame.png", "--out", "frame.png"), "is a file"),
        (("decode", "frame.png", "--out", "frame.png/x"), "its folder is a file"),
        (("decode", "frame.png", "--out", "."), "holds something else"),
        (("decode", "frame.png", "--out", "x", "--arch", "abacus"), "Invalid value"),
        (("decode", "frame.png", "--out", "x", "--roi", "0,0,64,64"), "options are for footage"),
        (("decode", "pictures", "--out", "x", "--fields", "mask", "--export", "ply"), "made of range_image: add that"),
        (("decode", "pictures", "--out", "memory://x", "--export", "ply"), "run colorphase export"),
        (("capture", "--rig", "simulated", "--out", "x", "--settings", "settings.toml"), "add --live, or leave"),
        (("capture", "--rig", "black.png", "--out", "x"), "black.png is not what it should be: it is no text file"),
        (("render", "frame.png", "--out", "x.png"), "PLY"),
        (("render", "none.ply", "--out", "x.png"), "cannot read none.ply"),
        (("render", "none.ply", "--out", "x.gif"), "name it .png, or give a result.zarr"),
        (("pattern", "x.png", "--size", "wide"), "as in 1024x768"),
        (("pattern", "x.png", "--period", "1"), "period_px"),
        (("pattern", "x/y.png"), "create the folder first"),
        (("pattern", "x.png", "--period", "0"), "period_px"),
        (("pattern", "x.pdf", "--board", "charuco", "--squares", "30x20", "--dictionary", "DICT_4X4_50"), "50 markers"),
        (("calibrate", "radiometry", ".", "--out", "x/y.json"), "create the folder first"),
        (("calibrate", "radiometry", ".", "--out", "y.json", "--exposure-s", "0"), "exposure_s"),
    ],
)
def test_mistakes_get_one_line_and_leave_nothing(folder, arguments, message):
    before = sorted(p.name for p in folder.iterdir())
    done = colorphase(*arguments, cwd=folder)
    assert done.returncode != 0
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    assert message in lines[0]
    assert sorted(p.name for p in folder.iterdir()) == before


def test_a_jpeg_is_read_as_footage_is(folder):
    """From its planes, which costs less than the RGB that libraries make of them; and damage is told."""
    jpeg = cv2.imencode(".jpg", cv2.imread(str(folder / "frame.png")))[1].tobytes()
    (folder / "frame.jpg").write_bytes(jpeg)
    (folder / "broken.jpg").write_bytes(jpeg[:5000] + bytes(2000) + jpeg[7000:])
    done = colorphase("decode", "frame.jpg", "--out", "jpeg", "--calibration", "calibration.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    decoder = Decoder(DecodeSettings(), Calibration.read(folder / "calibration.json"), arch="cpu")
    expected = decoder.decode(read_image(folder / "frame.png"))
    by_library = decoder.decode(read_image(folder / "frame.jpg"))
    stored = zarr.open_group(folder / "jpeg" / "result.zarr", mode="r")
    both = expected.mask & by_library.mask & stored["mask"][0]
    assert both.mean() > 0.3

    def error(phase):
        return np.sqrt(np.mean(np.angle(np.exp(1j * (phase - expected.wrapped_phase)[both])) ** 2))

    assert error(stored["wrapped_phase"][0]) < 0.95 * error(by_library.wrapped_phase)
    refused = colorphase("decode", "broken.jpg", "--out", "broken", cwd=folder)
    assert refused.returncode == 1 and "damaged" in refused.stderr and len(refused.stderr.splitlines()) == 1
    assert not (folder / "broken").exists()


def test_demo_pattern_and_devices(folder):
    done = colorphase("demo", "--out", "demo", "--arch", "cpu", cwd=folder)
    assert done.returncode == 0, done.stderr
    report = json.loads((folder / "demo" / "report.json").read_text())
    truth = report["against_truth"]
    assert truth["wrong_orders"] == 0
    assert truth["phase_rms_rad"] < 0.05
    assert truth["depth_rms_mm"] < 0.5
    assert truth["coverage"] > 0.95
    assert f"{truth['depth_rms_mm']:.3f} mm" in done.stdout
    assert (folder / "demo" / "shaded.png").exists()
    assert (folder / "demo" / "render.png").exists() or "install" in done.stderr
    assert colorphase("pattern", "pattern.png", "--size", "320x240", cwd=folder).returncode == 0
    assert read_image(folder / "pattern.png").shape == (240, 320, 3)
    listed = colorphase("devices", cwd=folder)
    assert listed.returncode == 0
    assert "cpu" in listed.stdout
    assert runtime.kernel_language() in listed.stdout


@pytest.mark.parametrize("command", ["demo", "pattern", "decode", "render", "devices"])
def test_help_has_an_example(folder, command):
    done = colorphase(command, "--help", cwd=folder)
    assert done.returncode == 0
    assert f"Example: colorphase {command}" in done.stdout


def test_check_and_fix(folder):
    """A flat plane is fine; a calibration without its crosstalk is named and mended; nothing is overwritten."""
    runtime.init("cpu")
    truth = simulate_frame(simulated_rig(), SimulationSettings(scene="plane"))
    write_png(folder / "plane.png", truth.image)
    truth.rig.model_copy(update={"crosstalk_matrix": np.eye(3)}).write(folder / "old.json")
    arguments = ("calibrate", "check", "plane.png", "--calibration", "old.json", "--arch", "cpu")
    done = colorphase(*arguments, "--shape", "plane", "--fix", "new.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "flatness" in done.stdout and "crosstalk" in done.stdout and "response" in done.stdout
    matrix = np.array(json.loads((folder / "new.json").read_text())["crosstalk_matrix"])
    np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-6)
    assert 0.05 < matrix[1, 0] < 0.15
    done = colorphase(*arguments, "--fix", "new.json", cwd=folder)
    assert done.returncode == 1 and "exists already" in done.stderr and "Traceback" not in done.stderr
    (folder / "many").mkdir()
    for k in range(12):
        shutil.copy(folder / "frame.png", folder / "many" / f"{k:02d}.png")
    done = colorphase(*arguments[:2], "many", "--calibration", "calibration.json", cwd=folder)
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
        done = colorphase(*arguments[:2], what, "--calibration", rig, *options, cwd=folder)
        assert done.returncode == 1 and message in done.stderr and len(done.stderr.strip().splitlines()) == 1
    done = colorphase(*arguments[:2], "nothing.png", *arguments[3:], cwd=folder)
    assert done.returncode == 1 and "cannot read nothing.png" in done.stderr


def test_radiometry_command(folder):
    """Pictures out, captures in: here of a perfect camera that sees a third of the light."""
    done = colorphase("calibrate", "radiometry", "--make", "ramps", "--size", "64x48", cwd=folder)
    assert done.returncode == 0, done.stderr
    for path in sorted((folder / "ramps").glob("*.png")):
        write_png(path, (0.3 * read_image(path) + 20).astype(np.uint8))
    done = colorphase("calibrate", "radiometry", "ramps", "--out", "light.json", "--exposure-s", "0.01", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "camera's transfer: linear" in done.stdout and (folder / "light-radiometry.png").exists()
    done = colorphase("pattern", "bright.png", "--calibration", "light.json", cwd=folder)
    assert done.returncode == 0 and json.loads((folder / "bright.json").read_text())["compensated"] is True
    done = colorphase("calibrate", "radiometry", "ramps", "--out", "light.json", cwd=folder)
    assert done.returncode == 1 and "exists already" in done.stderr
    (folder / "ramps" / "07-red-112.png").unlink()
    done = colorphase("calibrate", "radiometry", "ramps", "--out", "other.json", cwd=folder)
    assert done.returncode == 1 and "07-red-112.png" in done.stderr and not (folder / "other.json").exists()
    done = colorphase("pattern", "board.pdf", "--board", "charuco", "--squares", "9x6", cwd=folder)
    assert done.returncode == 0 and (folder / "board.pdf").read_bytes().startswith(b"%PDF")


def test_names_are_printed_as_they_are(folder):
    """Brackets and colons are not markup."""
    for name in ("no [red] film", "no [/film].png", "a :smile:.ply"):
        for command in (("decode", name, "--out", "x"), ("render", name, "--out", "x.png")):
            done = colorphase(*command, cwd=folder)
            assert done.returncode == 1 and f"cannot read {name}" in done.stderr, done.stderr
    done = colorphase("decode", "x", "--out", "x", "--arch", "[/red]", cwd=folder)
    assert done.returncode == 2 and 'Invalid value "[/red]"' in done.stderr, done.stderr


def test_decode_footage(folder):
    """Bad frames are told by number and by the exit code; a second run finds everything else done."""
    film = folder / "film é 1"
    film.mkdir()
    for name in ("f1.png", "f2.png", "f10.png"):
        shutil.copy(folder / "frame.png", film / name)
    (film / "f3.png").write_bytes((folder / "frame.png").read_bytes()[:1000])
    options = ("--out", "footage", "--arch", "cpu", "--calibration", "calibration.json", "--fields", "points", "mask")
    done = colorphase("decode", film, *options, cwd=folder)
    assert done.returncode == 3, done.stderr
    assert "frame 2 is bad" in done.stderr and "truncated" in done.stderr
    assert "3 of 4 frames decoded; they are in footage/result.zarr" in done.stdout
    group = zarr.open_group(folder / "footage" / "result.zarr", mode="r")
    assert group["points"].shape == (4, 240, 320, 3)
    again = colorphase("decode", film, *options, cwd=folder)
    assert again.returncode == 3 and "3 of them before" in again.stdout
    for arguments, message in [
        (("--settings", "settings.toml"), r"settings.smoothing_px is 5 there, 3 here"),
        (("--roi", "1,2,3"), "give x,y,width,height"),
        (("--roi", "0,0,00,²"), "give x,y,width,height"),
        (("--roi", "0,0,400,100"), "sticks out of the 320x240 frame"),
        (("--fields", "depth"), "no field is called 'depth'"),
        (("--step", "0"), "must be 1 or more"),
        (("--start", "9"), "none of which is asked for"),
    ]:
        refused = colorphase("decode", film, *options, *arguments, cwd=folder)
        assert refused.returncode in (1, 2) and message in refused.stderr, refused.stderr
        assert "Traceback" not in refused.stderr
    with_meshes = colorphase("decode", film, *options, "--export", "glb", cwd=folder)
    assert with_meshes.returncode == 3 and "3 meshes in footage/meshes" in with_meshes.stdout, with_meshes.stderr
    names = sorted(path.name for path in (folder / "footage" / "meshes").iterdir())
    assert names == ["frame_000000.glb", "frame_000001.glb", "frame_000003.glb"]
    strict = colorphase("decode", film, *options[2:], "--out", "strict", "--strict", cwd=folder)
    assert strict.returncode == 1 and "frame 2 of" in strict.stderr
    picture = colorphase("decode", "frame.png", "--out", "footage", "--force", cwd=folder)
    assert picture.returncode == 1 and "holds the frames of footage" in picture.stderr
