"""Live decoding: what a process of its own makes of the newest frame, and that nothing ever waits for it."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.acquisition import live
from pipeline.acquisition.live import LiveDecoder
from pipeline.output.range_image import write_range_image
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import ShapeError, develop
from tikernels.raw.pixel_format import PixelFormat

RGB8, BAYER12 = PixelFormat("rgb"), PixelFormat("bayer", 12, bayer="grbg")
SIZE_PX = (128, 96)
# Starting takes 3 to 12 s, by machine, most of it making machine code; beside other work several times as long.
PATIENCE_S = 180

pytestmark = pytest.mark.usefixtures("kernels_on_disk")
on_posix = pytest.mark.skipif(os.name != "posix", reason="Windows has no such signals")


@pytest.fixture(scope="module")
def rig():
    settings = SimulationSettings()
    return simulated_rig(SIZE_PX, period_px=2 * 768 / 44).model_copy(
        update={"crosstalk_matrix": settings.crosstalk_matrix}
    )


@pytest.fixture(scope="module")
def image(rig, cpu):
    return simulate_frame(rig, SimulationSettings()).image


def mosaic(image, format):
    rows, columns = np.indices(image.shape[:2])
    colors = np.array(["rgb".index(color) for color in format.bayer]).reshape(2, 2)
    return image[rows, columns, colors[rows % 2, columns % 2]].astype(np.uint16) * 16


def wait_for(so, patience_s=PATIENCE_S):
    end = time.monotonic() + patience_s
    while not so():
        assert time.monotonic() < end, "it does not come"
        time.sleep(0.002)


def decoded(decoder, frame, number):
    """Offer a frame until it is taken, and return what becomes of it."""
    wait_for(lambda: decoder.offer(frame, number, time.monotonic()) or decoder.ended)
    wait_for(lambda: decoder.ended or (decoder.latest() is not None and decoder.latest().number == number))
    return decoder.latest()


def is_alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("format", [RGB8, BAYER12], ids=["rgb", "bayer"])
def test_what_becomes_of_a_frame(rig, image, tmp_path, format):
    frame = image if format is RGB8 else mosaic(image, format)
    expected = Decoder(DecodeSettings(), rig, arch="cpu").decode(develop((frame,), format))
    write_range_image(tmp_path / "expected.png", expected.range_image, expected.mask, "mm")
    begin = time.monotonic()
    with LiveDecoder(DecodeSettings(), rig, format, SIZE_PX, tmp_path / "live.png", "cpu") as decoder:
        assert decoder.latest() is None
        assert not decoder.offer(frame, 0, begin)  # it is still starting
        result = decoded(decoder, frame, 7)
        assert 0 < result.latency_s < time.monotonic() - begin
        assert result.measured == pytest.approx(expected.mask.mean())
        assert result.measured > 0.5
        assert result.phase_sigma == pytest.approx(np.median(expected.phase_sigma[expected.mask]))
        assert result.warnings == expected.warnings
        assert (tmp_path / "live.png").read_bytes() == (tmp_path / "expected.png").read_bytes()
        # The frame is the caller's again at once, and while it is decoded no other one is taken.
        wait_for(lambda: decoder.ready)
        buffer = frame.copy()
        assert decoder.offer(buffer, 8, time.monotonic())
        buffer[...] = 0
        taken = decoder.offer(buffer, 9, time.monotonic())
        wait_for(lambda: decoder.latest().number >= 8)
        assert taken or decoder.latest().measured == result.measured
        dark = decoded(decoder, np.zeros_like(frame), 10)
        assert dark.measured == 0
        assert np.isnan(dark.phase_sigma)
        assert "no fringe stands out" in dark.warnings[0]
        with pytest.raises(ShapeError, match=r"frame has shape \(95, 128"):
            decoder.offer(frame[1:], 11, 0)
        assert decoder.ended is None
    assert decoder.ended == "live decoding was closed"
    assert not decoder.offer(frame, 12, 0)
    decoder.close()
    assert sorted(left.name for left in tmp_path.iterdir()) == ["expected.png", "live.png"]


@on_posix
def test_its_process_is_killed(rig, image, tmp_path):
    """The capturing process goes on, and can say why frames are no longer decoded."""
    with LiveDecoder(DecodeSettings(), rig, RGB8, SIZE_PX, tmp_path / "absent" / "live.png", "cpu") as decoder:
        first = decoded(decoder, image, 1)
        assert "its folder does not exist" in first.warnings[-1]
        wait_for(lambda: decoder.offer(image, 2, time.monotonic()))
        os.kill(decoder._process.pid, signal.SIGKILL)
        wait_for(lambda: decoder.ended, 5)
        assert decoder.ended == "live decoding has ended: its process was killed by signal 9"
        assert not decoder.offer(image, 3, time.monotonic())
        assert decoder.latest().number in (1, 2)


@on_posix
def test_its_process_hangs(rig, image, monkeypatch):
    """Nothing waits for it; closing waits a moment and then ends it."""
    monkeypatch.setattr(live, "_CLOSE_S", 0.2)
    decoder = LiveDecoder(DecodeSettings(), rig, RGB8, SIZE_PX, arch="cpu")
    pid = decoder._process.pid
    wait_for(lambda: decoder.ready)
    os.kill(pid, signal.SIGSTOP)
    assert decoder.offer(image, 0, time.monotonic())
    begin = time.monotonic()
    for number in range(1, 100):
        assert not decoder.offer(image, number, time.monotonic())
    assert decoder.latest() is None
    decoder.close()
    assert time.monotonic() - begin < 5
    assert not is_alive(pid)


def test_it_cannot_start(rig, image, monkeypatch):
    other = "vulkan" if sys.platform == "darwin" else "metal"
    with LiveDecoder(DecodeSettings(), rig, RGB8, SIZE_PX, arch=other) as decoder:
        wait_for(lambda: decoder.ended)
        assert decoder.ended.startswith(f"live decoding has ended: {other} cannot be started here")
        assert not decoder.offer(image, 0, 0)

    def refuse(process):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.context.SpawnProcess.start", refuse)
    with LiveDecoder(DecodeSettings(), rig, RGB8, SIZE_PX, arch="cpu") as decoder:
        assert decoder.ended == "live decoding could not start: Resource temporarily unavailable"
        assert not decoder.offer(image, 0, 0)
        assert decoder.latest() is None
    with pytest.raises(ShapeError, match="RGB in one plane"):
        LiveDecoder(DecodeSettings(), rig, PixelFormat("yuv"), SIZE_PX)


START = """
import signal, sys, time
import numpy as np
from pipeline import DecodeSettings
from pipeline.acquisition.live import LiveDecoder
from tikernels.raw.pixel_format import PixelFormat
frame = np.zeros((96, 128, 3), np.uint8)
decoder = LiveDecoder(DecodeSettings(), None, PixelFormat("rgb"), (128, 96), arch="cpu")
print(decoder._process.pid, flush=True)
"""
# What is not ours: Taichi's, once, while it is imported.
PYTHON = [sys.executable, "-W", "error", "-W", "ignore::DeprecationWarning", "-c"]


@pytest.mark.skipif(not os.path.exists("/proc"), reason="processes are found in /proc")
@pytest.mark.parametrize("moment", ["starting", "decoding"])
def test_the_capturing_process_is_killed(moment):
    """No orphan stays, whether it is still starting or at work, nor anything else that was its parent's."""
    wait = "time.sleep(60)"
    if moment == "decoding":
        wait = "while True: decoder.offer(frame, 0, 0) and print('taken', flush=True); time.sleep(0.001)"
    with subprocess.Popen([*PYTHON, START + wait], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as parent:
        pid = int(parent.stdout.readline())
        assert is_alive(pid)
        if moment == "decoding":
            assert parent.stdout.readline() == "taken\n"
        parent.kill()
        # Its pipes are closed when nobody has them open any more: the other process looks for its parent once its
        # kernels are compiled, and takes only what others leave of the cores.
        said = parent.communicate(timeout=4 * PATIENCE_S)
    wait_for(lambda: not is_alive(pid), 10)
    assert said[1] == ""


@on_posix
def test_ctrl_c_is_for_the_capturing_process(tmp_path):
    """At a terminal it comes to both, while one starts, too; and an end without `close` leaves no complaints."""
    wait = """
def wait():
    while True:
        try:
            time.sleep(60)
        except KeyboardInterrupt:
            return

wait()
while not decoder.offer(frame, 5, time.monotonic()): time.sleep(0.01)
print("taken", flush=True)
wait()
while decoder.latest() is None: time.sleep(0.01)
print(decoder.latest().number, decoder.ended, flush=True)
"""
    arguments = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    parent = subprocess.Popen([*PYTHON, START + wait], **arguments)
    with parent:
        pid = int(parent.stdout.readline())
        time.sleep(0.3)
        os.killpg(parent.pid, signal.SIGINT)
        assert parent.stdout.readline() == "taken\n"
        time.sleep(0.1)
        os.killpg(parent.pid, signal.SIGINT)
        said = parent.communicate(timeout=PATIENCE_S)
    assert said == ("5 None\n", "")
    assert parent.returncode == 0
    assert not is_alive(pid)
