"""Finish what a recorder left that was killed: what was committed stands under its name."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from pipeline.errors import DamageError, FootageError, OutputError
from pipeline.files import explain, sync
from pipeline.locking import locked
from pipeline.recording import matroska, zarr_writer
from pipeline.recording.recorder import PART


def unfinished(folder: Path) -> Iterator[Path]:
    """Yield the recordings in a folder that have not got their names yet."""
    for suffix in (".mkv", ".zarr"):
        yield from sorted(folder.glob(f"*{PART}{suffix}"))


def finish_recording(part: Path) -> tuple[Path, int]:
    """Cut off what was not committed, and give a recording its name; one without frames is removed.

    Parameters
    ----------
    part : Path
        What a recorder has left.

    Returns
    -------
    Path
        The recording.
    int
        How many frames it holds.

    Raises
    ------
    FootageError
        It cannot be read.
    OutputError
        It is being written, its name is taken, or the folder cannot be written.
    """
    path = part.with_name(part.name.replace(f"{PART}{part.suffix}", part.suffix))
    with locked(path):
        if path.exists():
            raise OutputError(f"cannot finish {part}: {path.name} exists, move it away")
        try:
            n_frames = zarr_writer.cut_off(part) if part.is_dir() else matroska.cut_off(part)
            if n_frames:
                os.replace(part, path)
            elif part.is_dir():
                shutil.rmtree(part)
            else:
                part.unlink()
            sync(path.parent)
        except DamageError as error:
            raise FootageError(f"cannot finish {part}: {error}") from None
        except OSError as error:
            raise OutputError(f"cannot finish {part}: {explain(error)}") from error
    return path, n_frames
