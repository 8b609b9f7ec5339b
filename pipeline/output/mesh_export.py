"""A mesh of every frame of a ``result.zarr``, in a folder that may hold other things, too.

``exported.json`` there says of each mesh which frame it was made of, and its SHA-256. What has both is not made again,
and what has another SHA-256 is its user's. So an export that is stopped goes on where it was; a mesh that a killed one
has not written down is known by being what would be written.
"""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

from pipeline.errors import FootageError, OutputError
from pipeline.files import explain, write_atomically
from pipeline.locking import locked
from pipeline.output.folder import file_digest
from pipeline.output.mesh_files import write_mesh
from pipeline.output.stored_result import MeshKind, StoredResult, mesh_fields

_RECORD = "exported.json"
_MESHES = "meshes"
_WORK = ".export."
# Bytes; a record takes some 200 of a frame.
_MOST_RECORD = 2**28


@dataclass
class Exported:
    """What became of an export."""

    written: list[int] = field(default_factory=list)  # numbers of frames
    before: list[int] = field(default_factory=list)  # whose meshes were there already
    empty: list[int] = field(default_factory=list)  # that show no surface: there is no mesh of them


@dataclass(frozen=True)
class _Mesh:
    """What is known of a mesh that was exported."""

    made_of: str
    sha256: str | None  # None: the frame shows no surface


def export_frames(
    location: str | Path,
    folder: str | Path,
    kind: MeshKind,
    tell: Callable[[int, int], None] = lambda done, of: None,
    *,
    force: bool = False,
) -> Exported:
    """Write every frame of a store that is done as a mesh, ``frame_000012.ply`` and so on, unless it is there.

    Parameters
    ----------
    location : str or Path
        The ``result.zarr``.
    folder : str or Path
        Where to; made if it does not exist.
    kind : {"ply", "glb"}
        The format: PLY keeps the standard deviations, too.
    tell : callable
        Is told how many of how many frames have been looked at.
    force : bool
        Whether all are written again, and may replace files of others.

    Raises
    ------
    FootageError
        There is no such store, or it lacks what a mesh is made of.
    OutputError
        The folder cannot be written, is being written by another run, or holds a file of such a name that was changed
        or is not one of ours; then nothing is replaced.
    """
    result, folder = StoredResult(location), Path(folder)
    if not result.done:
        raise FootageError(f"{result.name} holds no frame that is done: decode first")
    for name in mesh_fields(in_mm=result.in_mm):
        result.require(name)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / _RECORD):
            for left in folder.glob(f"{_WORK}*"):  # of a killed export
                shutil.rmtree(left)
            work = Path(tempfile.mkdtemp(prefix=_WORK, dir=folder))
            try:
                return _Export(result, folder, work, kind, tell).run(force=force)
            finally:
                shutil.rmtree(work, ignore_errors=True)
    except (FootageError, OutputError):  # OSErrors too, but not about this folder
        raise
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {explain(error)}") from error
    finally:
        with suppress(OSError):  # what holds something stays
            folder.rmdir()


class _Export:
    """One export, while nobody else writes to its folder."""

    def __init__(
        self, result: StoredResult, folder: Path, work: Path, kind: MeshKind, tell: Callable[[int, int], None]
    ) -> None:
        self._result, self._folder, self._work, self._tell = result, folder, work, tell
        self._known = _read_record(folder)
        self._names = {number: f"frame_{number:06d}.{kind}" for number in result.done}
        self._done = Exported()

    def run(self, *, force: bool) -> Exported:
        """Write what is missing, what could be somebody else's first: it may refuse before anything is replaced."""
        there = {number: file_digest(self._folder / name) for number, name in self._names.items()}
        made_of = {number: self._made_of(number) for number in self._names}
        known = {number: self._known.get(name) for number, name in self._names.items()}
        if not force:
            self._refuse_changed(there, known)
            self._done.before += [
                number for number, mesh in known.items() if mesh == _Mesh(made_of[number], there[number])
            ]
        unknown = [number for number in self._names if there[number] is not None and known[number] is None]
        todo = dict.fromkeys([*unknown, *self._names])
        for number in self._done.before:
            del todo[number]
        try:
            self._tell(len(self._done.before), len(self._names))
            for number in todo:
                self._make(number, made_of[number], there[number] if number in unknown and not force else None)
                self._tell(len(self._names) - len(todo) + len(self._done.written), len(self._names))
        except KeyboardInterrupt:
            n_there = len(self._done.before) + len(self._done.written)
            raise KeyboardInterrupt(
                f"stopped: {n_there} of {len(self._names)} frames are exported; the same command goes on from there"
            ) from None
        finally:
            if self._done.written:
                about = {name: vars(mesh) for name, mesh in sorted(self._known.items())}
                write_atomically(self._folder / _RECORD, (json.dumps({_MESHES: about}, indent=1) + "\n").encode())
        self._done.empty += [
            number
            for number, name in self._names.items()
            if (mesh := self._known.get(name)) is not None and mesh.sha256 is None
        ]
        return self._done

    def _make(self, number: int, made_of: str, there: str | None) -> None:
        """Write a frame's mesh, unless a file of its name is another one than it."""
        name = self._names[number]
        mesh = self._result.mesh(number)
        digest = None
        if len(mesh.faces):
            write_mesh(mesh, self._work / name)
            digest = file_digest(self._work / name)
        if there is not None and there != digest:
            raise self._refused(name, "is not ours")
        if digest is not None:
            os.replace(self._work / name, self._folder / name)
        elif self._known.get(name, _Mesh("", None)).sha256 is not None:
            (self._folder / name).unlink(missing_ok=True)  # of a frame that showed a surface before
        self._known[name] = _Mesh(made_of, digest)
        self._done.written.append(number)

    def _refuse_changed(self, there: dict[int, str | None], known: dict[int, _Mesh | None]) -> None:
        """Refuse a folder in which a mesh is not as it was written."""
        if (self._folder / _RECORD).exists() and not self._known:
            raise self._refused(_RECORD, "is not ours")
        for number, mesh in known.items():
            if mesh is not None and there[number] not in (None, mesh.sha256):
                raise self._refused(self._names[number], "has been changed since we wrote it")

    def _refused(self, name: str, why: str) -> OutputError:
        return OutputError(f"{self._folder} holds something else ({name} {why}): choose another folder, or add --force")

    def _made_of(self, number: int) -> str:
        """Return what tells a mesh's frame, and its making, from others."""
        whole = f"{version('colorphase')} {self._result.frame_digest(number)}"
        return hashlib.sha256(whole.encode()).hexdigest()[:32]


def _read_record(folder: Path) -> dict[str, _Mesh]:
    """Return what is known of the meshes in a folder, by their names; nothing where it says nothing of ours."""
    try:
        with (folder / _RECORD).open("rb") as file:
            meshes = json.loads(file.read(_MOST_RECORD))[_MESHES]
        return {str(name): _Mesh(**about) for name, about in meshes.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}
