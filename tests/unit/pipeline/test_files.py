"""Whole files or none."""

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import OutputError
from pipeline.files import explain, replace_file, write_atomically


def test_a_write_that_fails_half_way_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(b"old")

    def fill_the_disk(file: Any) -> None:
        file.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match=r"mesh\.ply: the disk is full: free some space$"):
        write_atomically(path, fill_the_disk)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("mesh.ply", b"old")]


def test_a_file_is_replaced_at_once(tmp_path):
    path = tmp_path / "a.bin"
    for content in (b"one", lambda file: file.write(b"two")):
        write_atomically(path, content)
    assert path.read_bytes() == b"two"
    assert [file.name for file in tmp_path.iterdir()] == ["a.bin"]


def test_what_is_safe_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(os, "fsync", lambda file: calls.append("fsync"))
    replace = os.replace
    monkeypatch.setattr(os, "replace", lambda *names: (calls.append("replace"), replace(*names)))
    replace_file(tmp_path / "a.bin", b"1", safe=True)
    replace_file(tmp_path / "b.bin", b"1")
    assert calls == ["fsync", "replace", "replace"]


@pytest.mark.parametrize(
    ("place", "advice"),
    [
        ("none/a.bin", "its folder does not exist: create the folder first"),
        ("file/a.bin", "its folder is a file: choose another folder"),
        ("folder", "it is a folder: name a file in it"),
    ],
)
def test_a_place_that_cannot_be_written_comes_with_advice(tmp_path, place, advice):
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match=advice):
        write_atomically(tmp_path / place, b"")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "folder"]


def test_what_nobody_has_advice_for_is_told_as_the_system_tells_it():
    assert explain(OSError(errno.ENOSPC, "No space left")) == "the disk is full: free some space"
    assert explain(OSError(errno.EIO, "Input/output error")) == "Input/output error"
    assert explain(OSError("odd")) == "odd"
