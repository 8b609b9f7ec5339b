"""`colorphase export` as its user meets it; what it does has tests of its own."""

import numpy as np
import pytest
from cyclopts import App
from support.command_line import colorphase
from support.numbered_frames import record
from support.stored_planes import store as planes

from pipeline.cli.export import MeshChoice
from pipeline.footage.opening import open_footage
from pipeline.output.mesh_files import read_mesh
from pipeline.output.surface_mesh import MeshOptions
from tikernels.raw.pixel_format import PixelFormat


def parsed(*words: str) -> MeshOptions:
    app = App(result_action="return_value")

    @app.default
    def take(part: MeshChoice = MeshChoice()) -> MeshOptions:  # noqa: B008 - it is frozen
        return part.options()

    return app(list(words))


def test_left_out_nothing_is_left_out():
    assert parsed() == MeshOptions()


def test_each_option_is_one_of_a_mesh():
    crop = ("--crop", "-1", "2", "3", "4", "5", "6")
    assert parsed(*crop, "--no-background", "--triangles", "9", "--no-smooth") == MeshOptions(
        smoothed=False, crop_mm=(-1, 2, 3, 4, 5, 6), without_background=True, max_triangles=9
    )


@pytest.fixture(scope="module")
def store(folder):
    """Decode the folder's one picture as footage."""
    done = colorphase(
        *("decode", "pictures", "--out", "stored", "--arch", "cpu"),
        *("--fields", "mask", "range_image", "--calibration", "calibration.json"),
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    return folder / "stored" / "result.zarr"


def test_every_frame_is_exported(store, command, tmp_path):
    code, _, complained = command("export", str(store), "--out", "meshes")
    assert code == 1 and "holds no points: decode with that field" in complained  # ranges are in mm
    done = command("decode", "pictures", "--out", "relative", "--arch", "cpu", cwd=store.parents[1])
    assert done.returncode == 0, done.stderr
    found = command("export", str(store.parents[1] / "relative" / "result.zarr"), "--out", "meshes")
    assert found == (0, "1 frame as Stanford PLY, binary in meshes\n", "")
    assert read_mesh(tmp_path / "meshes" / "frame_000000.ply").unit == "rad"
    again = ("export", str(store.parents[1] / "relative" / "result.zarr"), "--out", "meshes")
    assert command(*again) == (
        0,
        "1 frame as Stanford PLY, binary in meshes were exported before, and are whole: --force writes them again\n",
        "",
    )
    (tmp_path / "meshes" / "frame_000000.ply").write_text("cleaned by hand")
    code, said, complained = command(*again)
    assert (code, said, complained.count("\n")) == (1, "", 1)
    assert "frame_000000.ply has been changed since we wrote it): choose another folder, or add --force" in complained
    assert command(*again, "--force") == (0, "1 frame as Stanford PLY, binary in meshes\n", "")


def test_frames_without_a_surface_end_with_3_and_nothing_else_with_1(command, tmp_path, cpu):
    planes(tmp_path / "some.zarr", [400.0, None, 402.0])
    code, said, complained = command("export", "some.zarr", "--out", "some")
    assert (code, said) == (3, "2 frames as Stanford PLY, binary in some\n")
    assert complained == "1 frame is empty, as frame 1: there is no file of what shows no surface\n"
    assert command("export", "some.zarr", "--out", "some")[0] == 3  # again
    planes(tmp_path / "none.zarr", [None])
    code, said, complained = command("export", "none.zarr", "--out", "none")
    assert (code, said) == (1, "")
    assert complained == ("error: no frame of none.zarr shows a surface: run colorphase inspect on the footage\n")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("export", "none.zarr", "--out", "meshes"), 1, "decode first"),
        (("export", "none.zarr", "--out", "meshes", "--kind", "fbx"), 1, "'fbx' is no format: choose one of ply, obj"),
    ],
)
def test_mistakes_are_one_line(command, tmp_path, arguments, code, message):
    ended, said, complained = command(*arguments)
    assert (ended, said) == (code, "")
    assert message in complained and complained.startswith("error: ") and complained.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_recording_becomes_a_video(command, tmp_path):
    frames = record(tmp_path / "recording.zarr", PixelFormat("bayer", 12, bayer="grbg"), n_frames=3)
    wanted = ("export", "recording.zarr", "--kind", "mkv")
    assert command(*wanted) == (0, "3 frames as FFV1 in recording.mkv\n", "")
    code, said, complained = command(*wanted)
    assert (code, said) == (1, "") and "recording.mkv exists: choose another folder, or --force" in complained
    assert command(*wanted, "--force", "--out", "videos")[0] == command(*wanted, "--force")[0] == 0
    for path in (tmp_path / "recording.mkv", tmp_path / "videos" / "recording.mkv"):
        for frame, kept in zip(open_footage(path).frames(), frames, strict=True):
            np.testing.assert_array_equal(frame.planes[0], kept)
    code, said, complained = command("export", "recording.mkv", "--kind", "mkv", "--out", "more")
    assert (code, said) == (1, "") and "recording.mkv is not a recording of frames" in complained
    assert "where are the files to go? Name a folder, as --out meshes" in command("export", "recording.zarr")[2]
