"""Compiled kernels on the disk: nobody compiles again because others read or write them, or were killed meanwhile."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from tikernels import compiled_kernels, runtime
from tikernels.compiled_kernels import list_locked

pytestmark = pytest.mark.skipif(
    runtime.kernel_language() != "taichi", reason="the other kernel language locks its kernels itself"
)

HOLD = """
import sys
sys.path[:0] = sys.argv[1:]
from tikernels.compiled_kernels import list_locked
with list_locked():
    print("held", flush=True)
    sys.stdin.readline()
"""

COMPILE = """
import sys
sys.path[:0] = sys.argv[1:]
import numpy as np, tikernels
tikernels.init("cpu")
tikernels.smooth_phase(np.zeros((8, 8), np.float32), np.ones((8, 8), bool), 3)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TI_OFFLINE_CACHE_FILE_PATH", str(tmp_path / "kernels"))
    return tmp_path / "kernels"


@pytest.fixture
def holder(folder):
    command = [sys.executable, "-c", HOLD, *sys.path]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


@pytest.fixture
def waiting(holder):
    """Return a thread that waits for its turn, and what tells that it has had it."""
    entered = threading.Event()

    def enter():
        with list_locked():
            entered.set()

    thread = threading.Thread(target=enter)
    thread.start()
    assert not entered.wait(0.3)
    yield entered
    thread.join(60)


def test_the_second_waits_for_the_first(holder, waiting):
    holder.communicate("\n", timeout=20)
    assert waiting.wait(20)


@pytest.mark.skipif(os.name != "posix", reason="a signal that cannot be caught")
def test_a_killed_process_holds_nothing(holder, waiting):
    holder.send_signal(signal.SIGKILL)
    assert waiting.wait(20)


def test_nobody_is_waited_for_without_end(holder, monkeypatch):
    monkeypatch.setattr(compiled_kernels, "_PATIENCE_S", 0.2)
    begin = time.monotonic()
    with list_locked():
        assert 0.2 <= time.monotonic() - begin < 5


@pytest.mark.parametrize(("age_s", "least_s"), [(3600, 0), (0, 0.5), (-3600, 0.5)], ids=["old", "young", "from ahead"])
def test_a_lock_that_is_left(folder, monkeypatch, age_s, least_s):
    """It is removed once it is old; its time may be of another clock."""
    monkeypatch.setattr(compiled_kernels, "_PATIENCE_S", 0.5)
    folder.mkdir()
    lock = folder / "ticache.lock"
    lock.touch()
    os.utime(lock, (time.time() - age_s,) * 2)
    begin = time.monotonic()
    with list_locked():
        assert not lock.exists()
        # Files' times have steps of some milliseconds.
        assert least_s - 0.05 <= time.monotonic() - begin < least_s + 5


def test_a_lock_that_goes(folder, monkeypatch):
    """It is of another program of Taichi's, at work."""
    folder.mkdir()
    lock = folder / "ticache.lock"
    lock.touch()
    timer = threading.Timer(0.3, lock.unlink)
    timer.start()
    begin = time.monotonic()
    with list_locked():
        assert 0.2 < time.monotonic() - begin < 9
    timer.join()


def test_a_folder_that_cannot_be(folder):
    """Kernels are then compiled anew each time; nothing is to be locked."""
    folder.write_text("no folder")
    with list_locked():
        pass
    assert folder.read_text() == "no folder"


@pytest.mark.skipif(os.name != "posix", reason="links for everybody")
def test_a_link_in_place_of_the_lock(folder):
    """It is not followed; kernels are then read and written without a lock."""
    folder.mkdir()
    (folder / "colorphase.lock").symlink_to("new")
    with list_locked():
        assert not (folder / "new").exists()


def test_kernels_are_kept_though_a_killed_process_had_locked_them(folder):
    folder.mkdir()
    lock = folder / "ticache.lock"
    lock.touch()
    os.utime(lock, (time.time() - 60,) * 2)
    subprocess.run([sys.executable, "-c", COMPILE, *sys.path], check=True, timeout=120)
    assert any(folder.glob("*.tic")) and not lock.exists()
