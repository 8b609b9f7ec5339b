"""A lock on an open file is one process's and ends with it; only a plain file is opened for it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tikernels.file_lock import open_lock, take

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


def link(lock, precious):
    lock.symlink_to(precious)


def dangling_link(lock, precious):
    lock.symlink_to(precious.with_name("new"))


def hard_link(lock, precious):
    lock.hardlink_to(precious)


def pipe(lock, precious):
    os.mkfifo(lock)


def folder(lock, precious):
    lock.mkdir()


OTHERS = [link, dangling_link, hard_link, pipe, folder]


@pytest.mark.skipif(os.name != "posix", reason="links and pipes for everybody")
@pytest.mark.parametrize("make", OTHERS)
def test_what_is_no_plain_file_is_refused(make, tmp_path):
    precious, lock = tmp_path / "precious", tmp_path / "lock"
    precious.write_text("kept")
    make(lock, precious)
    there = sorted(tmp_path.iterdir())
    with pytest.raises(OSError, match="lock there is a link or no plain file: remove it"):
        open_lock(lock)
    assert precious.read_text() == "kept" and sorted(tmp_path.iterdir()) == there


@pytest.mark.skipif(os.name != "posix", reason="links for everybody")
def test_a_link_that_comes_meanwhile_is_not_followed(tmp_path, monkeypatch):
    (tmp_path / "precious").write_text("kept")
    (tmp_path / "lock").symlink_to("precious")
    monkeypatch.setattr(os, "lstat", lambda path: Path(path).stat())
    with pytest.raises(OSError):
        open_lock(tmp_path / "lock")


def test_a_lock_whose_holder_has_just_removed_it(tmp_path, monkeypatch):
    """Whoever has opened it sees for itself that it is gone."""
    of = os.open

    def open_and_remove(path, *how):
        file = of(path, *how)
        Path(path).unlink()
        return file

    monkeypatch.setattr(os, "open", open_and_remove)
    os.close(open_lock(tmp_path / "lock"))
