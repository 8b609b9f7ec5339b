"""The page of a notebook: complete, of bounded size, and clear about the frames that it leaves out."""

import re

import pytest

import colorphase
from pipeline.errors import FootageError
from pipeline.view import embedded

SIZE_PX = (160, 120)


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("film")
    rig = colorphase.simulated_rig(SIZE_PX, period_px=64)
    image = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane")).image
    with colorphase.Recorder(folder / "film.zarr", colorphase.PixelFormat("rgb"), rate_hz=10) as recorder:
        for _ in range(5):
            recorder.add(image)
    colorphase.decode_footage(folder / "film.zarr", folder / "out", calibration=rig, arch="cpu", workers=1)
    return colorphase.StoredResult(folder / "out" / "result.zarr")


def count(page):
    return len(re.findall(r'id="frame-\d+"', page.html))


def test_a_long_result_is_shown_in_part_and_the_page_says_so(result, monkeypatch):
    assert count(result.view()) == 5
    monkeypatch.setattr(embedded, "_MOST_FRAMES", 3)
    page = result.view()
    assert count(page) == 3
    assert "3 of 5 frames" in page.html
    large = len(page.html)
    monkeypatch.setattr(embedded, "_MOST_BYTES", 100_000)
    assert len(result.view().html) < large


def test_the_frame_of_a_notebook_may_do_nothing_but_draw(result):
    html = result[0].view()._repr_html_()
    assert html.startswith('<iframe sandbox="allow-scripts allow-downloads" ')
    assert "connect-src &amp;#x27;none&amp;#x27;" in html


def test_a_result_without_a_frame_says_so(result, monkeypatch):
    monkeypatch.setattr(result, "done", ())
    with pytest.raises(FootageError, match="holds no frame that is done: decode first"):
        result.view()
