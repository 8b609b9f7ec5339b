"""Ctrl-C does not reach processes that are started while it is blocked, and reaches this one afterwards."""

import signal
import subprocess
import sys
import threading

import pytest

from pipeline.processes import block_interrupts

pytestmark = pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals cannot be blocked here")
BLOCKED = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))"


def child_blocks_interrupts():
    return (
        subprocess.run([sys.executable, "-c", BLOCKED], capture_output=True, text=True, check=True).stdout == "True\n"
    )


def test_children_inherit_the_block():
    assert not child_blocks_interrupts()
    with block_interrupts() as unblock:
        assert child_blocks_interrupts()
        unblock()
        assert not child_blocks_interrupts()
    assert not child_blocks_interrupts()


def test_an_interrupt_waits_until_the_end():
    reached = False
    with pytest.raises(KeyboardInterrupt), block_interrupts():
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)  # another thread would take the process's
        reached = True
    assert reached
