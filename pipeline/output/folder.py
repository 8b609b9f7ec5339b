"""The folder that decoding fills: written completely, or not at all, and without losing foreign files.

Ours is what `report.json` names with the length and SHA-256 that it still has, `report.json` itself, and a
``result.zarr`` that is marked as such. A mesh that was edited and kept its name is its user's.
"""

import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from pipeline.decoding.frame import DecodedFrame, read_back
from pipeline.errors import DamageError, FootageError, OutputError
from pipeline.files import explain, sync
from pipeline.limits import open_plain, read_plain
from pipeline.locking import LOCK, locked
from pipeline.output.formats.ply import ply_bytes
from pipeline.output.mesh import provenance_of
from pipeline.output.mesh_files import write_mesh
from pipeline.output.range_image import shade_frame, write_png, write_range_image
from pipeline.output.store import WORTH_SAYING, holds_footage, in_bytes, is_there, write_store
from pipeline.output.surface_mesh import MeshOptions, counted_mesh

#: The result in an output folder, and the folder of meshes next to it.
STORE, MESHES = "result.zarr", "meshes"
_REPORT = "report.json"
# A report's entry for the files next to it: the mark of each, by name.
_FILES = "files"
# Bytes; no report is longer.
_MOST_REPORT = 2**20
_WHOLE = MeshOptions()


@contextmanager
def output_folder(path: str | Path, *, force: bool = False) -> Iterator[Path]:
    """Give a fresh folder to write to; what is in it at the end appears in the output folder, at an error nothing does.

    Parameters
    ----------
    path : str or Path
        The output folder; made if it does not exist.
    force : bool
        True if it may hold other things than an earlier result.

    Raises
    ------
    OutputError
        The folder holds something else, or cannot be written.
    """
    if "://" in str(path):
        raise OutputError(f"{path} is not a folder here: choose one")
    path = Path(path)
    work = None
    try:
        if path.is_dir():
            if not force:
                _refuse_foreign(path)
            if is_store(path / STORE) and holds_footage(path / STORE):
                raise OutputError(f"{path} holds the frames of footage: choose another folder")
        elif path.exists():
            raise OutputError(f"{path} is a file: choose a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        # Next to the output folder, so that moving is renaming.
        work = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        yield work
        path.mkdir(exist_ok=True)
        with locked(path / STORE):
            if not force:
                _refuse_foreign(path)  # what has come meanwhile
            _move(work, path)
    except (FootageError, OutputError):  # OSErrors too, but not about this folder
        raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {explain(error)}") from None
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)


def _move(work: Path, path: Path) -> None:
    """Move what was written into the output folder, and return when it is on the disk; the report comes last."""
    written = [entry for entry in work.iterdir() if entry.is_file()]  # a store is on the disk already
    with ThreadPoolExecutor(1, "beside") as beside:  # the disk is as slow as the digests
        synced = beside.submit(sync, *(entry for entry in written if entry.name != _REPORT))
        new = {entry.name: file_mark(entry) for entry in written if entry.name != _REPORT}
        synced.result()
    if (work / _REPORT).exists():
        report = json.loads((work / _REPORT).read_bytes())  # which has just been written
        kept = {name: mark for name, mark in _reported(path).items() if is_as_marked(path / name, mark)}
        text = json.dumps({**report, _FILES: {**kept, **new}}, indent=1) + "\n"
        (work / _REPORT).write_text(text, encoding="utf-8")
        sync(work / _REPORT)
    for entry in sorted(work.iterdir(), key=lambda entry: entry.name == _REPORT):
        target = path / entry.name
        if target.is_dir() and not target.is_symlink():
            shutil.rmtree(target)
        entry.replace(target)
    sync(path, path.parent)


def _refuse_foreign(path: Path) -> None:
    """Refuse a folder that holds what decoding a picture has not written.

    Raises
    ------
    OutputError
        It does.
    """
    reported = _reported(path)
    for entry in sorted(path.iterdir()):
        if entry.name == STORE and entry.is_dir():
            is_ours = is_store(entry)
        elif entry.name == _REPORT:
            is_ours = bool(reported)
        else:
            is_ours = bool(is_as_marked(entry, reported.get(entry.name)))
        if not is_ours and not _is_lock(entry):
            edited = " has been changed since we wrote it" if entry.name in reported else " is not ours"
            raise OutputError(
                f"{path} holds something else ({entry.name}{edited}): choose another folder, or add --force"
            )


def changed_files(path: Path) -> list[str]:
    """Return the names of the files that a folder's report names, and which are not as they were written."""
    return [name for name, mark in _reported(path).items() if not is_as_marked(path / name, mark)]


def _reported(path: Path) -> dict[str, str]:
    """Return the files that a folder's report names, and their marks; none where there is no report."""
    try:
        files = json.loads(read_plain(path / _REPORT, _MOST_REPORT))[_FILES]
        # Others' reports name files elsewhere, too.
        return {name: mark for name, mark in files.items() if is_plain_name(name) and isinstance(mark, str)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}


def store_in(place: str) -> str:
    """Return where a store is: in an output folder of `colorphase decode`, or at the place itself."""
    inside = Path(place, STORE)
    return str(inside) if "://" not in place and inside.is_dir() else place


def is_plain_name(name: str) -> bool:
    """Return whether a name is that of something inside a folder, not elsewhere."""
    return Path(name).name == name and name not in ("", "..")


def file_digest(file: Path, most_bytes: float = math.inf) -> str | None:
    """Return a file's SHA-256; None where there is no plain file, or a longer one."""
    try:
        with open_plain(file) as opened:
            if os.fstat(opened.fileno()).st_size > most_bytes:
                return None
            return hashlib.file_digest(opened, "sha256").hexdigest()
    except (OSError, ValueError):  # of a name that no file can have
        return None


def file_mark(file: Path) -> str:
    """Return what distinguishes a file from others: its length and its SHA-256."""
    return f"{file.stat().st_size} bytes, SHA-256 {file_digest(file)}"


def is_as_marked(file: Path, *marks: str | None) -> bool | None:
    """Return whether a file has one of some marks, None where there is no plain file; others' lengths are not read."""
    try:
        with open_plain(file) as opened:
            length = f"{os.fstat(opened.fileno()).st_size} bytes, SHA-256 "
            known = {mark for mark in marks if mark is not None and mark.startswith(length)}
            return bool(known) and length + hashlib.file_digest(opened, "sha256").hexdigest() in known
    except (OSError, ValueError):  # of a name that no file can have
        return None


def is_store(folder: Path) -> bool:
    """Return whether a folder is a ``result.zarr``, damaged or not, rather than a recording or something else."""
    try:
        return is_there(folder)
    except DamageError:
        return True
    except OutputError:
        return False


def _is_lock(entry: Path) -> bool:
    return entry.name.startswith(".") and entry.name.endswith(LOCK)


def refuse_others(folder: Path, names: Collection[str]) -> None:
    """Refuse a folder that holds other things than these.

    Raises
    ------
    OutputError
        It does.
    """
    others = sorted(entry.name for entry in folder.iterdir() if entry.name not in names and not _is_lock(entry))
    if others:
        raise OutputError(f"{folder} holds something else ({others[0]}): choose another folder, or add --force")


def write_frame(
    folder: Path,
    frame: DecodedFrame,
    report: dict[str, Any],
    part: MeshOptions | None = _WHOLE,
    notify: Callable[[str], None] = lambda what: None,
    remark: Callable[[str], None] = lambda line: None,
) -> None:
    """Write one frame's ``result.zarr``, ``mesh.ply``, ``range.png``, ``shaded.png`` and ``report.json`` into a folder.

    `notify` receives each step, and `remark` the size of a mesh of 100 MB or more. Without `part` there is no mesh.

    Raises
    ------
    OSError
        The folder cannot be written.
    """
    notify("reading every field")
    read_back(frame, frame.fields)

    # Storing is compressing and writing, while the mesh is made; the picture is made while the mesh is written. Nothing
    # is imported meanwhile: Python 3.11 fails where two threads parse source at once, as compiling a kernel does.
    import zarr  # noqa: F401 - so that the thread does not

    with ThreadPoolExecutor(1, "beside") as beside:
        notify("meshing and storing")
        stored = beside.submit(write_store, folder / STORE, frame)
        shaded = beside.submit(lambda: write_png(folder / "shaded.png", shade_frame(frame)))
        written = [stored, shaded]
        if part is not None:
            mesh, counts = counted_mesh(frame, part)
            mesh = replace(mesh, provenance=provenance_of(report))  # which names its source
            report = {**report, "mesh": asdict(counts)}
            notify(f"writing a mesh of {len(mesh.faces):,} triangles, and drawing range.png")
            if (size := ply_bytes(mesh)) >= WORTH_SAYING:
                remark(f"mesh.ply takes {in_bytes(size)}: --triangles makes it smaller, --no-mesh leaves it out")
            written.append(beside.submit(write_mesh, mesh, folder / "mesh.ply"))
        write_range_image(folder / "range.png", frame.range_image, frame.mask, "mm" if frame.calibrated else "rad")
        for done in written:
            done.result()
    (folder / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
