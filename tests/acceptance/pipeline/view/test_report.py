"""A report in a real browser: it draws from a file, asks nobody for anything, runs no text, and prints."""

import numpy as np
import pytest
from PIL import Image
from support.browser import browsing

import colorphase
from pipeline.output.stored_result import ResultFrame
from pipeline.view.report import report_result

HOSTILE = "</script></title><script>top.document.body.dataset.ran = 1</script><img src=x onerror=document.title=1>"


@pytest.fixture
def report(tmp_path, cpu, monkeypatch):
    rig = colorphase.simulated_rig((160, 120), period_px=64)
    frame = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    colorphase.Decoder(calibration=rig, arch="cpu").decode(frame.image).save(tmp_path / "result.zarr")
    monkeypatch.setattr(ResultFrame, "warnings", (HOSTILE,), raising=False)
    path = tmp_path / "report.html"
    path.write_text(report_result(str(tmp_path / "result.zarr")), encoding="utf-8")
    return path


def test_a_report_draws_and_runs_nothing_of_a_result(report):
    with browsing() as tab:
        tab.goto(report.as_uri())
        assert tab.locator(".warnings li").text_content() == HOSTILE
        assert tab.evaluate("document.images[0].naturalWidth") > 1000
        tab.locator("iframe").scroll_into_view_if_needed()
        viewer = tab.frame_locator("iframe")
        viewer.locator("body[data-shown]").wait_for()
        assert viewer.locator("#warnings li").text_content() == HOSTILE
        viewer.locator("#map canvas").first.click(position={"x": 20, "y": 20})
        assert "mm, sigma" in viewer.locator("#measured").text_content()
        assert tab.evaluate("document.body.dataset.ran") is None
        with tab.expect_download() as saved:
            viewer.locator("#save").click()
        with Image.open(saved.value.path()) as image:
            drawn = np.asarray(image.convert("RGB")).astype(int)
        assert (np.abs(drawn - drawn[5, 5]).sum(axis=-1) > 30).mean() > 0.2  # the surface, on an even ground


def test_it_prints_without_the_viewer(report):
    with browsing() as tab:
        tab.goto(report.as_uri())
        tab.emulate_media(media="print")
        assert not tab.locator("iframe").is_visible()
        pdf = tab.pdf()
        assert pdf.startswith(b"%PDF") and pdf.count(b"/Type /Page\n") in (1, 2, 3)
