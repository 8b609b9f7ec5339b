"""Processes that this one starts: how they are spoken to, Ctrl-C, and folders that hold modules of a stranger's."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from pipeline.processes import Child, ChildDied, safe_start, start_python

BLOCKED = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))"
has_signals = pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals cannot be blocked here")
ECHO = """
from pipeline.processes import serve
def work(receive, say):
    while True:
        print("a library says hello")
        message = receive()
        if isinstance(message, Exception): raise message
        say(message)
serve(work)
"""


def child_blocks_interrupts():
    return (
        subprocess.run([sys.executable, "-c", BLOCKED], capture_output=True, text=True, check=True).stdout == "True\n"
    )


@has_signals
def test_children_inherit_the_block():
    assert not child_blocks_interrupts()
    with safe_start():
        assert child_blocks_interrupts()
    assert not child_blocks_interrupts()


@has_signals
def test_an_interrupt_waits_until_the_end():
    reached = False
    with pytest.raises(KeyboardInterrupt), safe_start():
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)  # another thread would take the process's
        reached = True
    assert reached


@pytest.mark.parametrize("before", [None, "", "1"])
def test_the_environment_is_left_as_it_was(monkeypatch, before):
    if before is None:
        monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    else:
        monkeypatch.setenv("PYTHONSAFEPATH", before)
    with safe_start():
        assert os.environ["PYTHONSAFEPATH"] == "1"
    assert os.environ.get("PYTHONSAFEPATH") == before


def test_no_process_takes_modules_from_the_working_folder(tmp_path, monkeypatch):
    """Neither one of ours nor one that Python itself starts; and where an empty entry stands on the path, neither."""
    (tmp_path / "pickle.py").write_text("raise SystemExit('a stranger has been run')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")
    where = "import pickle, sys; print(pickle.__file__); sys.exit(str(sys.path[0]) in ('', '.'))"
    done = start_python(["-c", where], stdout=subprocess.PIPE, stderr=subprocess.PIPE).communicate(timeout=60)
    assert done[1] == b"" and str(tmp_path).encode() not in done[0]
    with safe_start():
        subprocess.run([sys.executable, "-c", where], check=True, capture_output=True, timeout=60)


def test_messages_go_there_and_back(capfd):
    with Child(ECHO) as child:
        for message in ("hello", [1, 2], None):
            child.send(message)
            assert child.receive() == message
        child.send(ValueError("of the child"))
        with pytest.raises(ValueError, match="of the child") as caught:
            child.receive()
    assert "in work" in str(caught.value.__cause__)
    assert capfd.readouterr().out == ""


def test_a_child_that_has_died():
    with Child(ECHO) as child:
        child.send("hello")
        child.receive()
        child.kill()
        with pytest.raises(ChildDied):
            child.receive()
        child._process.wait(60)
        with pytest.raises(ChildDied):
            child.send("hello")


def test_nobody_listens_any_more(capfd):
    with Child(ECHO) as child:
        child.send("hello")
        child.receive()
        child._process.stdout.close()
        child.send("hello")
        assert child._process.wait(60) == 1
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows keeps the number of a parent that is gone")
def test_a_child_ends_with_its_parent_also_amid_its_work(tmp_path):
    """A killed program's workers write nothing any more, when the next run begins."""
    busy = "from pipeline.processes import serve; import time; serve(lambda receive, say: (say('up'), time.sleep(600)))"
    parent = f"""
from pipeline.processes import Child
child = Child({busy!r})
child.receive()
print(child.pid, flush=True)
child.receive()
"""
    with start_python(["-c", parent], stdout=subprocess.PIPE) as process:
        child = int(process.stdout.readline())
        process.kill()
    end = time.monotonic() + 60
    while is_alive(child):
        assert time.monotonic() < end, "the child goes on"
        time.sleep(0.01)


def is_alive(pid: int) -> bool:
    """Return whether a process runs; one that has ended and that nobody has waited for does not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    try:
        return stat.read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:  # it has just gone, or the system has no such file
        return not Path("/proc/self/stat").exists()
