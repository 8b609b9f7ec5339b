"""Whole files or none."""

import errno
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import OutputError
from pipeline.files import write_atomically


def test_a_write_that_fails_half_way_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(b"old")

    def fill_the_disk(file: Any) -> None:
        file.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match=r"mesh\.ply: the disk is full: free some space$"):
        write_atomically(path, fill_the_disk)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("mesh.ply", b"old")]
