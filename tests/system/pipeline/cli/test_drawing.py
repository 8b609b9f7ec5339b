"""`colorphase render` as its user meets it; what it draws has tests of its own."""

import json
import os

import cv2
import numpy as np
import pytest
from support.command_in_process import command
from support.drawn_surfaces import dome, read_film, read_picture, require_drawing, shown
from support.stored_planes import LENS, store

from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import write_mesh

__all__ = ["command"]
SIZE = ("--size", "160", "120")


@pytest.fixture(scope="module")
def can_draw(tmp_path_factory):
    require_drawing(tmp_path_factory.mktemp("probe"))


@pytest.fixture
def things(tmp_path, cpu):
    """Return a folder with a mesh, a store of three frames and of one, and a path of an eye."""
    write_mesh(dome(), tmp_path / "mesh.ply")
    write_mesh(Mesh(dome().vertices, np.empty((0, 3), np.int32)), tmp_path / "points.ply")
    store(tmp_path / "film.zarr", [400.0, 401.0, 402.0], missing=(1,))
    (tmp_path / "one").mkdir()
    store(tmp_path / "one" / "result.zarr", [400.0])
    key = "[[keyframes]]\nat = {}\nposition = [{}, 0, 0]\nfocal_point = [0, 0, 400]\n"
    (tmp_path / "path.toml").write_text(key.format(0, 0) + key.format(1, 200))
    return tmp_path


@pytest.mark.usefixtures("can_draw")
def test_a_still_with_buffers_and_a_camera(command, things):
    camera = ("--camera", "-50", "0", "0", "0", "0", "400")
    buffers = ("--buffers", "depth", "normals")
    code, said, complained = command("render", "mesh.ply", "--out", "still.png", *SIZE, *camera, *buffers)
    assert (code, complained) == (0, "")
    assert said.startswith("wrote still.png still.depth.tiff still.normals.png: drawn by ")
    assert said.rstrip().endswith(("EGL", "OSMesa", "GLX"))
    assert shown(read_picture(things / "still.png")).mean() > 0.1
    code, said, _ = command("render", "one", "--out", "one.png", *SIZE, "--view", "front")
    assert code == 0 and said.startswith("wrote one.png: drawn by ")


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize("kind", ["pcd", "png", "tiff", "mcap"])
def test_grids_are_drawn_as_the_frames_that_they_were(command, things, kind):
    store(things / "seen.zarr", [400.0, 401.0, 402.0], missing=(1,), lens=LENS)
    code, said, complained = command("export", "seen.zarr", "--out", "grids", "--kind", kind)
    assert code == 0, complained
    bag = kind == "mcap"
    source = "grids/bag/bag.mcap" if bag else f"grids/frame_000002.{kind}"
    view = ("--view", "front", *SIZE)
    code, said, complained = command("render", source, "--out", "grid.png", *view, *(("--frame", "1") if bag else ()))
    assert (code, complained) == (0, "") and said.startswith("wrote grid.png: drawn by ")
    command("render", "seen.zarr", "--frame", "2", "--out", "frame.png", *view)
    drawn, expected = (read_picture(things / name).astype(int) for name in ("grid.png", "frame.png"))
    assert shown(drawn).mean() > 0.1
    assert (np.abs(drawn - expected).max(axis=-1) > 12).mean() < 0.02


@pytest.mark.usefixtures("can_draw")
def test_films_of_many_frames_and_along_a_path(command, things):
    code, said, complained = command("render", "film.zarr", "--out", "film.mp4", *SIZE, "--turn", "20")
    assert code == 3 and said.startswith("wrote film.mp4: 3 pictures, by ")
    assert complained == "1 frame is missing or empty, as frame 1: the one before is shown in its place\n"
    path = ("--camera-path", "path.toml", "--fps", "4", "--seconds", "1")
    out = os.fsdecode(b"m\xfcller.mp4")
    code, said, complained = command("render", "mesh.ply", "--out", out, *SIZE, *path)
    assert (code, complained) == (0, "") and said.startswith("wrote m?ller.mp4: 4 pictures")
    seen, rate = read_film(things / out)
    assert rate == 4 and abs(seen[0] - seen[-1]).max() > 50


@pytest.mark.usefixtures("can_draw")
def test_a_broken_chunk_ends_with_its_name_and_3(command, things):
    chunk = next((things / "film.zarr" / "points").glob("c.2.*"))
    chunk.write_bytes(chunk.read_bytes()[:-1])
    code, said, complained = command("render", "film.zarr", "--out", "film.mp4", *SIZE)
    assert code == 3 and "3 pictures" in said
    assert "1 frame is damaged, and the one before is shown in its place: " in complained
    assert "film.zarr: frame 2: points is damaged" in complained and "which repairs it" in complained
    code, said, complained = command("render", "film.zarr", "--out", "two.png", "--frame", "2")
    assert (code, said, complained.count("\n")) == (1, "", 1) and "which repairs it" in complained


def foreign(mesh, path):
    """Write a mesh as another program does, which keeps coordinates and drops comments."""
    write_mesh(mesh, path)
    head, end, body = path.read_bytes().partition(b"element vertex")
    kept = [line for line in head.splitlines() if not line.startswith(b"comment")]
    path.write_bytes(b"\n".join([*kept, end + body]))


@pytest.mark.usefixtures("can_draw")
def test_a_mesh_of_another_program_is_compared_where_its_axes_and_unit_are_given(command, things):
    bare = Mesh(dome().vertices, dome().faces)
    foreign(bare, things / "same.ply")
    foreign(Mesh(bare.vertices + np.float32((0, 0, 60)), bare.faces), things / "moved.ply")
    view = ("--out", "x.png", *SIZE)
    code, said, complained = command("render", "mesh.ply", "--compare", "same.ply", *view)
    assert (code, said) == (1, "") and complained == (
        "error: same.ply does not say its axes and unit: give --compare-axes y-up, z-up or camera, and "
        "--compare-unit mm, cm, m or in\n"
    )
    code, said, complained = command("render", "mesh.ply", "--compare", "same.ply", "--compare-axes", "y-up", *view)
    assert complained == "error: same.ply does not say its unit: give --compare-unit mm, cm, m or in\n"
    code, said, complained = command("render", "same.ply", "--compare", "mesh.ply", *view)
    assert (code, said) == (1, "") and "same.ply does not say its axes and unit: give --axes y-up" in complained
    ours = ("--compare-axes", "y-up", "--compare-unit")
    code, said, complained = command("render", "mesh.ply", "--compare", "same.ply", *ours, "mm", *view)
    assert (code, complained) == (0, "")
    code, said, complained = command("render", "mesh.ply", "--compare", "moved.ply", *ours, "mm", *view)
    assert code == 0 and complained.startswith("the boxes of the two surfaces are 10 mm apart: if one has other axes")
    for wrong in (("z-up", "--compare-unit", "mm"), ("y-up", "--compare-unit", "m")):
        code, said, complained = command("render", "mesh.ply", "--compare", "same.ply", ours[0], *wrong, *view)
        assert (code, said, complained.count("\n")) == (1, "", 1) and "mm apart: if one has other axes" in complained
    code, said, complained = command("render", "same.ply", *view)
    assert code == 0 and complained == (
        "same.ply does not say its axes and unit, and is shown as if it were ours: see --axes and --unit\n"
    )
    code, said, complained = command("render", "same.ply", *view, "--axes", "y-up", "--unit", "mm")
    assert (code, complained) == (0, "")


@pytest.mark.usefixtures("can_draw")
def test_several_inputs_in_colours_of_ones_own_on_nothing(command, things):
    look = ("--colors", "depth", "--limits", "350", "400", "--colormap", "viridis", "--transparent", "--view", "front")
    code, said, complained = command("render", "mesh.ply", "one", "--out", "pictures", *SIZE, *look)
    assert (code, complained) == (0, "")
    assert [line.partition(":")[0] for line in said.splitlines()] == [
        "wrote pictures/mesh.png",
        "wrote pictures/one.png",
    ]
    image = cv2.imread(str(things / "pictures" / "mesh.png"), cv2.IMREAD_UNCHANGED)
    assert image.shape == (120, 160, 4) and image[0, 0].tolist() == [0, 0, 0, 0]
    blue, green, red, opacity = (int(channel) for channel in image[60, 80])  # the nearest place, in light
    assert opacity == 255 and blue > 1.1 * red > 10 * green
    code, said, complained = command("render", "one/result.zarr", "film.zarr", "--frame", "0", "--out", "more", *SIZE)
    assert (code, complained) == (0, "") and said.count("\n") == 2
    (things / "two").mkdir()
    write_mesh(dome(), things / "two" / "mesh.ply")
    code, said, _ = command("render", "mesh.ply", "two/mesh.ply", "--out", "pictures", *SIZE)
    assert code == 0 and "wrote pictures/two_mesh.png: " in said


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ("mesh.ply film.zarr --out x.png", 1, "x.png is one picture, and there are 2 inputs: name a folder"),
        ("mesh.ply mesh.ply --out x", 1, "two inputs have the same name: render them one at a time"),
        ("mesh.ply --out x.png --limits 0 1", 1, "--limits does nothing without values: add --colors depth, or"),
        ("mesh.ply --out x.png --colors clay --colormap magma", 1, "--colormap does nothing without values"),
        ("mesh.ply --out x.png --colors depth --limits 2 1", 1, "--limits is 2 1: give the lower one first"),
        ("mesh.ply --out x.mp4 --transparent", 1, "--transparent does nothing for a film"),
        ("film.zarr --out x.mp4 --unit m", 1, "--axes and --unit do nothing for a result: leave them out"),
        ("mesh.ply --out x.gif", 1, "name it .png for a still picture, .mp4 for a film"),
        ("none.ply --out x.png", 1, "cannot read none.ply"),
        ("points.ply --out x.png", 1, "the mesh has 3200 points and no faces: give one of triangles"),
        ("film.zarr --out x.png", 1, "choose one with --frame, or name the output .mp4"),
        ("none.zarr --out x.png", 1, "decode first"),
        ("mesh.ply --out x.png --fps 3", 1, "--fps does nothing for a still picture: leave it out, or name"),
        ("mesh.ply --out x.png --sway 3", 1, "--sway does nothing for a still picture"),
        ("mesh.ply --out x.png --camera-path path.toml", 1, "--camera-path does nothing for a still picture"),
        ("mesh.ply --out x.png --frame 0", 1, "--frame does nothing for a mesh's file: leave it out"),
        ("mesh.ply --out x.mp4 --buffers depth", 1, "--buffers does nothing for a film: leave it out"),
        ("film.zarr --out x.mp4 --seconds 3", 1, "--seconds does nothing for a film of many frames"),
        ("mesh.ply --out x.png --colors depth --compare mesh.ply", 1, "--colors and --compare contradict each other"),
        ("mesh.ply --out x.png --view top --camera 0 0 0 0 0 1", 1, "--view and --camera contradict each other"),
        ("mesh.ply --out x.mp4 --camera-path path.toml --turn 9", 1, "leave out --turn and --sway"),
        ("mesh.ply --out x.png --camera 0 0 0", 1, "got 3 numbers, expected 6"),
        ("mesh.ply --out x.mp4 --size 161 120", 1, "even numbers"),
        ("mesh.ply --out x.png --size 1 1", 1, "--size is 1x1: give 16 to 8192 px"),
        ("mesh.ply --out x.mp4 --sway 181", 2, "must be 0 to 180"),
        ("mesh.ply --out x.mp4 --fps nan", 2, "must be 0.1 to 1000"),
        ("mesh.ply --out x.png --view above", 2, "Invalid value"),
    ],
)
def test_mistakes_are_one_line(command, things, arguments, code, message):
    before = sorted(things.iterdir())
    ended, said, complained = command("render", *arguments.split())
    assert (ended, said) == (code, "")
    assert message in complained and complained.startswith("error: ") and complained.count("\n") == 1
    assert sorted(things.iterdir()) == before


def test_a_result_of_a_newer_version_says_so(command, things):
    path = things / "film.zarr" / "zarr.json"
    about = json.loads(path.read_text())
    about["zarr_format"] = 9
    path.write_text(json.dumps(about))
    code, said, complained = command("render", "film.zarr", "--out", "film.mp4")
    assert (code, said, complained.count("\n")) == (1, "", 1) and "film.zarr" in complained
