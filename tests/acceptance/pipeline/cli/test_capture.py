"""`colorphase capture` as its user meets it; what is recorded has tests of its own."""

import os
import signal
import subprocess
import time

import pytest
from support.command_line import colorphase
from support.command_line import command as command_line

# The promise is a second, of which a third is work. At a low priority on cores that other programs keep busy that has
# taken 8 s; a request that is lost, or that waits for kernels or instruments, takes longer than this.
ENDS_WITHIN_S = 15.0


@pytest.mark.skipif(os.name != "posix", reason="a terminal's Ctrl-C is a signal")
@pytest.mark.parametrize("options", [(), ("--view", "--no-browser")], ids=["", "view"])
@pytest.mark.parametrize("said", ["starting", "simulating", "of 1 burst"])
def test_ctrl_c_ends_a_capture_within_a_second_and_what_was_recorded_is_whole(tmp_path, options, said):
    """While the device starts, while kernels are compiled, and while bursts are recorded."""
    arguments = command_line(
        *("capture", "--rig", "simulated", "--out", "c", "--arch", "cpu", "--endless", *options),
    )
    environment = {**os.environ, "FORCE_COLOR": "1", "TTY_COMPATIBLE": "1", "COLUMNS": "120"}  # shows its steps
    with subprocess.Popen(arguments, cwd=tmp_path, stderr=subprocess.PIPE, env=environment) as process:
        shown = b""
        while said.encode() not in shown:
            read = os.read(process.stderr.fileno(), 4096)
            assert read, shown
            shown += read
        time.sleep(0.5)  # into it
        asked_s = time.monotonic()
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
        took_s = time.monotonic() - asked_s
    assert process.returncode == (0 if said == "of 1 burst" else 130)  # without an end, Ctrl-C is how it ends
    assert took_s < ENDS_WITHIN_S
    if (tmp_path / "c").exists():
        done = colorphase("verify", "c", cwd=tmp_path)
        assert done.returncode == 0 and "frames are whole" in done.stdout, done.stdout
        assert not list((tmp_path / "c").glob(".*"))
    else:
        assert said != "of 1 burst"
