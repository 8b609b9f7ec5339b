"""`colorphase decode` as its user meets it: what it makes, and that nothing half-written stays."""

import json
import shutil

import cv2
import numpy as np
import pytest
import zarr
from support.command_line import colorphase

from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.decoding.frame import FIELDS
from pipeline.footage.image_file import read_image
from pipeline.output.mesh import FILLED, RIM
from pipeline.output.mesh_files import read_mesh
from pipeline.output.store import in_bytes


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
    assert set(group.array_keys()) == {*FIELDS, "done", "frame", "y", "x", "xyz", "rgb"}
    assert group.attrs["calibration_sha256"] == report["calibration_sha256"]
    for name in FIELDS:
        assert group[name].shape[0] == 1
        assert group[name].chunks == group[name].shape
    mask = group["mask"][0]
    mesh = read_mesh(out / "mesh.ply")
    assert mask.sum() == np.isfinite(group["points"][0]).all(axis=-1).sum()
    measured = mesh.flags & (FILLED | RIM) != FILLED
    assert 0.97 * mask.sum() < measured.sum() <= mask.sum()
    assert mesh.unit == "mm"
    assert mesh.provenance["source"] == "frame.png"
    assert mesh.provenance["calibration_sha256"] == report["calibration_sha256"]
    assert json.loads(mesh.provenance["settings"])["smoothing_px"] == 3
    assert report["mesh"]["vertices"] == len(mesh.vertices) and report["mesh"]["triangles"] == len(mesh.faces)
    assert report["mesh"]["filled"] == (mesh.flags & (FILLED | RIM) == FILLED).sum()
    assert report["mesh"]["rim"] == (mesh.flags & RIM != 0).sum() > 0
    assert read_image(out / "range.png").shape[0] == 240


def test_a_part_of_the_surface_becomes_the_mesh(folder, command):
    rig = ("--calibration", "calibration.json", "--arch", "cpu")
    box = ("--crop", "-40", "-40", "1", "60", "30", "5000")
    done = command("decode", "frame.png", "--out", "part", *rig, *box, "--triangles", "500", cwd=folder)
    assert done.returncode == 0, done.stderr
    mesh = read_mesh(folder / "part" / "mesh.ply")
    assert (mesh.vertices >= (-40, -40, 1)).all() and (mesh.vertices <= (60, 30, 5000)).all()
    counts = json.loads((folder / "part" / "report.json").read_text())["mesh"]
    assert 0 < len(mesh.faces) <= 500 and counts["triangles"] == len(mesh.faces) and counts["cropped"] > 1000
    (folder / "still").mkdir()
    shutil.copy(folder / "frame.png", folder / "still" / "frame.png")
    for arguments, message in [
        (("frame.png", *box), "can be left out of a mesh in mm only: give a calibration"),
        (("frame.png", *rig, "--crop", "5", "0", "0", "1", "9", "9"), "crop"),
        (("frame.png", *rig, "--triangles", "0"), "must be 1 or more"),
        (("still", *rig, *box), "--crop, --no-background and --triangles are for meshes: add --export, or omit them"),
        (("still", "--export", "pcd"), "is in mm: give a --calibration that holds the geometry"),
    ]:
        refused = command("decode", *arguments, "--out", "refused", cwd=folder)
        assert refused.returncode in (1, 2) and message in refused.stderr, refused.stderr
        assert refused.stderr.count("\n") == 1 and not (folder / "refused").exists()


def test_decode_without_one_is_relative(folder, command):
    done = command("decode", "frame.png", "--out", "rad", "--arch", "cpu", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert json.loads((folder / "rad" / "report.json").read_text())["range_unit"] == "rad"
    assert (
        "depth is relative, in rad of phase and not in mm: give a --calibration with the rig's geometry" in done.stdout
    )
    assert read_mesh(folder / "rad" / "mesh.ply").unit == "rad"
    assert "points" not in set(zarr.open_group(folder / "rad" / "result.zarr", mode="r").array_keys())
    # Our own results may be replaced.
    again = command("decode", "frame.png", "--out", "rad", "--arch", "cpu", cwd=folder)
    assert again.returncode == 0, again.stderr


def test_a_depth_range_tells_the_order(folder, command):
    arguments = ("decode", "frame.png", "--arch", "cpu", "--calibration", "calibration.json")
    relative = command(*arguments, "--out", "anywhere", cwd=folder)
    assert "there may be off by whole cycles, about" in " ".join(relative.stdout.split())
    told = command(*arguments, "--out", "ranged", "--depth-range", "880", "920", cwd=folder)
    assert told.returncode == 0, told.stderr
    assert "fits at no order into the depth range of 880 to 920 mm" in " ".join(told.stderr.split())
    refused = command(*arguments, "--out", "no", "--depth-range", "900", "700", cwd=folder)
    assert "--depth-range is 900 700: give the nearest and the farthest depth in mm, as 700 1100" in refused.stderr
    refused = command(*arguments[:4], "--out", "no", "--depth-range", "700", "900", cwd=folder)
    assert "--depth-range is in mm: give a --calibration" in refused.stderr


def test_a_large_mesh_is_announced_and_can_be_left_out(folder, command, monkeypatch):
    arguments = ("decode", "frame.png", "--arch", "cpu", "--out")
    assert "mesh.ply takes" not in command(*arguments, "small", cwd=folder).stderr
    monkeypatch.setattr("pipeline.output.folder.WORTH_SAYING", 1e6)
    done = command(*arguments, "large", cwd=folder)
    size = (folder / "large" / "mesh.ply").stat().st_size
    assert f"mesh.ply takes {in_bytes(size)}: --triangles makes it smaller, --no-mesh leaves it out" in done.stderr
    done = command(*arguments, "meshless", "--no-mesh", cwd=folder)
    assert done.returncode == 0 and "mesh.ply takes" not in done.stderr
    names = sorted(path.name for path in (folder / "meshless").iterdir())
    assert names == ["range.png", "report.json", "result.zarr", "shaded.png"]
    assert "mesh" not in json.loads((folder / "meshless" / "report.json").read_text())
    refused = command("decode", "pictures", "--out", "no", "--no-mesh", cwd=folder)
    assert refused.returncode == 1 and "--no-mesh does nothing for footage" in refused.stderr
    refused = command(*arguments, "no", "--no-mesh", "--triangles", "9", cwd=folder)
    assert refused.returncode == 1 and "--no-mesh leaves nothing for --crop" in refused.stderr


def test_a_frame_without_fringes(folder, command):
    done = command("decode", "black.png", "--out", "none", "--arch", "cpu", cwd=folder)
    assert done.returncode == 1
    assert "no fringe stands out" in done.stderr
    assert "Traceback" not in done.stderr
    assert "nothing was measured in black.png, so nothing is written" in done.stderr
    assert not (folder / "none").exists()


def test_footage_in_which_nothing_is_measured_ends_with_1_and_some_with_3(folder, command):
    film = folder / "dark"
    film.mkdir()
    dark = np.zeros_like(cv2.imread(str(folder / "frame.png")))
    for name in ("f1.png", "f2.png"):
        cv2.imwrite(str(film / name), dark)
    arguments = ("decode", film, "--arch", "cpu", "--out")
    for _ in range(2):  # again, too
        done = command(*arguments, "nothing", "--export", "ply", cwd=folder)
        assert done.returncode == 1
        assert "2 of 2 frames decoded" in done.stdout
        assert f"error: nothing was measured in dark: run colorphase inspect {film}" in done.stderr
    shutil.copy(folder / "frame.png", film / "f3.png")
    for _ in range(2):
        done = command(*arguments, "some", cwd=folder)
        assert done.returncode == 3 and "2 frames are empty, as frame 0: nothing was measured there" in done.stderr


def test_settings_as_options(folder, command):
    done = command("decode", "frame.png", "--out", "turned", "--arch", "cpu", "--stripes", "vertical", cwd=folder)
    assert done.returncode == 1 and "set stripes to 'horizontal' (--stripes horizontal)" in done.stderr
    done = command("decode", "frame.png", "--out", "smooth", "--arch", "cpu", "--smoothing", "11", cwd=folder)
    assert done.returncode == 0, done.stderr
    report = json.loads((folder / "smooth" / "report.json").read_text())
    assert report["settings"]["smoothing_px"] == 11


def test_a_jpeg_that_says_nothing_is_srgb_and_a_png_linear(folder, command):
    """And the report says why; settings overrule that."""
    light = cv2.imread(str(folder / "frame.png")).astype(np.float64) / 255
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    high_quality = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
    jpeg = cv2.imencode(".jpg", np.rint(255 * encoded).astype(np.uint8), high_quality)[1]
    (folder / "encoded.jpg").write_bytes(jpeg.tobytes())
    (folder / "linear.toml").write_text('transfer = "linear"')
    said, depth = {}, {}
    for name, picture, *settings in (
        ("png", "frame.png"),
        ("srgb", "encoded.jpg"),
        ("wrong", "encoded.jpg", "--settings", "linear.toml"),
    ):
        done = command(
            *(
                "decode",
                picture,
                "--out",
                f"by {name}",
                "--calibration",
                "calibration.json",
                "--arch",
                "cpu",
                *settings,
            ),
            cwd=folder,
        )
        assert done.returncode == 0, done.stderr
        report = json.loads((folder / f"by {name}" / "report.json").read_text())
        said[name] = report["settings"]["transfer"], report["transfer_because"]
        depth[name] = zarr.open_group(folder / f"by {name}" / "result.zarr", mode="r")["wrapped_phase"][0]
    assert said == {
        "png": ("linear", "nothing in the file says otherwise"),
        "srgb": ("srgb", "a JPEG that says nothing else is sRGB"),
        "wrong": ("linear", "the settings say so"),
    }
    off = {
        name: np.nanmedian(np.abs(np.angle(np.exp(1j * (depth[name] - depth["png"]))))) for name in ("srgb", "wrong")
    }
    assert off["srgb"] < 0.5 * off["wrong"]


@pytest.mark.filterwarnings("ignore:no matrix explains the colours")  # of a lower resolution
def test_a_jpeg_is_read_as_footage_is(folder, command):
    """From its planes, which costs less than the RGB that libraries make of them; and damage is told."""
    jpeg = cv2.imencode(".jpg", cv2.imread(str(folder / "frame.png")))[1].tobytes()
    (folder / "frame.jpg").write_bytes(jpeg)
    (folder / "broken.jpg").write_bytes(jpeg[:5000] + bytes(2000) + jpeg[7000:])
    (folder / "linear.toml").write_text('transfer = "linear"')
    options = ("--calibration", "calibration.json", "--settings", "linear.toml")
    done = command("decode", "frame.jpg", "--out", "jpeg", *options, cwd=folder)
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
    refused = command("decode", "broken.jpg", "--out", "broken", cwd=folder)
    assert refused.returncode == 1 and "damaged" in refused.stderr and len(refused.stderr.splitlines()) == 1
    assert not (folder / "broken").exists()


def test_pages_are_frames_and_what_is_not_used_is_said(folder, command):
    image = cv2.imread(str(folder / "frame.png"))
    (folder / "stack.tif").write_bytes(cv2.imencodemulti(".tif", [image, image])[1].tobytes())
    done = command("decode", "stack.tif", "--out", "stack", "--fields", "mask", "--arch", "cpu", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "2 of 2 frames decoded" in done.stdout
    alpha = np.tile(np.arange(image.shape[1], dtype=np.uint8), (len(image), 1))
    cv2.imwrite(str(folder / "transparent.png"), np.dstack([image, alpha]))
    done = command("decode", "transparent.png", "--out", "transparent", "--arch", "cpu", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "note: it is transparent in parts, which is not used" in done.stderr.replace("\n", " ")


def test_decode_footage(folder, command):
    """Bad frames are told by number and by the exit code; a second run finds everything else done."""
    film = folder / "film é 1"
    film.mkdir()
    for name in ("f1.png", "f2.png", "f10.png"):
        shutil.copy(folder / "frame.png", film / name)
    (film / "f3.png").write_bytes((folder / "frame.png").read_bytes()[:1000])
    options = ("--out", "footage", "--arch", "cpu", "--calibration", "calibration.json", "--fields", "points", "mask")
    done = command("decode", film, *options, cwd=folder)
    assert done.returncode == 3, done.stderr
    assert "frame 2 is bad" in done.stderr and "truncated" in done.stderr
    assert "3 of 4 frames decoded; they are in footage/result.zarr" in done.stdout
    group = zarr.open_group(folder / "footage" / "result.zarr", mode="r")
    assert group["points"].shape == (4, 240, 320, 3)
    assert "relative" not in done.stdout  # what tells it was not stored
    everything = (*options[:1], "all", *options[2:6], "--start", "3", "--fields", "all")
    told = " ".join(command("decode", film, *everything, cwd=folder).stdout.split())
    assert "frame 3: depth is relative on 100% of the pixels" in told and "mm each; a pattern with the code" in told
    again = command("decode", film, *options, cwd=folder)
    assert again.returncode == 3 and "3 of them before" in again.stdout
    for arguments, message in [
        (("--settings", "settings.toml"), r"settings.smoothing_px is 7 there, 3 here"),
        (("--roi", "1,2,3"), "give x,y,width,height"),
        (("--roi", "0,0,00,²"), "give x,y,width,height"),
        (("--roi", "0,0,400,100"), "sticks out of the 320x240 frame"),
        (("--fields", "depth"), "no field is called 'depth'"),
        (("--step", "0"), "must be 1 or more"),
        (("--start", "9"), "none of which is selected"),
    ]:
        refused = command("decode", film, *options, *arguments, cwd=folder)
        assert refused.returncode in (1, 2) and message in refused.stderr, refused.stderr
        assert "Traceback" not in refused.stderr
    with_meshes = command("decode", film, *options, "--export", "glb", cwd=folder)
    assert with_meshes.returncode == 3, with_meshes.stderr
    assert "3 frames as glTF 2.0 in one binary file in footage/meshes" in with_meshes.stdout
    names = sorted(path.name for path in (folder / "footage" / "meshes").iterdir())
    assert names == ["exported.json", "frame_000000.glb", "frame_000001.glb", "frame_000003.glb"]
    strict = command("decode", film, *options[2:], "--out", "strict", "--strict", cwd=folder)
    assert strict.returncode == 1 and "frame 2 of" in strict.stderr
    picture = command("decode", "frame.png", "--out", "footage", "--force", cwd=folder)
    assert picture.returncode == 1 and "holds the frames of footage" in picture.stderr
