"""Live decoding whose processes are killed, stopped or interrupted."""

import os
import signal
import subprocess
import sys
import time

import pytest
from support.live_frames import PATIENCE_S, SIZE_PX, decoded, image, rig, wait_for

from pipeline.acquisition import live
from pipeline.acquisition.live import LiveDecoder

__all__ = ["image", "rig"]

pytestmark = pytest.mark.usefixtures("kernels_on_disk")
on_posix = pytest.mark.skipif(os.name != "posix", reason="Windows has no such signals")


def is_alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@on_posix
def test_its_process_is_killed(rig, image):
    """The capturing process goes on, and can say why frames are no longer decoded."""
    with LiveDecoder(SIZE_PX, calibration=rig, arch="cpu") as decoder:
        decoded(decoder, image, 1)
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
    decoder = LiveDecoder(SIZE_PX, calibration=rig, arch="cpu")
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


START = """
import signal, sys, time
import numpy as np
from pipeline.acquisition.live import LiveDecoder
frame = np.zeros((96, 128, 3), np.uint8)
decoder = LiveDecoder((128, 96), arch="cpu")
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
