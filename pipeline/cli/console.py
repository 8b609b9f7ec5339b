"""Shared by all commands: two consoles, one progress bar, bounds of options, and how a mistake is reported."""

import errno
import os
import re
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from math import inf
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.segment import Segment

from pipeline.errors import DecodeWarning, OutputError, SettingsError
from pipeline.text import one_line
from tikernels.errors import Error, SlowStart

if TYPE_CHECKING:
    from pipeline.batch.run import DecodeProgress
    from pipeline.calibration import Calibration
    from pipeline.settings import DecodeSettings

# Frames are reported some at a time, twice a second by each process that decodes: what comes within this time was
# done since the report before.
_TOGETHER_S = 0.2
# A rate over less is none.
_LEAST_S = 1.0
# Earlier work shows nothing of the present rate: frames of one film take longer than others.
_LONGEST_S = 30.0
#: Exit code where some frames are bad, or damaged, and the rest is not.
SOME_ARE_BAD = 3


# Where there is no terminal, a line reports the progress whenever this time is over: short commands print nothing, and
# logs of hours stay short.
_RARELY_S = 30.0


class FrameRate:
    """The rate at which a count grows, over the last half minute.

    The first frames that are reported only begin it: they took what the start took, or were done before.

    Parameters
    ----------
    clock : callable, optional
        Returns the time, s; left out, `time.monotonic`.
    """

    def __init__(self, clock: Callable[[], float] | None = None) -> None:
        self._clock = clock or time.monotonic
        self._reports: deque[tuple[float, int]] = deque()  # the time of each, and how many were done then

    def note(self, done: int) -> None:
        """Note how many are done now."""
        now_s = self._clock()
        if self._reports and now_s - self._reports[-1][0] < _TOGETHER_S:
            self._reports[-1] = self._reports[-1][0], done
            return
        self._reports.append((now_s, done))
        while self._reports[-1][0] - self._reports[0][0] > _LONGEST_S and len(self._reports) > 2:
            self._reports.popleft()

    def per_s(self) -> float | None:
        """Return how many a second; None: it is not known yet."""
        if not self._reports:
            return None
        (first_s, before), (last_s, done) = self._reports[0], self._reports[-1]
        return (done - before) / (last_s - first_s) if last_s - first_s >= _LEAST_S else None


class _Printed(Console):
    """A console whose control characters are its own: texts have none, whoever made them."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Render what is to be printed."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                lines = "\n".join(one_line(line) for line in segment.text.split("\n"))
                yield Segment(lines, segment.style)

    def _check_buffer(self) -> None:
        """Write what has been rendered; where a remark cannot be written, there is no place to report it."""
        try:
            super()._check_buffer()
        except OSError as error:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())  # what is left would be written at the end
            if not self.stderr:
                from pipeline.files import explain  # seldom needed

                raise OutputError(f"cannot write to standard output: {explain(error)}") from None


#: Results, and remarks. Names of files may look like markup.
stdout = _Printed(markup=False, emoji=False)
stderr = _Printed(stderr=True, markup=False, emoji=False)


def say(line: str) -> None:
    """Print a line of the result, however long."""
    stdout.print(one_line(line), highlight=False, soft_wrap=True)


def frames(count: int) -> str:
    """Return the begin of a sentence about some frames.

    >>> frames(1), frames(2)
    ('1 frame is', '2 frames are')
    """
    return "1 frame is" if count == 1 else f"{count} frames are"


def remark(line: str) -> None:
    """Print a remark, in yellow, on standard error."""
    _print(line, "yellow")


def _print(line: str, style: str) -> None:
    stderr.print(one_line(line), style=style, highlight=False, soft_wrap=True)


class _Progress:
    """One line that reports progress: always on a terminal, where it goes when it is over; elsewhere rarely.

    Parameters
    ----------
    columns : ProgressColumn
        Parts of the line on a terminal.
    """

    def __init__(self, *columns: ProgressColumn) -> None:
        self._bar = Progress(*columns, console=stderr, transient=True, disable=not stderr.is_terminal)
        self._task: TaskID = self._bar.add_task("starting", total=None, rate="")
        self._since_s = time.monotonic()
        self._ended = Event()
        self._thread = Thread(target=self._report_rarely, name="progress", daemon=True)

    def __enter__(self) -> "_Progress":
        self._bar.start()
        if not stderr.is_terminal:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        self._bar.stop()

    def say(self, what: str) -> None:
        """Say what is being done."""
        if what != self._bar.tasks[0].description:
            # At once: a kernel that is compiled next may keep the line as it is until it is done.
            self._bar.update(self._task, description=what, refresh=True)

    def count(self, done: int, of: int, rate: str) -> None:
        """Say how much is done, and how fast."""
        self._bar.update(self._task, completed=done, total=of, rate=rate)

    def _report_rarely(self) -> None:
        while not self._ended.wait(_RARELY_S):
            task = self._bar.tasks[0]
            counts = "" if task.total is None else f" {task.completed:.0f} of {task.total:.0f}"
            parts = [f"{task.description}{counts}", task.fields["rate"]]
            elapsed_s = time.monotonic() - self._since_s
            _print(", ".join(part for part in (*parts, f"after {elapsed_s:.0f} s") if part), "")


@contextmanager
def steps() -> Iterator[Callable[[str], None]]:
    """Show what is being done and for how long; what is yielded is called with what it is."""
    with _Progress(SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()) as line:
        yield line.say


class Count:
    """Shows how many frames are done, and of how many; and what is being done."""

    def __init__(self, line: _Progress) -> None:
        self._line = line
        self._rate = FrameRate()
        self._before: int | None = None  # that were done before this run
        self._shown = (-1, 0)

    def __call__(self, done: int, of: int) -> None:
        """Show that some frames are done; the first count was done before."""
        if self._before is None:
            self._before = done
        elif done > self._before:
            self._rate.note(done)
        per_s = self._rate.per_s()
        left = "" if not per_s else f"{per_s:.1f} frames/s, {timedelta(seconds=round((of - done) / per_s))} left"
        self._line.count(done, of, left)

    def progress(self, come: "DecodeProgress") -> None:
        """Show how far decoding has come."""
        self._line.say(come.doing)
        if come.remark is not None:
            remark(come.remark)
        if come.of and (come.done, come.of) != self._shown:
            self._shown = come.done, come.of
            self(come.done, come.of)


@contextmanager
def counted(what: str) -> Iterator[Count]:
    """Show how many frames are done, and how fast; what is yielded is called with how many, and of how many."""
    columns = BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}", markup=False)
    with _Progress(TextColumn("{task.description}", markup=False), *columns, TimeElapsedColumn()) as line:
        line.say(what)
        yield Count(line)


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


# Options that several commands have, explained once.
Arch = Annotated[Literal["auto", "cpu", "vulkan", "cuda", "metal"], Parameter(help="Where to compute.")]
Replace = Annotated[bool, Parameter(help="Replace a file that is there.")]
IntoOther = Annotated[bool, Parameter(help="Write into a folder that holds other things.")]
SettingsFile = Annotated[Path | None, Parameter(help="TOML file of settings; what is left out is the default.")]
RigFile = Annotated[Path, Parameter(help="The rig's TOML file.")]
WhiteLevel = Annotated[
    float | None, Parameter(validator=above_zero, help="Full scale of the captures; left out, their type's.")
]
ProjectorSize = Annotated[str, Parameter(help="The projector's width and height in px.")]
Make = Annotated[Path | None, Parameter(help="Write the pictures to project into this new folder instead.")]
NewCalibration = Annotated[Path | None, Parameter(help="The calibration to write.")]


@Parameter(name="*")
@dataclass(frozen=True)
class PageOptions:
    """Address of the page."""

    port: Annotated[int, Parameter(validator=bounded(0, 65535))] = 0
    """The page's port on this machine; left out, one that is free."""
    browser: bool = True
    """Open the page in the browser; --no-browser only prints its address."""


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


def part_of(text: str, option: str) -> tuple[int, int, int, int]:
    """Read a part of a picture, as in 100,50,640,480: x, y, width, height.

    Raises
    ------
    SettingsError
        It is none; the message names the option.
    """
    found = re.fullmatch(",".join([r"\s*([0-9]{1,6})\s*"] * 4), text)
    if found is None or 0 in map(int, found.groups()[2:]):
        raise SettingsError(f"{option} is {text!r}: give x,y,width,height in px, as in 100,50,640,480")
    x, y, width, height = map(int, found.groups())
    return x, y, width, height


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


def read_settings(path: Path | None) -> "DecodeSettings":
    """Return the settings in a TOML file, or the default where none is given."""
    from pipeline.settings import DecodeSettings

    return DecodeSettings() if path is None else DecodeSettings.read(path)


def read_calibration(path: Path | None) -> "Calibration | None":
    """Return the calibration in a file, if one is given."""
    from pipeline.calibration import Calibration

    return None if path is None else Calibration.read(path)


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    prefix = "warning" if issubclass(category, DecodeWarning | SlowStart) else category.__name__
    remark(f"{prefix}: {message}")


def _limit_of_the_system(error: Exception) -> str | None:
    """Return which limit of the system an error that nobody has caught shows; None: it is a mistake of ours."""
    if isinstance(error, MemoryError):
        return "memory is used up: decode smaller frames, or with fewer --workers"
    if isinstance(error, RuntimeError) and "can't start new thread" in str(error):  # Python has no class for it
        return "the system starts no more threads: raise your limit (ulimit -u)"
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE, errno.EAGAIN):
        return f"{error.strerror}: raise your limits (ulimit -n, ulimit -u)"
    return None


def run(command: Callable[[], object]) -> None:
    """Run a command: warnings and a user's mistakes are one line each on standard error.

    A mistake ends it with exit code 1, Ctrl-C with 130.
    """
    warnings.showwarning = _show_warning
    try:
        command()
    except Exception as error:
        line = str(error) if isinstance(error, Error) else _limit_of_the_system(error)
        if line is None:
            raise
        _print(f"error: {line}", "red")
        sys.exit(1)
    except KeyboardInterrupt as stopped:
        _print(str(stopped) or "interrupted", "red")
        sys.exit(130)
