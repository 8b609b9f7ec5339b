"""What is left of files after a power cut, at any moment of a run: only what was synced is sure to be there.

The content of a file is what it was when it was last synced, or nothing. A name is there if its folder was synced since
it appeared; whether others are, the disk chooses.
"""

import os
from collections.abc import Callable
from pathlib import Path


class PowerCuts:
    """Record what a run syncs and renames below a folder; `left` rebuilds what any moment would have left."""

    def __init__(self, root: Path, monkeypatch) -> None:
        self.root = root
        self.events: list[tuple[str, str, object]] = []
        fsync, replace = os.fsync, os.replace

        def synced(descriptor: int) -> None:
            fsync(descriptor)
            path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
            if not path.is_relative_to(root):
                return
            if path.is_dir():
                self._note("folder", path, {entry.name: entry.inode() for entry in os.scandir(path) if entry.is_file()})
            else:
                self._note("content", path, (os.fstat(descriptor).st_ino, path.read_bytes()))

        def replaced(source, target, **options) -> None:
            inode = os.stat(source).st_ino
            replace(source, target, **options)
            if Path(target).is_relative_to(root):
                self._note("name", Path(target), inode)

        monkeypatch.setattr(os, "fsync", synced)
        monkeypatch.setattr(os, "replace", replaced)

    def left(self, n_events: int, into: Path, soon: Callable[[str], bool]) -> None:
        """Write what is left after some of the events: names that `soon` tells of as soon as they appeared.

        Folders are there as soon as they are made.
        """
        contents: dict[int, bytes] = {}
        names: dict[str, dict[str, int]] = {}
        for kind, path, what in self.events[:n_events]:
            folder, _, name = path.rpartition("/")
            if kind == "content":
                inode, content = what
                contents[inode] = content
            elif kind == "folder":
                early = {other: inode for other, inode in names.get(path, {}).items() if soon(f"{path}/{other}")}
                names[path] = {**early, **what}
            elif soon(path):
                names.setdefault(folder, {})[name] = what
        for folder, held in names.items():
            for name, inode in held.items():
                if name.endswith((".part", ".lock")):
                    continue
                (into / folder).mkdir(parents=True, exist_ok=True)
                (into / folder / name).write_bytes(contents.get(inode, b""))

    def _note(self, kind: str, path: Path, what: object) -> None:
        self.events.append((kind, str(path.relative_to(self.root)), what))
