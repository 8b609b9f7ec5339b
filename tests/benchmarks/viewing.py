"""How long the viewer takes: steps through a long result, its memory, and live frames from exposure to message.

    python tests/benchmarks/viewing.py [--frames 10000] [--seconds 20] [--browser]

The result has small frames (160x120) and is made by copying one frame's chunks. Live frames are a simulated rig's, 20 a
second; with --browser headless Chromium draws them on the same cores, and surfaces a second are counted.
"""

import argparse
import json
import re
import shutil
import signal
import statistics
import subprocess
import tempfile
import time
import urllib.request
from contextlib import ExitStack, contextmanager
from pathlib import Path

import _tests_path  # noqa: F401 (makes `support` importable)
import numpy as np
from support.browser import browsing
from support.command_line import command

import colorphase

RIG = """
[trigger]
driver = "simulated"
[timing]
period_s = 0.05
frames = 1
[camera]
driver = "simulated"
exposure_s = 0.008
"""


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
    """Print the time from exposure to message, next to a capture, and what the capture lost."""
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    words = ("capture", "--rig", "rig.toml", "--out", "live", "--endless", "--view", "--arch", "cpu")
    with viewed(*words, cwd=folder) as (address, process), ExitStack() as stack:
        tab = None
        if browser:
            tab = stack.enter_context(browsing())
            tab.goto(address)
            tab.wait_for_selector("body[data-shown]")
            drawn = tab.evaluate("viewer.surface.drawn")
        after, took, until = -1, [], time.monotonic() + seconds
        urllib.request.urlopen(address + "about").read()
        while time.monotonic() < until:
            message = urllib.request.urlopen(f"{address}live?after={after}&fields=points,sigma,picture&step=2").read()
            if not message:
                continue
            head = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
            after = head["number"]
            took.append(time.monotonic() - head["exposed_at_s"])
        print(
            f"live: {1e3 * statistics.median(took):.0f} ms at the median from exposure to message, {len(took)} frames"
        )
        if tab is not None:
            print(f"{(tab.evaluate('viewer.surface.drawn') - drawn) / seconds:.1f} surfaces/s drawn")
        print(f"capture: {memory_mb(process):.0f} MB at most")
    log = [json.loads(line) for line in (folder / "live" / "log.jsonl").read_text().splitlines()]
    print(f"{sum(event['event'] == 'frame' for event in log)} frames recorded, ", end="")
    print(f"{sum(event['event'] == 'rejected' for event in log)} bursts thrown away")


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
