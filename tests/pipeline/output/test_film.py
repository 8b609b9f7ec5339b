"""Films and meshes of a store's frames: what they show, and what is said of frames that are not there."""

import sys
from functools import partial

import av
import numpy as np
import pytest
import zarr
from support.command_line import colorphase
from support.missing import skip_but_fail_in_ci
from support.stored_planes import store

from pipeline.errors import FootageError, OutputError, RenderError
from pipeline.footage.opening import open_source
from pipeline.output import film
from pipeline.output.film import FilmOptions, render_film
from pipeline.output.render import render_mesh
from tikernels.raw.development import develop

pytestmark = pytest.mark.usefixtures("cpu")

SIZE = (160, 120)


def pictures(path):
    with av.open(str(path)) as container:
        rate = float(container.streams.video[0].average_rate)
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]).astype(int), rate


def shown(picture):
    """Return which pixels differ from the background at the left edge."""
    return abs(picture - picture[:, :1]).max(axis=-1) > 12


@pytest.fixture(scope="module")
def can_draw(tmp_path_factory):
    from pipeline.output.mesh import Mesh

    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    try:
        render_mesh(mesh, tmp_path_factory.mktemp("probe") / "probe.png", size_px=SIZE)
    except RenderError as error:
        skip_but_fail_in_ci(f"no usable OpenGL: {error}")


@pytest.mark.usefixtures("can_draw")
def test_a_film_shows_each_frame_in_its_turn(tmp_path):
    distances = [400.0, 401.0, 402.0, 403.0, 404.0, 405.0]
    path = store(tmp_path / "r.zarr", distances, missing=(2,))
    told = []
    options = FilmOptions("front", fps=12.5, size_px=SIZE)
    made = render_film(path, tmp_path / "film.mp4", options, tell=lambda done, of: told.append((done, of)))
    assert (made.n_images, made.held) == (6, (2,))
    assert told == [(i + 1, 6) for i in range(6)]
    assert [p.name for p in tmp_path.iterdir() if p.suffix == ".mp4" or p.name.startswith(".")] == ["film.mp4"]
    seen, rate = pictures(tmp_path / "film.mp4")
    assert seen.shape == (6, SIZE[1], SIZE[0], 3) and rate == 12.5
    middle = seen[:, SIZE[1] // 2, SIZE[0] // 2]
    # One scale of colours for all: from blue, near, to red.
    assert middle[0, 2] > middle[0, 0] + 50 and middle[-1, 0] > middle[-1, 2] + 50
    assert abs(middle[2] - middle[1]).max() < 8, "the missing frame shows the one before"
    assert abs(middle[3] - middle[1]).max() > 8
    # The camera's view: x to the right, y down, so the hole is below on the right.
    y, x = np.nonzero(shown(seen[0]))
    inside = shown(seen[0])[y.min() + 2 : y.max() - 1, x.min() + 2 : x.max() - 1]  # its rim is mixed
    assert inside[:10, :10].all() and inside[:10, -10:].all() and inside[-8:, :10].all()
    assert not inside[-8:, -10:].any()


@pytest.mark.long
@pytest.mark.usefixtures("can_draw")
def test_turning_and_swaying(tmp_path):
    path = store(tmp_path / "r.zarr", 5 * [400.0])
    widths = {}
    for name, motion in (("turn", {"turn_deg": 60.0}), ("sway", {"sway_deg": 40.0})):
        options = FilmOptions("front", colors="shaded", size_px=SIZE, **motion)
        render_film(path, tmp_path / f"{name}.mp4", options)
        seen, _ = pictures(tmp_path / f"{name}.mp4")
        widths[name] = [int(np.ptp(np.nonzero(shown(picture))[1])) for picture in seen]
    assert np.all(np.diff(widths["turn"]) <= 0)
    assert widths["turn"][-1] < 0.75 * widths["turn"][0]
    first, left, middle, right, last = widths["sway"]
    assert max(left, right) < 0.9 * first
    assert max(first, middle, last) - min(first, middle, last) <= 2


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize(
    "colors", ["depth", *(pytest.param(colors, marks=pytest.mark.long) for colors in ("modulation", "sigma", "shaded"))]
)
def test_a_single_frame_in_rad_lasts_some_seconds(tmp_path, colors):
    path = store(tmp_path / "r.zarr", [400.0], in_mm=False)
    options = FilmOptions(colors=colors, fps=10, seconds=0.5, size_px=SIZE)
    assert render_film(path, tmp_path / "film.mp4", options).n_images == 5
    seen, _ = pictures(tmp_path / "film.mp4")
    assert shown(seen[0]).mean() > 0.1


@pytest.mark.long
@pytest.mark.usefixtures("can_draw")
def test_every_second_frame_is_no_gap(tmp_path):
    path = store(tmp_path / "r.zarr", 7 * [400.0], missing=(0, 2, 4, 6), step=2)
    made = render_film(path, tmp_path / "film.mp4", FilmOptions(size_px=SIZE))
    assert (made.n_images, made.held) == (3, ())


@pytest.mark.long
@pytest.mark.usefixtures("can_draw")
def test_frames_without_a_surface(tmp_path):
    path = store(tmp_path / "r.zarr", [None, 400.0, None])
    assert render_film(path, tmp_path / "film.mp4", FilmOptions(size_px=SIZE)).held == (0, 2)
    with pytest.raises(RenderError, match="no frame shows a surface"):
        render_film(store(tmp_path / "n.zarr", [None, None]), tmp_path / "none.mp4", FilmOptions(size_px=SIZE))
    assert not (tmp_path / "none.mp4").exists()


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
@pytest.mark.parametrize("size", [(160, 120), (1280, 960)])
def test_colors_are_those_that_were_drawn(tmp_path, monkeypatch, codec, size):
    """Whatever a player guesses of a file that does not say its matrix; to 3 grey levels."""
    monkeypatch.setattr(av, "codecs_available", {codec})
    color = (220, 60, 40)
    with film._Encoder(str(tmp_path / "film.mp4"), FilmOptions(size_px=size)) as encoder:
        encoder.add(np.full((*size[::-1], 3), color, np.uint8))
    assert encoder.codec == codec
    source = open_source(tmp_path / "film.mp4")
    (frame,) = source.frames()
    assert source.notes == ()
    np.testing.assert_allclose(255 * develop(frame.planes, frame.format)[size[1] // 2, size[0] // 2], color, atol=3)


def test_what_is_refused(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0, 401.0], leave_out=("modulation",))
    with pytest.raises(FootageError, match="holds no modulation: decode with that field"):
        render_film(path, tmp_path / "film.mp4", FilmOptions(colors="modulation"))
    with pytest.raises(OutputError, match=r"name it \.mp4"):
        render_film(path, tmp_path / "film.avi")
    with pytest.raises(OutputError, match="even numbers"):
        render_film(path, tmp_path / "film.mp4", FilmOptions(size_px=(161, 120)))
    with pytest.raises(ValueError, match="'above', expected one of"):
        render_film(path, tmp_path / "film.mp4", FilmOptions(view="above"))
    zarr.open_group(path)["done"][:] = 0x20
    with pytest.raises(FootageError, match="no frame that is done"):
        render_film(path, tmp_path / "film.mp4")


def test_a_child_that_dies_leaves_nothing(tmp_path, monkeypatch):
    path = store(tmp_path / "r.zarr", [400.0, 401.0])
    monkeypatch.setattr(film, "_COMMAND", [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), 11)"])
    with pytest.raises(RenderError, match="apt-get install libegl1"):
        render_film(path, tmp_path / "film.mp4")
    monkeypatch.setattr(film, "_COMMAND", [sys.executable, "-c", "import time; time.sleep(60)"])
    with pytest.raises(RenderError, match=r"more than 0\.5 s"):
        render_film(path, tmp_path / "film.mp4", timeout_s=0.5)
    assert [p.name for p in tmp_path.iterdir()] == ["r.zarr"]


@pytest.mark.long
@pytest.mark.usefixtures("can_draw")
def test_the_commands(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0, 401.0, 402.0], missing=(1,))
    run = partial(colorphase, cwd=tmp_path)
    done = run("render", path, "--out", tmp_path / "film.mp4", "--size", *SIZE, "--turn", 20)
    assert done.returncode == 0, done.stderr
    assert "3 pictures" in done.stdout and "frame 1: the one before is shown" in done.stderr
    assert len(pictures(tmp_path / "film.mp4")[0]) == 3
    done = run("export", path, "--out", tmp_path / "meshes")
    assert done.returncode == 0 and "2 meshes" in done.stdout
    for option, value in (("--fps", 0), ("--fps", 1e9), ("--turn", "nan"), ("--seconds", -1)):
        refused = run("render", path, "--out", tmp_path / "film.mp4", option, value)
        assert refused.returncode in (1, 2) and "error: " in refused.stderr
