"""The files that other programs open; `table` lists the formats. Here: the heading of a file, and numbers as text."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, BinaryIO, TypeAlias

import numpy.typing as npt

#: What a file holds, or what writes it there; see `pipeline.files.write_atomically`.
Content: TypeAlias = bytes | memoryview | Callable[[BinaryIO], None]


@dataclass(frozen=True)
class Heading:
    """A file's name, and remarks about what is in it."""

    stem: str
    """The file's name without its suffix, which files next to it share."""
    remarks: dict[str, str]
    """Unit, axes, and how the content was made; one line each."""

    def comments(self, mark: str) -> str:
        """Return the remarks as lines that begin with a mark."""
        return "".join(f"{mark} {name} {value}\n" for name, value in self.remarks.items())


def remarks_in(comments: Iterable[str]) -> dict[str, str]:
    """Return the remarks in a file's comments, which come without their marks; the inverse of `Heading.comments`."""
    parts = (comment.strip().partition(" ") for comment in comments)
    return {name: value.strip() for name, _, value in parts}


def text_rows(row: str, table: npt.NDArray[Any]) -> str:
    """Return a table as text, by the format of one row."""
    # One format of the whole table is several times faster than numpy.savetxt.
    return row * len(table) % tuple(table.ravel().tolist())
