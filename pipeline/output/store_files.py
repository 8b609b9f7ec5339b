"""Where a store's files are: a folder, or what an fsspec URL names."""

import errno
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from pipeline.errors import OutputError
from pipeline.files import LEFTOVER, explain, replace_file, sync

#: How the names of files end that we, and zarr, have not finished.
LEFTOVERS = (LEFTOVER, ".partial")


class StoreFiles:
    """The files of a store, by their keys: paths in it, with slashes.

    Parameters
    ----------
    location : str or Path
        A folder, or an fsspec URL such as ``s3://bucket/result.zarr``.

    Attributes
    ----------
    name : str
        The location.
    folder : Path or None
        None behind a URL.

    Raises
    ------
    OutputError
        No file system for such URLs is installed.
    """

    def __init__(self, location: str | Path) -> None:
        self.name = str(location)
        self.folder = None if "://" in self.name else Path(location)
        self._remote: Any = None
        self._path = ""
        if self.folder is None:
            try:
                from fsspec.core import url_to_fs  # of the extra `cluster`

                self._remote, self._path = url_to_fs(self.name)
            except (ImportError, ValueError) as error:
                raise OutputError(f"cannot write to {self.name}: {' '.join(str(error).split())}") from None

    def read(self, key: str) -> bytes:
        """Return what a file holds.

        Raises
        ------
        FileNotFoundError, NotADirectoryError
            It is not there.
        OSError
            It cannot be read.
        """
        if self.folder is not None:
            return (self.folder / key).read_bytes()
        with self._as_os_error():
            content: bytes = self._remote.cat_file(f"{self._path}/{key}")
        return content

    def put(self, key: str, content: bytes) -> None:
        """Make or replace a file, whole or not at all; what it holds is on the disk, its name after `sync_folder`.

        Raises
        ------
        OSError
            It cannot be written, or its folder is gone.
        """
        if self.folder is not None:
            replace_file(self.folder / key, content, safe=True)
            return
        with self._as_os_error():
            self._remote.pipe_file(f"{self._path}/{key}", content)

    def remove(self, key: str) -> None:
        """Remove a file, if it is there.

        Raises
        ------
        OSError
            It cannot be removed.
        """
        if self.folder is not None:
            (self.folder / key).unlink(missing_ok=True)
            return
        with suppress(FileNotFoundError), self._as_os_error():
            self._remote.rm_file(f"{self._path}/{key}")

    def sync_folder(self, *keys: str) -> None:
        """Return when the names in folders are on the disk; behind a URL they are."""
        if self.folder is not None:
            sync(*(self.folder / key for key in keys))

    def sizes(self, key: str) -> dict[str, int]:
        """Return the names and the lengths of the files in a folder.

        Raises
        ------
        OSError
            It is not there, or cannot be read.
        """
        if self.folder is not None:
            with os.scandir(self.folder / key) as entries:
                return {entry.name: entry.stat().st_size for entry in entries if entry.is_file()}
        with self._as_os_error():
            self._remote.invalidate_cache()
            listed = self._remote.ls(f"{self._path}/{key}", detail=True)
        return {entry["name"].rpartition("/")[2]: entry["size"] for entry in listed if entry["type"] == "file"}

    def entries(self) -> dict[str, list[str]] | None:
        """Return the names in a folder, and for each that is a folder the names in it; None: it is a file."""
        if self.folder is None or not self.folder.exists():
            return {}
        if self.folder.is_file():
            return None
        return {entry.name: os.listdir(entry) if entry.is_dir() else [] for entry in os.scandir(self.folder)}

    def folders(self, keys: Iterable[str]) -> list[str]:
        """Return which of some names are folders here; behind a URL, where there are none, nothing."""
        return [] if self.folder is None else [key for key in keys if (self.folder / key).is_dir()]

    def remove_leftovers(self, *keys: str) -> None:
        """Remove the files in folders that a writer who was killed left half-written; while nobody writes."""
        if self.folder is None:
            return  # elsewhere nothing appears before it is whole
        for folder in (self.folder / key for key in keys):
            for name in os.listdir(folder):
                if name.endswith(LEFTOVERS):
                    (folder / name).unlink(missing_ok=True)

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Turn an error of writing into one line."""
        try:
            yield
        except OutputError:
            raise
        except OSError as error:
            gone = error.errno == errno.ENOENT
            what = "it has vanished: bring its disk back, and run again" if gone else explain(error)
            raise OutputError(f"cannot write {self.name}: {what}") from error

    @contextmanager
    def _as_os_error(self) -> Iterator[None]:
        """Turn what a remote file system raises, each its own errors, into one that every system has."""
        try:
            yield
        except OSError:
            raise
        except Exception as error:
            raise OSError(" ".join(str(error).split())) from error
