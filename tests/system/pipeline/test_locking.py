"""One writer at a time, and no lock that outlives its holder."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from pipeline.errors import OutputError
from pipeline.locking import locked

HOLD = """
import sys
sys.path[:0] = sys.argv[2:]
from pathlib import Path
from pipeline.locking import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


def holder(target):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, target, *sys.path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    return process


def test_the_second_is_told_who_is_the_first(tmp_path):
    with holder(tmp_path / "result.zarr") as process:
        with pytest.raises(OutputError, match=rf"is being written by another run \(process {process.pid} on .*since"):
            with locked(tmp_path / "result.zarr"):
                pass
        process.communicate("\n", timeout=20)
    with locked(tmp_path / "result.zarr"):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="a signal that cannot be caught")
def test_a_killed_holder_holds_nothing(tmp_path):
    with holder(tmp_path / "result.zarr") as process:
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=20)
    assert [entry.name for entry in tmp_path.iterdir()] == [".result.zarr.lock"]
    with locked(tmp_path / "result.zarr"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_never_two_at_once(tmp_path):
    """Though the file of the lock comes and goes; however often a thread is refused, each enters 50 times."""
    inside, most, entered = 0, 0, 0
    deadline = time.monotonic() + 60

    def enter():
        nonlocal inside, most, entered
        here = 0
        while here < 50 and time.monotonic() < deadline:
            try:
                with locked(tmp_path / "a"):
                    inside += 1
                    most = max(most, inside)
                    entered += 1
                    here += 1
                    inside -= 1
            except OutputError:
                pass

    threads = [threading.Thread(target=enter) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1 and entered == 200


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(OutputError, match="its folder does not exist: create the folder first"):
        with locked(tmp_path / "none" / "a"):
            pass


@pytest.mark.skipif(os.name != "posix", reason="links for everybody")
def test_what_a_link_in_place_of_the_lock_points_to_is_kept(tmp_path):
    """Folders may come from strangers."""
    precious = tmp_path / "precious"
    precious.write_text("kept")
    (tmp_path / ".result.zarr.lock").symlink_to(precious)
    with pytest.raises(OutputError, match=r"result\.zarr\.lock there is a link or no plain file: remove it"):
        with locked(tmp_path / "result.zarr"):
            pass
    assert precious.read_text() == "kept"
