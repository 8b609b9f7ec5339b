"""What all commands share: two consoles, one progress bar, bounds of options, and how a mistake is told."""

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import inf
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
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

#: Results, and what is said beside them. Names of files may look like markup.
stdout = Console(markup=False, emoji=False)
stderr = Console(stderr=True, markup=False, emoji=False)

#: Every error that a user can cause; each message is one line.
USER_ERRORS: tuple[type[Exception], ...] = tuple(
    error
    for module in (hardware.errors, pipeline.errors, tikernels.errors)
    for error in vars(module).values()
    if isinstance(error, type) and issubclass(error, Exception) and not issubclass(error, Warning)
)


def say(line: str) -> None:
    """Print a line of the result, however long."""
    stdout.print(line, highlight=False, soft_wrap=True)


def remark(line: str) -> None:
    """Print a line beside the result, in yellow, on standard error."""
    stderr.print(line, style="yellow", highlight=False, soft_wrap=True)


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
        stderr.print(f"error: {error}", style="red", highlight=False, soft_wrap=True)
        sys.exit(1)
    except KeyboardInterrupt as stopped:
        stderr.print(str(stopped) or "interrupted", style="red", highlight=False, soft_wrap=True)
        sys.exit(130)
