"""Films: what they show, how they go on, and what is said of frames that are not there."""

import json
from pathlib import Path

import av
import numpy as np
import pytest
import zarr
from support.drawn_surfaces import dome, read_film, require_drawing, shown
from support.stored_planes import store

from pipeline.errors import FootageError, OutputError, RenderError
from pipeline.footage.opening import open_footage
from pipeline.output import film
from pipeline.output.film import FilmEncoder, join_parts, render_film
from pipeline.output.pictures import drawing_process
from pipeline.output.pictures.drawing_process import PictureOptions
from tikernels.raw.development import develop

pytestmark = pytest.mark.usefixtures("cpu")

SIZE = (160, 120)
SMALL = PictureOptions(size_px=SIZE)


@pytest.fixture(scope="module")
def can_draw(tmp_path_factory):
    require_drawing(tmp_path_factory.mktemp("probe"))


@pytest.mark.usefixtures("can_draw")
def test_a_film_shows_each_frame_in_its_turn(tmp_path):
    distances = [400.0, 401.0, 402.0, 403.0, 404.0, 405.0, 406.0, 407.0]
    path = store(tmp_path / "r.zarr", distances, missing=(2, 6))
    told = []
    options = PictureOptions(view="front", colors="depth", fps=12.5, size_px=SIZE)
    made = render_film(path, tmp_path / "film.mp4", options, notify=lambda done, of: told.append((done, of)))
    assert (made.n_images, made.before, made.held, made.broken) == (8, 0, (2, 6), {})
    assert told == [(i, 8) for i in range(9)]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["film.mp4", "r.zarr"]
    seen, rate = read_film(tmp_path / "film.mp4")
    assert seen.shape == (8, SIZE[1], SIZE[0], 3) and rate == 12.5
    middle = seen[:, SIZE[1] // 2, SIZE[0] // 2]
    # One scale of colours for all: from blue, near, to red.
    assert middle[0, 2] > middle[0, 0] + 50 and middle[-1, 0] > middle[-1, 2] + 50
    # The second one begins a part of the film, which another process draws.
    for held in (2, 6):
        assert abs(middle[held] - middle[held - 1]).max() < 8, "the missing frame shows the one before"
        assert abs(middle[held + 1] - middle[held - 1]).max() > 8
    # The camera's view: x to the right, y down, so the hole is below on the right.
    y, x = np.nonzero(shown(seen[0]))
    inside = shown(seen[0])[y.min() + 2 : y.max() - 1, x.min() + 2 : x.max() - 1]  # its rim is mixed
    assert inside[:10, :10].all() and inside[:10, -10:].all() and inside[-8:, :10].all()
    assert not inside[-8:, -10:].any()


@pytest.mark.usefixtures("can_draw")
def test_a_film_that_was_stopped_goes_on(tmp_path, monkeypatch):
    path = store(tmp_path / "r.zarr", [400.0 + i for i in range(14)])
    calls, draw = [], film.draw_apart

    def draw_until_killed(job, folder, timeout_s, tell, **options):
        calls.append(job.parts)
        draw(job.model_copy(update={"parts": job.parts[:1]}), folder, timeout_s, tell, **options)
        raise RenderError("killed")

    monkeypatch.setattr(film, "draw_apart", draw_until_killed)
    monkeypatch.setattr(film.os, "cpu_count", lambda: 1)
    with pytest.raises(RenderError, match="killed"):
        render_film(path, tmp_path / "film.mp4", SMALL)
    assert [(part.first, part.stop) for part in calls[0]] == [(0, 6), (6, 12), (12, 14)]
    parts = tmp_path / ".film.mp4.parts"
    (whole,) = parts.glob("*.mp4")
    assert not (tmp_path / "film.mp4").exists()

    monkeypatch.setattr(
        film, "draw_apart", lambda job, *given, **named: (calls.append(job.parts), draw(job, *given, **named))[1]
    )
    # Of other options nothing is kept; of the same ones what is whole is not drawn again.
    told = []
    made = render_film(path, tmp_path / "film.mp4", SMALL, notify=lambda done, of: told.append(done))
    assert [part.first for part in calls[1]] == [6, 12] and whole.name not in [Path(p.path).name for p in calls[1]]
    assert (made.before, told[0], made.n_images) == (6, 6, 14)
    assert len(read_film(tmp_path / "film.mp4")[0]) == 14
    assert not parts.exists()


def test_parts_of_another_film_are_not_taken(tmp_path, monkeypatch):
    path = store(tmp_path / "r.zarr", [400.0 + i for i in range(8)])
    names = []

    def remember(job, folder, timeout_s, tell, **options):
        names.append([Path(part.path) for part in job.parts])
        for part in names[-1]:
            part.touch()
            about = {"held": [], "broken": {"3": "bad"} if part is names[-1][0] else {}, "codec": "x", "bytes": 0}
            part.with_suffix(".json").write_text(json.dumps(about))
        raise RenderError("stopped")

    monkeypatch.setattr(film, "draw_apart", remember)
    monkeypatch.setattr(film.os, "cpu_count", lambda: 1)
    for options in (SMALL, SMALL, PictureOptions(size_px=SIZE, colors="depth")):
        with pytest.raises(RenderError, match="stopped"):
            render_film(path, tmp_path / "film.mp4", options)
    assert len(names[0]) == 2
    assert names[1] == names[0][:1], "one that held a damaged frame is drawn again, the other is kept"
    assert not {*names[2]} & {*names[0]}
    left = {file.stem for file in (tmp_path / ".film.mp4.parts").iterdir()}
    assert left == {file.stem for file in names[2]}, "what is of no use is removed"


@pytest.mark.usefixtures("can_draw")
def test_a_broken_chunk_is_named_and_the_rest_is_shown(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0, 401.0, 402.0])
    chunk = path / "points" / "c.1.0.0.0"
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 1
    chunk.write_bytes(data)
    made = render_film(path, tmp_path / "film.mp4", SMALL)
    assert (made.n_images, made.held, list(made.broken)) == (3, (1,), [1])
    assert "frame 1" in made.broken[1] and "decode again as before, which repairs it" in made.broken[1]


@pytest.mark.usefixtures("can_draw")
def test_a_turntable_of_a_mesh(tmp_path):
    options = PictureOptions(view="front", colors="texture", turn_deg=180, fps=8, seconds=0.5, size_px=SIZE)
    assert render_film(dome(), tmp_path / "film.mp4", options).n_images == 4
    seen, _ = read_film(tmp_path / "film.mp4")
    y, x = SIZE[1] // 3, SIZE[0] // 2
    assert seen[0, y, x - 25, 0] > seen[0, y, x - 25, 2] + 60, "red on the left"
    assert seen[-1, y, x - 25, 2] > seen[-1, y, x - 25, 0] + 60, "from behind it is on the right"


@pytest.mark.usefixtures("can_draw")
def test_turning_and_swaying(tmp_path):
    path = store(tmp_path / "r.zarr", 5 * [400.0])
    widths = {}
    for name, motion in (("turn", {"turn_deg": 60.0}), ("sway", {"sway_deg": 40.0})):
        options = PictureOptions(view="front", size_px=SIZE, **motion)
        render_film(path, tmp_path / f"{name}.mp4", options)
        seen, _ = read_film(tmp_path / f"{name}.mp4")
        # The codec leaves a line of the ground here and there that differs: columns of more than that are the surface.
        columns = [np.flatnonzero(shown(picture).sum(axis=0) > 4) for picture in seen]
        widths[name] = [int(np.ptp(places)) for places in columns]
    assert np.all(np.diff(widths["turn"]) <= 0)
    assert widths["turn"][-1] < 0.75 * widths["turn"][0]
    first, left, middle, right, last = widths["sway"]
    assert max(left, right) < 0.9 * first
    assert max(first, middle, last) - min(first, middle, last) <= 2


@pytest.mark.usefixtures("can_draw")
@pytest.mark.parametrize("colors", ["depth", "modulation", "sigma", "clay"])
def test_a_single_frame_in_rad_lasts_some_seconds(tmp_path, colors):
    path = store(tmp_path / "r.zarr", [400.0], in_mm=False)
    options = PictureOptions(colors=colors, fps=10, seconds=0.5, size_px=SIZE)
    assert render_film(path, tmp_path / "film.mp4", options).n_images == 5
    seen, _ = read_film(tmp_path / "film.mp4")
    assert shown(seen[0]).mean() > 0.1


@pytest.mark.usefixtures("can_draw")
def test_every_second_frame_is_no_gap(tmp_path):
    path = store(tmp_path / "r.zarr", 7 * [400.0], missing=(0, 2, 4, 6), step=2)
    made = render_film(path, tmp_path / "film.mp4", SMALL)
    assert (made.n_images, made.held) == (3, ())


@pytest.mark.usefixtures("can_draw")
def test_frames_without_a_surface(tmp_path):
    path = store(tmp_path / "r.zarr", [None, 400.0, None])
    assert render_film(path, tmp_path / "film.mp4", SMALL).held == (0, 2)
    with pytest.raises(RenderError, match="no frame shows a surface"):
        render_film(store(tmp_path / "n.zarr", [None, None]), tmp_path / "none.mp4", SMALL)
    assert not (tmp_path / "none.mp4").exists()


def test_what_is_refused(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0, 401.0], leave_out=("modulation",))
    with pytest.raises(FootageError, match="holds no modulation: decode with that field"):
        render_film(path, tmp_path / "film.mp4", PictureOptions(colors="modulation"))
    with pytest.raises(OutputError, match=r"name it \.mp4"):
        render_film(path, tmp_path / "film.avi")
    with pytest.raises(OutputError, match="even numbers"):
        render_film(path, tmp_path / "film.mp4", PictureOptions(size_px=(161, 120)))
    zarr.open_group(path)["done"][:] = 0x20
    with pytest.raises(FootageError, match="no frame that is done"):
        render_film(path, tmp_path / "film.mp4")


def test_a_child_that_dies_leaves_nothing(tmp_path, monkeypatch):
    path = store(tmp_path / "r.zarr", [400.0, 401.0])
    program = "import os, signal; os.kill(os.getpid(), 11)"
    monkeypatch.setattr(drawing_process, "COMMAND", ["-c", program])
    with pytest.raises(RenderError, match="apt-get install libegl1"):
        render_film(path, tmp_path / "film.mp4")
    monkeypatch.setattr(drawing_process, "COMMAND", ["-c", "import time; time.sleep(60)"])
    with pytest.raises(RenderError, match=r"more than 0\.5 s"):
        render_film(path, tmp_path / "film.mp4", timeout_s=0.5)
    assert [p.name for p in tmp_path.iterdir()] == ["r.zarr"]


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
@pytest.mark.parametrize("size", [(160, 120), (1280, 960)])
def test_colors_are_those_that_were_drawn(tmp_path, monkeypatch, codec, size, cpu):
    """Whatever a player guesses of a file that does not say its matrix; to 3 grey levels."""
    monkeypatch.setattr(av, "codecs_available", {codec})
    color = (220, 60, 40)
    with FilmEncoder(tmp_path / "part.mp4", size, 30) as encoder:
        encoder.add(np.full((*size[::-1], 3), color, np.uint8))
    assert encoder.codec == codec
    join_parts([(tmp_path / "part.mp4", 1)], tmp_path / "film.mp4", 30)
    source = open_footage(tmp_path / "film.mp4")
    (frame,) = source.frames()
    assert source.notes == ()
    np.testing.assert_allclose(255 * develop(frame.planes, frame.format)[size[1] // 2, size[0] // 2], color, atol=3)


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
@pytest.mark.parametrize("fps", [30, 12.5, 29.97])
def test_joined_parts_are_one_film_without_a_gap(tmp_path, monkeypatch, codec, fps):
    monkeypatch.setattr(av, "codecs_available", {codec})
    levels, parts = [], []
    for number, length in enumerate((5, 1, 7)):
        parts.append((tmp_path / f"{number}.mp4", length))
        with FilmEncoder(parts[-1][0], (64, 48), fps) as encoder:
            for _ in range(length):
                levels.append(10 * len(levels) + 40)
                encoder.add(np.full((48, 64, 3), levels[-1], np.uint8))
    join_parts(parts, tmp_path / "film.mp4", fps)
    seen, rate = read_film(tmp_path / "film.mp4")
    assert rate == pytest.approx(fps, rel=1e-3)
    np.testing.assert_allclose(seen.mean(axis=(1, 2, 3)), levels, atol=6)
    with av.open(str(tmp_path / "film.mp4")) as film:
        stream = film.streams.video[0]
        times = [float(frame.pts * stream.time_base) for frame in film.decode(video=0)]
        np.testing.assert_allclose(times, np.arange(13) / fps, atol=1e-3)
