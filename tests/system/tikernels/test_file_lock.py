"""A lock on an open file is one process's, and ends with it."""

import os
import subprocess
import sys

import pytest

from tikernels.file_lock import take

TAKE = """
import os, sys
sys.path[:0] = sys.argv[2:]
from tikernels.file_lock import take
file = os.open(sys.argv[1], os.O_RDWR)
try:
    take(file)
except OSError:
    print("held by another")
"""


def test_one_process_alone(tmp_path):
    file = os.open(tmp_path / "lock", os.O_RDWR | os.O_CREAT)
    command = [sys.executable, "-c", TAKE, str(tmp_path / "lock"), *sys.path]
    take(file)
    assert subprocess.check_output(command, text=True, timeout=60) == "held by another\n"
    os.close(file)
    assert subprocess.check_output(command, text=True, timeout=60) == ""
    with pytest.raises(OSError):
        take(file)
