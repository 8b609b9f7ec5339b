"""The page in a real browser: what it shows, what it measures, and what becomes of mishaps."""

import io
import re
import shutil
import signal
import subprocess
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from PIL import Image
from support.browser import PATIENCE_MS, browsing, click, drag
from support.command_line import command as command_line

import colorphase
from pipeline.output.mesh import Mesh
from pipeline.view.message import ViewedFrame
from pipeline.view.page import color_table, page
from pipeline.view.server import ViewServer
from pipeline.view.subjects import FootageSubject, MeshSubject, ResultSubject

SIZE_PX = (160, 120)


@pytest.fixture(scope="module")
def rig():
    return colorphase.simulated_rig(SIZE_PX, period_px=64)


@pytest.fixture(scope="module")
def film(rig, tmp_path_factory):
    """Make a recording of three planes, and its result."""
    folder = tmp_path_factory.mktemp("film")
    with colorphase.Recorder(folder / "film.zarr", colorphase.PixelFormat("rgb"), rate_hz=10) as recorder:
        for seed in range(3):
            settings = colorphase.SimulationSettings(scene="plane", seed=seed)
            recorder.add(colorphase.simulate_frame(rig, settings).image)
    fields = ("points", "mask", "point_sigma", "fringe_order", "texture")
    options = {"calibration": rig, "arch": "cpu", "workers": 1, "fields": fields}
    colorphase.decode_footage(folder / "film.zarr", folder / "out", **options)
    return folder


@contextmanager
def served(subject):
    with ViewServer(subject) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


def shown(tab, number=0):
    tab.wait_for_selector(f'body[data-shown="{number}"]')


def until(tab, condition):
    """Wait for a condition; the page lets no text be run inside it, so it is asked from here."""
    deadline = time.monotonic() + PATIENCE_MS / 1000
    while not tab.evaluate(f"!!({condition})"):
        assert time.monotonic() < deadline, condition
        time.sleep(0.05)


def measured(tab):
    return tab.locator("#measured").text_content()


def picture(tab, pane):
    return np.asarray(Image.open(io.BytesIO(tab.locator(f"#{pane} canvas").first.screenshot())).convert("RGB"))


def test_a_result_is_drawn_played_and_measured(film):
    result = colorphase.StoredResult(film / "out" / "result.zarr")
    with served(ResultSubject(film / "out" / "result.zarr")) as server, browsing() as tab:
        tab.goto(server.address)
        shown(tab)
        # A map with many colours; a surface that is a large part of its pane, shaded, on an even ground.
        assert len(np.unique(picture(tab, "map").reshape(-1, 3), axis=0)) > 50
        drawn = picture(tab, "surface").astype(int)
        surface = np.abs(drawn - drawn[5, 5]).sum(axis=-1) > 30
        assert 0.2 < surface.mean() < 0.95
        (first_x, first_y), (second_x, second_y) = (40, 30), (120, 90)
        click(tab, "map", first_x, first_y)
        click(tab, "picture", second_x, second_y)
        points = result[0].points
        apart = np.linalg.norm(points[first_y, first_x] - points[second_y, second_x])
        said = measured(tab)
        assert float(re.search(r"distance ([\d.]+) mm", said)[1]) == pytest.approx(apart, abs=1e-3)
        x, y, z = (float(value) for value in re.search(r"1: ([-\d., ]+) mm", said)[1].split(", "))
        assert (x, y, z) == pytest.approx(points[first_y, first_x], abs=1e-3)
        assert f"sigma {result[0].point_sigma[first_y, first_x]:.4f} mm" in said
        assert f"order {result[0].fringe_order[first_y, first_x]}" in said
        # A third one makes a plane, and a map of what is off it.
        click(tab, "map", 40, 90)
        assert re.search(r"plane of 3 points: RMS 0.0000 mm, tilted [\d.]+ degrees", measured(tab))
        tab.select_option("#field", "deviation")
        until(tab, "viewer.ranges.deviation")
        assert tab.evaluate("Math.max(...viewer.ranges.deviation.map(Math.abs))") < 3
        # The surface takes clicks, too.
        tab.click("#clear")
        box = tab.locator("#surface canvas").bounding_box()
        tab.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        assert re.search(r"1: [-\d., ]+ mm", measured(tab))
        tab.click("text=section")
        drag(tab, "map", (20, 60), (140, 60))
        curve = tab.evaluate("viewer.section(viewer.marks.at(-1))")
        assert np.array(curve["y"]) == pytest.approx(points[60, 20:141, 2], abs=1e-3)
        tab.click("text=crop")
        drag(tab, "map", (30, 30), (60, 50))
        corners = [int(value) for value in re.search(r"--crop ([-\d ]+)", measured(tab))[1].split()]
        inside = points[30:51, 30:61].reshape(-1, 3)
        assert (corners[:3] <= inside.min(axis=0)).all() and (corners[3:] >= inside.max(axis=0)).all()
        tab.click("#clear")
        tab.click("#play")
        shown(tab, 2)
        until(tab, "viewer.playing === null && viewer.frame.step === 1")
        tab.click("#back")
        shown(tab, 1)
        tab.reload()
        shown(tab)
        with tab.expect_download() as saved:
            tab.click("#save")
        with Image.open(saved.value.path()) as image:
            assert image.size[0] > 200


def test_a_recording_is_decoded_as_it_is_looked_at(film, rig):
    with colorphase.open_footage(film / "film.zarr") as footage:
        image = next(footage.images())
        subject = FootageSubject(footage, colorphase.DecodeSettings(), rig, "cpu")
        with served(subject) as server, browsing() as tab:
            tab.goto(server.address)
            shown(tab)
            seen = tab.evaluate("Array.from(viewer.frame.arrays.picture.slice(0, 300))")
            assert seen == image.ravel()[:300].tolist()
            tab.fill("#place", "2")
            shown(tab, 2)
            until(tab, "viewer.frame.step === 1")
            tab.select_option("#field", "phase")
            until(tab, "viewer.frame.arrays.phase")


def test_damage_is_said_in_the_page_and_a_growing_result_grows(film, tmp_path):
    store = tmp_path / "result.zarr"
    shutil.copytree(film / "out" / "result.zarr", store)
    (mark,) = store.glob("done/*2*")
    held = mark.read_bytes()
    mark.unlink()
    (chunk,) = store.glob("points/c*1.0.0.0")
    chunk.write_bytes(chunk.read_bytes()[:-100])
    with served(ResultSubject(store)) as server, browsing() as tab:
        tab.allowed.append("422")
        tab.goto(server.address)
        shown(tab)
        tab.click("#forward")
        until(tab, "document.getElementById('status').textContent.includes('decode again as before')")
        mark.write_bytes(held)
        until(tab, "viewer.about.count === 3")
        tab.click("#forward")
        shown(tab, 2)
        assert tab.locator("#status").text_content() == ""
        # Somebody else looks at the same, and the program ends.
        second = tab.context.browser.new_page()
        second.goto(server.address)
        shown(second)
        second.close()
        tab.context.set_offline(True)
        tab.allowed.append("ERR_INTERNET_DISCONNECTED")
        tab.click("#back")
        until(tab, "document.getElementById('status').textContent.includes('has ended')")


def test_a_mesh_is_a_page_of_one_pane():
    corners = np.array([[0, 0, 800], [100, 0, 800], [0, 100, 820], [100, 100, 810]], np.float32)
    mesh = Mesh(corners, np.array([[0, 1, 2], [1, 3, 2]], np.int32), np.full((4, 3), 200, np.uint8))
    with served(MeshSubject(mesh, "sheet.ply")) as server, browsing() as tab:
        tab.goto(server.address)
        shown(tab)
        assert not tab.locator("#map").is_visible()
        drawn = picture(tab, "surface").astype(int)
        assert (np.abs(drawn - drawn[5, 5]).sum(axis=-1) > 30).mean() > 0.2
        tab.select_option("#color", "texture")


def test_a_page_with_its_frames_in_it_fits_a_ball_and_runs_no_text_of_a_file(tmp_path):
    """A cap of 3,000 points on a wall, with noise, in a circle that reaches past it."""
    random = np.random.default_rng(1)
    rows, columns = np.indices((120, 160), np.float32)
    points = np.stack([columns - 80, rows - 60, np.full_like(rows, 1000)], axis=-1)
    away = np.hypot(points[..., 0], points[..., 1])
    ball = away < 31
    points[ball, 2] = 880 - np.sqrt(38.5**2 - away[ball] ** 2)
    points[..., 2] += random.normal(0, 0.05, ball.shape)
    assert 2900 < ball.sum() < 3100
    title = "</script><script>document.body.dataset.ran = 1</script><img src=x onerror=alert(1)>"
    about = {
        **{"title": title, "count": 1, "size": (160, 120), "rate_hz": 1, "colors": color_table()},
        **{"camera": False, "growing": False, "live": False},
        "maps": {"depth": {"unit": "mm", "kind": "number"}},
    }
    frame = ViewedFrame({"points": points}, 0, warnings=(title,))
    (tmp_path / "page.html").write_text(page(about, [frame]), encoding="utf-8")
    with browsing() as tab:
        tab.goto((tmp_path / "page.html").as_uri())
        shown(tab)
        assert tab.locator("h1").text_content() == title
        assert tab.evaluate("document.body.dataset.ran") is None
        tab.click("text=ball")
        drag(tab, "map", (80, 60), (113, 60))
        assert float(re.search(r"diameter ([\d.]+) mm", measured(tab))[1]) == pytest.approx(77, abs=0.05)
        # Not even a script of the page's own hand gets out, or makes code of a text.
        tab.allowed += ["Content Security Policy", "Refused"]
        refused = "fetch('http://127.0.0.1:1/').then(() => 'out', () => 'kept')"
        assert tab.evaluate(refused) == "kept"


def test_a_rig_is_watched(tmp_path):
    """Its newest frame, how well the light is set, and the same page while it records."""
    command = ("view", "--rig", "simulated", "--no-browser", "--arch", "cpu")
    with started(tmp_path, *command) as address, browsing() as tab:
        tab.allowed.append("422")  # until the first frame is there
        tab.goto(address)
        tab.wait_for_selector("body[data-shown]")
        number = tab.evaluate("viewer.frame.number")
        until(tab, f"viewer.frame.number > {number}")
        status = r"\d+ ms from exposure to surface, contrast \d+%, sharpness [\d.]+%, clipped [\d.]+%"
        assert re.match(status, tab.locator("#status").text_content())
        assert tab.locator("#plot").is_visible()
        tab.click("text=Hold")
        held = tab.evaluate("viewer.frame.number")
        click(tab, "map", 320, 240)
        assert "mm, sigma" in measured(tab)
        tab.click("text=Go on")
        until(tab, f"viewer.frame.number > {held}")


@contextmanager
def started(folder, *words):
    """Run a command that shows a page, yield the page's address, and end it by Ctrl-C."""
    with subprocess.Popen(command_line(*words), cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline()
            yield re.search(r"http://127\.0\.0\.1:\d+/\S+/", line)[0]
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)
    assert process.returncode == 0


def test_a_notebook_shows_frames_without_a_server(film, tmp_path):
    result = colorphase.StoredResult(film / "out" / "result.zarr")
    for name, shown_page, count in (("frame", result[1].view(), 1), ("result", result.view(), 3)):
        file = tmp_path / f"{name}.html"
        file.write_text(f"<meta charset=utf-8>{shown_page._repr_html_()}", encoding="utf-8")
        with browsing() as tab:
            tab.goto(file.as_uri())
            (inner,) = tab.main_frame.child_frames
            inner.wait_for_selector("body[data-shown]")
            assert inner.evaluate("viewer.about.count") == count
            assert inner.evaluate("viewer.frame.arrays.points.length") == 3 * SIZE_PX[0] * SIZE_PX[1]
            assert inner.evaluate("viewer.frame.number") == (1 if count == 1 else 0)
            drawn = np.asarray(Image.open(io.BytesIO(inner.locator("#surface canvas").screenshot())).convert("RGB"))
            assert (np.abs(drawn.astype(int) - drawn[5, 5]).sum(axis=-1) > 30).mean() > 0.2
