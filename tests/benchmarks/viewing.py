"""How long the viewer takes: steps through a long result, its memory, and live frames from exposure to message.

    python tests/benchmarks/viewing.py [--frames 10000] [--seconds 20] [--browser]

The result has small frames (160x120). Live frames, 640x480 and coded, are rendered before, recorded and offered 20
times a second, and requested by another process; with --browser headless Chromium draws them on the same cores.
"""

import argparse
import json
import multiprocessing
import re
import shutil
import signal
import statistics
import subprocess
import tempfile
import threading
import time
import urllib.request
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace

import _tests_path  # noqa: F401 (makes `support` importable)
import numpy as np
from support.browser import browsing
from support.command_line import command

import colorphase
from pipeline.acquisition.live import WatchedFrame
from pipeline.view.live_subject import LiveSubject
from pipeline.view.server import ViewServer

#: Frames a second that are recorded and offered.
RATE_HZ = 20


def long_result(folder: Path, n_frames: int) -> Path:
    """Return a result of many frames."""
    rig = colorphase.simulated_rig((160, 120), period_px=64)
    image = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane")).image
    with colorphase.Recorder(folder / "film.zarr", colorphase.PixelFormat("rgb"), rate_hz=30) as film:
        for _ in range(n_frames):
            film.add(image)
    colorphase.decode_footage(folder / "film.zarr", folder / "out", calibration=rig, arch="cpu")
    return folder / "out"


@contextmanager
def viewed(*words: str, cwd: Path | None = None):
    """Run a command that shows a page, and yield its address and its process."""
    with subprocess.Popen(command(*words, "--no-browser"), stdout=subprocess.PIPE, text=True, cwd=cwd) as process:
        try:
            yield re.search(r"http://\S+", process.stdout.readline())[0], process
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)


def memory_mb(process: subprocess.Popen) -> float:
    """Return a process's memory."""
    text = Path(f"/proc/{process.pid}/status").read_text()
    return int(re.search(r"VmHWM:\s+(\d+)", text)[1]) / 1024


def scrub(folder: Path, n_frames: int, browser: bool) -> None:
    """Print what a step of the time bar takes, and the memory at its highest."""
    result = long_result(folder, n_frames)
    places = np.random.default_rng(0).integers(0, n_frames, 200).tolist()
    with viewed("view", str(result)) as (address, process):
        begin = time.perf_counter()
        json.load(urllib.request.urlopen(address + "about"))
        print(f"{n_frames} frames: opened in {time.perf_counter() - begin:.2f} s")
        took = []
        for place in places:
            begin = time.perf_counter()
            urllib.request.urlopen(f"{address}frame/{place}?fields=points,mask,sigma&step=1").read()
            took.append(time.perf_counter() - begin)
        print(f"message: {1e3 * statistics.median(took):.1f} ms at the median, {1e3 * max(took):.0f} at most")
        if browser:
            with browsing() as tab:
                tab.goto(address)
                tab.wait_for_selector("body[data-shown]")
                took = []
                for place in places[:40]:
                    begin = time.perf_counter()
                    tab.fill("#place", str(place))
                    tab.wait_for_selector(f'body[data-shown="{place}"]')
                    took.append(time.perf_counter() - begin)
                print(f"drawn: {1e3 * statistics.median(took):.0f} ms at the median, {1e3 * max(took):.0f} at most")
        print(f"server: {memory_mb(process):.0f} MB at most")


def live(folder: Path, seconds: float, browser: bool) -> None:
    """Print the time from exposure to message, next to a recording of the same frames, and how far that fell behind."""
    size_px, format = (640, 480), colorphase.PixelFormat("rgb")
    settings = [colorphase.SimulationSettings(seed=seed) for seed in range(4)]
    rig = colorphase.simulated_rig(size_px, code="contrast").replace(crosstalk_matrix=settings[0].crosstalk_matrix)
    images = [np.asarray(colorphase.simulate_frame(rig, each).image) for each in settings]
    subject, worst = LiveSubject("benchmark"), 0.0
    with ExitStack() as stack:
        decoder = stack.enter_context(colorphase.LiveDecoder(size_px, calibration=rig, format=format, arch="cpu"))
        server = stack.enter_context(ViewServer(subject))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        stack.callback(server.shutdown)
        watched = WatchedFrame(decoder, format)
        subject.hear(watched, 0)
        decoder.wait(120.0)
        pipe, theirs = multiprocessing.get_context("spawn").Pipe()
        viewer = multiprocessing.get_context("spawn").Process(
            target=watch, args=(server.address, seconds, browser, theirs), daemon=True
        )
        viewer.start()
        recorder = stack.enter_context(colorphase.Recorder(folder / "live.zarr", format, rate_hz=RATE_HZ))
        begin, number = time.monotonic(), 0
        while not pipe.poll():
            due = begin + number / RATE_HZ
            time.sleep(max(0.0, due - time.monotonic()))
            worst = max(worst, time.monotonic() - due)
            image = images[number % len(images)]
            frame = SimpleNamespace(temperature_c=None)
            watched = watched.offered(SimpleNamespace(image=image, frame=frame, exposed_at_s=due), number)
            subject.hear(watched, 0)
            recorder.add(image)
            number += 1
        decoded, took, drawn = pipe.recv()
    print(f"live, medians: decoded {1e3 * statistics.median(decoded):.0f} ms after the exposure, ", end="")
    print(f"message {1e3 * statistics.median(took):.0f} ms after it, {len(took) / seconds:.1f} frames/s sent")
    if browser:
        print(f"{drawn / seconds:.1f} surfaces/s drawn")
    print(f"{number} frames recorded at {RATE_HZ}/s, at most {1e3 * worst:.0f} ms late")


def watch(address: str, seconds: float, browser: bool, pipe: Connection) -> None:
    """Take live frames for some seconds; send the age of each when decoded and when it came, and the surfaces drawn."""
    with ExitStack() as stack:
        while not urllib.request.urlopen(f"{address}live?after=-1&fields=mask&step=2").read():
            pass
        tab, before = None, 0
        if browser:
            tab = stack.enter_context(browsing())
            tab.goto(address)
            tab.wait_for_selector("body[data-shown]")
            before = tab.evaluate("viewer.surface.drawn")
        after, decoded, took, until = -1, [], [], time.monotonic() + seconds
        while time.monotonic() < until:
            if tab is not None:  # the page takes the frames itself
                tab.wait_for_timeout(200)
            message = urllib.request.urlopen(f"{address}live?after={after}&fields=points,sigma,picture&step=2").read()
            if message:
                head = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
                after = head["number"]
                took.append(time.monotonic() - head["exposed_at_s"])
                decoded.append(float(re.match(r"(\d+) ms", head["status"])[1]) / 1e3)
        pipe.send((decoded, took, 0 if tab is None else tab.evaluate("viewer.surface.drawn") - before))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=10000)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--browser", action="store_true")
    options = parser.parse_args()
    place = Path(tempfile.mkdtemp())
    try:
        live(place, options.seconds, options.browser)
        scrub(place, options.frames, options.browser)
    finally:
        shutil.rmtree(place)
