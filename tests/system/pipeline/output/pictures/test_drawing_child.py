"""The process that draws, as it is started; what its pictures show is in test_render.py and test_film.py."""

import json

import pytest
from support.drawn_surfaces import DRAWING_PROCESS, read_film, require_drawing
from support.stored_planes import store

from pipeline.errors import RenderError
from pipeline.output.pictures import drawing_process
from pipeline.output.pictures.drawing_process import FilmPart, PictureJob, PictureOptions, draw_apart

SMALL = PictureOptions(size_px=(64, 48))


@pytest.fixture(scope="module", autouse=True)
def can_draw(tmp_path_factory):
    require_drawing(tmp_path_factory.mktemp("probe"))


def test_a_part_is_drawn_and_says_what_was_held(tmp_path, monkeypatch):
    monkeypatch.setattr(drawing_process, "COMMAND", DRAWING_PROCESS)
    path = store(tmp_path / "r.zarr", [None, 400.0, None, 402.0])
    part = FilmPart(first=2, stop=4, path=str(tmp_path / "part.mp4"))
    job = PictureJob(options=SMALL, store=str(path), numbers=(0, 1, 2, 3), parts=(part,))
    heard = []
    draw_apart(job, tmp_path, 120.0, heard.append)
    assert heard[:2] == [{"part": 2, "drawn": 1}, {"part": 2, "drawn": 2}]
    about = json.loads((tmp_path / "part.json").read_text())
    assert about["held"] == [2] and about["broken"] == {}
    seen, _ = read_film(tmp_path / "part.mp4")
    assert len(seen) == 2 and abs(seen[0] - seen[0][:, :1]).max() > 12, "the frame before the part is shown"
    assert not list(tmp_path.glob("part.mp4.*")), "nothing half-written stays"


def test_a_frame_that_is_not_there(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0, 401.0], missing=(1,))
    job = PictureJob(options=SMALL, store=str(path), numbers=(1,), picture="picture.png")
    with pytest.raises(RenderError, match=r"^cannot draw: frame 1 shows no surface: choose another --frame$"):
        draw_apart(job, tmp_path, 120.0)
