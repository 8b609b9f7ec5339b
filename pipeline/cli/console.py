"""What all commands share: two consoles, one progress bar, bounds of options, and how a mistake is told."""

import re
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import inf
from pathlib import Path
from typing import Any, Literal

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.text import Text

import hardware.errors
import pipeline.errors
import tikernels.errors
from pipeline.calibration import Calibration
from pipeline.errors import DecodeWarning, OutputError, SettingsError
from pipeline.settings import DecodeSettings

#: Exit code where some frames are bad, or damaged, and the rest is not.
SOME_ARE_BAD = 3

Arch = Literal["auto", "cpu", "vulkan", "cuda", "metal"]

# What moves the cursor, colours, rings or ends a line on a terminal (C0, C1, DEL, separators of lines), and what turns
# the order of the letters around (Unicode's bidirectional controls).
_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def without_controls(text: str) -> str:
    """Return a text without its control characters; those that part words are blanks.

    What comes from outside (names of files and instruments, tags of footage) may hold them.
    """
    return _CONTROLS.sub(lambda control: " " if control[0].isspace() else "", text)


class _Printed(Console):
    """A console whose control characters are its own: texts have none, whoever made them."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Render what is to be printed."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                lines = "\n".join(without_controls(line) for line in segment.text.split("\n"))
                yield Segment(lines, segment.style)


#: Results, and what is said beside them. Names of files may look like markup.
stdout = _Printed(markup=False, emoji=False)
stderr = _Printed(stderr=True, markup=False, emoji=False)

#: Every error that a user can cause; each message is one line.
USER_ERRORS: tuple[type[Exception], ...] = tuple(
    error
    for module in (hardware.errors, pipeline.errors, tikernels.errors)
    for error in vars(module).values()
    if isinstance(error, type) and issubclass(error, Exception) and not issubclass(error, Warning)
)


def say(line: str) -> None:
    """Print a line of the result, however long."""
    stdout.print(without_controls(line), highlight=False, soft_wrap=True)


def frames(count: int) -> str:
    """Return the begin of a sentence about some frames.

    >>> frames(1), frames(2)
    ('1 frame is', '2 frames are')
    """
    return "1 frame is" if count == 1 else f"{count} frames are"


def remark(line: str) -> None:
    """Print a line beside the result, in yellow, on standard error."""
    _tell(line, "yellow")


def _tell(line: str, style: str) -> None:
    stderr.print(without_controls(line), style=style, highlight=False, soft_wrap=True)


@contextmanager
def _progress(*columns: ProgressColumn) -> Iterator[tuple[Progress, TaskID]]:
    """Show one line of progress on a terminal, and nothing elsewhere; it goes when it is over."""
    with Progress(*columns, console=stderr, transient=True, disable=not stderr.is_terminal) as bar:
        yield bar, bar.add_task("starting", total=None)


@contextmanager
def steps() -> Iterator[Callable[[str], None]]:
    """Show what is being done and for how long; what is yielded hears what it is."""
    with _progress(SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()) as (bar, task):
        yield lambda what: bar.update(task, description=what)


@contextmanager
def counted(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show how many frames are done, and how fast; what is yielded hears how many, and of how many."""
    columns = BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn()
    with _progress(TextColumn("{task.description}", markup=False), *columns) as (bar, task):

        def show(done: int, of: int) -> None:
            if bar.tasks[0].total is None:  # what was done before says nothing of the rate
                bar.reset(task, total=of, completed=done, description=what)
            else:
                bar.update(task, completed=done)

        yield show


class _Rate(ProgressColumn):
    """Frames a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f} frames/s")


def bounded(least: float, most: float = inf) -> Callable[[Any, float | None], None]:
    """Return what refuses an option's value outside these bounds, both of which are allowed, and NaN."""
    expected = f"must be {least:g} or more" if most == inf else f"must be {least:g} to {most:g}"

    def check(_: Any, value: float | None) -> None:
        if value is not None and not least <= value <= most:
            raise ValueError(expected)

    return check


def above_zero(_: Any, value: float | None) -> None:
    """Refuse an option's value that is zero, negative, infinite or NaN."""
    if value is not None and not 0 < value < inf:
        raise ValueError("must be above 0, and a number")


def size_of(text: str, option: str = "--size") -> tuple[int, int]:
    """Read a width and height, as in 1024x768.

    Raises
    ------
    SettingsError
        It is none; the message names the option.
    """
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdigit() and height.isdigit() and int(width) > 0 and int(height) > 0):
        raise SettingsError(f"{option} is {text!r}: give width and height in px, as in 1024x768")
    return int(width), int(height)


def check_target(target: Path, *, force: bool) -> None:
    """Refuse a file that cannot be written, before minutes have gone into what is to be in it.

    Raises
    ------
    OutputError
        Its folder does not exist; or it exists already, and is not to be replaced.
    """
    if not target.parent.is_dir():
        raise OutputError(f"cannot write {target}: its folder does not exist: create the folder first")
    if target.exists() and not force:
        raise OutputError(f"{target} exists already: choose another name, or add --force")


def read_settings(path: Path | None) -> DecodeSettings:
    """Return the settings in a TOML file, or the default where none is given."""
    return DecodeSettings() if path is None else DecodeSettings.read(path)


def read_calibration(path: Path | None) -> Calibration | None:
    """Return the calibration in a file, if one is given."""
    return None if path is None else Calibration.read(path)


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    prefix = "warning" if issubclass(category, DecodeWarning) else category.__name__
    remark(f"{prefix}: {message}")


def run(command: Callable[[], object]) -> None:
    """Run a command: warnings and a user's mistakes are one line each on standard error.

    A mistake ends it with exit code 1, Ctrl-C with 130.
    """
    warnings.showwarning = _show_warning
    try:
        command()
    except USER_ERRORS as error:
        _tell(f"error: {error}", "red")
        sys.exit(1)
    except KeyboardInterrupt as stopped:
        _tell(str(stopped) or "interrupted", "red")
        sys.exit(130)
