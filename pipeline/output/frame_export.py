"""The frames of a ``result.zarr`` as files for other programs, in a folder that may hold other things, too.

``exported.json`` there lists for each item, a frame's files or the bag of all frames, its source, and the files'
lengths and SHA-256. An item that matches both is not made again, and one that does not is its user's. So an export that
is stopped continues where it was; a file that a killed one has not recorded is recognised by its content.
"""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np

from pipeline.errors import FootageError, OutputError, SettingsError
from pipeline.files import explain, replace_file, write_atomically
from pipeline.limits import read_plain
from pipeline.locking import locked
from pipeline.output.folder import file_mark, is_as_marked, is_plain_name
from pipeline.output.formats.ros_bag import write_bag
from pipeline.output.formats.table import encode_as, format_of
from pipeline.output.mesh import Mesh, RangeGrid, provenance_of
from pipeline.output.store import WORTH_SAYING, in_bytes
from pipeline.output.stored_result import StoredResult, mesh_fields
from pipeline.output.surface_mesh import MeshOptions, counted_mesh, frame_grid

_RECORD = "exported.json"
_ITEMS = "items"
_WORK = ".export."
# The folder, and the MCAP file in it, of a bag.
_BAG = "bag"
# Bytes; a record takes about 400 per frame.
_MOST_RECORD = 2**28


@dataclass
class Exported:
    """The outcome of an export."""

    written: list[int] = field(default_factory=list)  # numbers of frames
    before: list[int] = field(default_factory=list)  # whose files were there already
    empty: list[int] = field(default_factory=list)  # that show no surface: there is no file of them
    damaged: dict[int, str] = field(default_factory=dict)  # that cannot be read, and why


@dataclass(frozen=True)
class _Item:
    """The record of an item that was exported."""

    made_of: str
    files: dict[str, str]  # the mark of each, by its path in the folder; empty: the frame shows no surface
    counts: dict[str, int] = field(default_factory=dict, compare=False)  # what became of a mesh's pixels


def export_frames(
    location: str | Path,
    folder: str | Path,
    kind: str,
    notify: Callable[[int, int], None] = lambda done, of: None,
    *,
    options: MeshOptions | None = None,
    force: bool = False,
    remark: Callable[[str], None] = lambda line: None,
) -> Exported:
    """Write every frame of a store that is done, ``frame_000012.ply`` and so on, unless it is there.

    Parameters
    ----------
    location : str or Path
        The ``result.zarr``.
    folder : str or Path
        Its destination; made if it does not exist.
    kind : str
        The format, as for `format_of`. All frames go into one bag where it is ``"mcap"``.
    notify : callable
        Called with the number of frames read and of all.
    options : MeshOptions, optional
        The parts to omit from meshes.
    force : bool
        True to write all again, and to replace files of others.
    remark : callable
        Called with the expected size of all by the first one, if it is 100 MB or more.

    Raises
    ------
    FootageError
        There is no such store, it lacks what is needed, or nothing of it can be read.
    OutputError
        The folder cannot be written, is being written by another run, or holds a file of such a name that was changed,
        or that no export has written; then nothing is replaced.
    SettingsError
        There is no such format; or the options do not apply to it, or require mm, and there are none.
    """
    form, result, folder = format_of(kind), StoredResult(location), Path(folder)
    if not result.done:
        raise FootageError(f"{result.name} holds no frame that is done: decode first")
    for name in mesh_fields(in_mm=result.in_mm):
        result.require(name)
    if form.encode_mesh is None:
        result.require_mm()
        if options is not None and options != MeshOptions():
            raise SettingsError(f"{kind} keeps every measured pixel: cropping and the like are for meshes")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder / _RECORD):
            for left in folder.glob(f"{_WORK}*"):  # of a killed export
                shutil.rmtree(left)
            work = Path(tempfile.mkdtemp(prefix=_WORK, dir=folder))
            try:
                made_by = _Maker(result, kind, options or MeshOptions())
                return _Export(made_by, folder, work, notify, remark).run(force=force)
            finally:
                shutil.rmtree(work, ignore_errors=True)
    except (FootageError, OutputError):  # OSErrors too, but not about this folder
        raise
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {explain(error)}") from error
    finally:
        with suppress(OSError):  # what holds something stays
            folder.rmdir()


class _Maker:
    """Makes a store's frames into files of one kind."""

    def __init__(self, result: StoredResult, kind: str, options: MeshOptions) -> None:
        self._result, self._kind, self._options = result, kind, options
        self._form = format_of(kind)
        self._farthest_mm = self._farthest() if self._form.has_step else 0.0

    def items(self) -> dict[str, tuple[int, ...]]:
        """Return what is to be made: the name of each item, and the frames in it."""
        if self._form.holds_all_frames:
            return {_BAG: self._result.done}
        return {f"frame_{number:06d}.{self._kind}": (number,) for number in self._result.done}

    def made_of(self, numbers: tuple[int, ...]) -> str:
        """Return a digest that distinguishes an item, and its making, from others.

        Raises
        ------
        FootageError
            A frame's mark is damaged.
        """
        frames = [self._result.frame(number).digest for number in numbers]
        whole = [version("colorphase"), asdict(self._options), self._farthest_mm, frames]
        return hashlib.sha256(json.dumps(whole).encode()).hexdigest()[:32]

    def make(self, name: str, numbers: tuple[int, ...], work: Path) -> tuple[list[str], dict[str, int]]:
        """Write an item's files into a folder; return their names, and what became of a mesh's pixels.

        Raises
        ------
        FootageError
            A frame is damaged.
        OutputError
            The format cannot hold it.
        """
        if self._form.holds_all_frames:
            grids = (frame_grid(self._result.frame(number)) for number in numbers)
            write_bag(work / name, grids, provenance_of(self._result.attributes))
            return [f"{name}/{entry.name}" for entry in sorted((work / name).iterdir())], {}
        number, counts = numbers[0], {}
        shape: Mesh | RangeGrid | None = None
        if self._form.encode_mesh is not None:
            mesh, counted = counted_mesh(self._result.frame(number), self._options)
            shape, counts = (mesh if len(mesh.faces) else None), asdict(counted)
        else:
            grid = frame_grid(self._result.frame(number))
            shape = grid if np.isfinite(grid.depth).any() else None
        if shape is None:
            return [], counts
        files = encode_as(self._form, shape, Path(name).stem, self._farthest_mm)
        for suffix, content in files.items():
            replace_file((work / name).with_suffix(suffix), content)
        return [Path(name).with_suffix(suffix).name for suffix in files], counts

    def _farthest(self) -> float:
        """Return the largest depth of all frames, mm; a damaged frame has none."""
        farthest = 0.0
        for number in self._result.done:
            with suppress(FootageError):
                depth = frame_grid(self._result.frame(number)).depth
                farthest = max(farthest, float(np.nanmax(depth, initial=0.0, where=np.isfinite(depth))))
        return farthest


class _Export:
    """One export, while nobody else writes to its folder."""

    def __init__(
        self,
        maker: _Maker,
        folder: Path,
        work: Path,
        notify: Callable[[int, int], None],
        remark: Callable[[str], None],
    ) -> None:
        self._maker, self._folder, self._work, self._notify, self._remark = maker, folder, work, notify, remark
        self._known = _read_record(folder)
        self._items = maker.items()
        self._of = sum(map(len, self._items.values()))
        self._done = Exported()

    def run(self, *, force: bool) -> Exported:
        """Write what is missing, what could be somebody else's first: it may refuse before anything is replaced."""
        made_of: dict[str, str] = {}
        for name, numbers in self._items.items():
            try:
                made_of[name] = self._maker.made_of(numbers)
            except FootageError as error:
                self._damaged(numbers, error)
        if not force:
            self._refuse_changed()
        whole = [name for name in made_of if not force and self._is_whole(name, made_of[name])]
        unknown = [name for name in made_of if name not in self._known and (self._folder / name).exists()]
        todo = [name for name in dict.fromkeys([*unknown, *made_of]) if name not in whole]
        self._done.before += [number for name in whole for number in self._items[name]]
        estimated = False
        try:
            self._notify(len(self._done.before), self._of)
            for name in todo:
                files = self._make(name, made_of[name], force=force)
                if files and not estimated:
                    estimated = True
                    size = len(todo) * sum((self._folder / file).stat().st_size for file in files)
                    if size >= WORTH_SAYING:
                        self._remark(f"{self._folder} will grow by about {in_bytes(size)}, by its first file")
                self._notify(len(self._done.before) + len(self._done.written) + len(self._done.damaged), self._of)
        except KeyboardInterrupt:
            n_there = len(self._done.before) + len(self._done.written)
            raise KeyboardInterrupt(
                f"stopped: {n_there} of {self._of} frames are exported; the same command goes on from there"
            ) from None
        finally:
            if self._done.written:
                about = {name: asdict(item) for name, item in sorted(self._known.items())}
                write_atomically(self._folder / _RECORD, (json.dumps({_ITEMS: about}, indent=1) + "\n").encode())
        self._done.empty += [
            number
            for name, numbers in self._items.items()
            for number in numbers
            if (item := self._known.get(name)) is not None and not item.files
        ]
        if self._done.damaged and not self._done.written and not self._done.before:
            raise FootageError(next(iter(self._done.damaged.values())))
        return self._done

    def _make(self, name: str, made_of: str, *, force: bool) -> list[str]:
        """Write an item's files, unless one of their names is that of another file than it; return their names."""
        numbers = self._items[name]
        try:
            files, counts = self._maker.make(name, numbers, self._work)
        except FootageError as error:
            self._damaged(numbers, error)
            return []
        marks = {file: file_mark(self._work / file) for file in files}
        before = self._known.get(name, _Item("", {})).files
        for file, mark in marks.items():
            if not force and is_as_marked(self._folder / file, mark, before.get(file)) is False:
                raise self._refused(file, "is not ours")
        for file in before.keys() - marks.keys():  # of a frame that showed a surface before
            (self._folder / file).unlink(missing_ok=True)
        for file in reversed(files):  # the first one names the others
            (self._folder / file).parent.mkdir(exist_ok=True)
            os.replace(self._work / file, self._folder / file)
        self._known[name] = _Item(made_of, marks, counts)
        self._done.written += numbers
        return files

    def _damaged(self, numbers: tuple[int, ...], error: FootageError) -> None:
        self._done.damaged |= dict.fromkeys(numbers, str(error))

    def _is_whole(self, name: str, made_of: str) -> bool:
        """Return whether an item is there as it would be written."""
        item = self._known.get(name)
        if item is None or item.made_of != made_of:
            return False
        return all(is_as_marked(self._folder / file, mark) for file, mark in item.files.items())

    def _refuse_changed(self) -> None:
        """Refuse a folder in which a file is not as it was written."""
        if (self._folder / _RECORD).exists() and not self._known:
            raise self._refused(_RECORD, "is not ours")
        for name in self._items:
            for file, mark in self._known.get(name, _Item("", {})).files.items():
                if is_as_marked(self._folder / file, mark) is False:
                    raise self._refused(file, "has been changed since we wrote it")

    def _refused(self, name: str, why: str) -> OutputError:
        return OutputError(f"{self._folder} holds something else ({name} {why}): choose another folder, or add --force")


def _is_inside(name: str) -> bool:
    """Return whether a name is that of a file in the folder of an export, or in the folder of its bag."""
    return is_plain_name(name.removeprefix(f"{_BAG}/"))


def _read_record(folder: Path) -> dict[str, _Item]:
    """Return what is known of what was exported to a folder, by name; nothing where there is no record."""
    try:
        items = json.loads(read_plain(folder / _RECORD, _MOST_RECORD))[_ITEMS]
        read = {
            name: _Item(str(about["made_of"]), dict(about["files"]), dict(about["counts"]))
            for name, about in items.items()
        }
        # Others' records name files elsewhere, too, and what is of no use any more is removed.
        inside = all(_is_inside(file) for item in read.values() for file in item.files)
        return read if inside else {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}
