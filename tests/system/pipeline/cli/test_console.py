"""What all commands share."""

import errno
import inspect
import time
import warnings
from types import SimpleNamespace

import pytest

import hardware.errors
import pipeline.errors
import tikernels.errors
from pipeline.batch.run import DecodeProgress
from pipeline.cli import console
from pipeline.cli.console import FrameRate
from pipeline.errors import DecodeWarning, OutputError, SettingsError


def rate_of(*reports):
    """Return the rate after reports: seconds since the first one, and how many are done."""
    times_s = iter([100.0 + after_s for after_s, _ in reports])
    rate = FrameRate(lambda: next(times_s))
    for _, done in reports:
        rate.note(done)
    return rate.per_s()


def test_frames_that_are_reported_all_at_once_have_no_rate():
    assert rate_of() is None
    assert rate_of((0, 0)) is None
    assert rate_of(*((1e-5 * n, n) for n in range(1, 41))) is None


def test_neither_the_start_nor_what_was_done_before_counts():
    """The first report has 12 frames, whatever they took; from then on there are ten a second."""
    assert rate_of((0, 312), (0.5, 317), (1.0, 322), (2.0, 332)) == pytest.approx(10.0)
    assert rate_of((0, 312), (0.1, 317), (1.1, 327)) == pytest.approx(10 / 1.1)


@pytest.mark.parametrize("together", [1, 5])
def test_reports_that_come_together_are_one(together):
    """Two processes report every half second, each what it has done since."""
    reports = [(0.5 * k + 1e-4 * i, 5 * k + i) for k in range(40) for i in range(together)]
    assert rate_of(*reports) == pytest.approx(10.0, rel=0.06)


def test_it_follows_the_last_half_minute():
    slow = [(s, s) for s in range(100)]
    fast = [(100 + s, 100 + 5 * s) for s in range(40)]
    assert rate_of(*slow, *fast) == pytest.approx(5.0)


@pytest.mark.parametrize(("text", "expected"), [("1024x768", (1024, 768)), ("1X1", (1, 1))])
def test_a_size_is_read(text, expected):
    assert console.size_of(text) == expected


@pytest.mark.parametrize("text", ["", "x", "1024", "1024x", "x768", "0x768", "-1x5", "1.5x2", "1024x768x3", "1024 768"])
def test_what_is_no_size_is_refused_by_its_option(text):
    with pytest.raises(SettingsError, match=r"^--squares is .*: give width and height in px, as in 1024x768$"):
        console.size_of(text, "--squares")


@pytest.mark.parametrize(
    ("check", "allowed", "refused", "message"),
    [
        (console.bounded(1), (None, 1, 10**9), (0, -1, float("nan")), "must be 1 or more"),
        (console.bounded(0.1, 1000), (0.1, 30, 1000), (0.09, 1000.1, float("nan")), "must be 0.1 to 1000"),
        (console.above_zero, (None, 1e-9, 5), (0, -1, float("inf"), float("nan")), "must be above 0, and a number"),
    ],
)
def test_bounds(check, allowed, refused, message):
    for value in allowed:
        check(float, value)
    for value in refused:
        with pytest.raises(ValueError, match=f"^{message}$"):
            check(float, value)


def test_a_target_that_cannot_be_written_is_refused(tmp_path):
    console.check_target(tmp_path / "new.json", force=False)
    (tmp_path / "old.json").touch()
    console.check_target(tmp_path / "old.json", force=True)
    with pytest.raises(OutputError, match=r"old\.json exists already: choose another name, or add --force"):
        console.check_target(tmp_path / "old.json", force=False)
    with pytest.raises(OutputError, match="create the folder first"):
        console.check_target(tmp_path / "none" / "new.json", force=True)


@pytest.mark.parametrize("module", [hardware.errors, pipeline.errors, tikernels.errors])
def test_every_error_of_the_packages_is_one_line(module, monkeypatch, capsys):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    errors = [error for _, error in inspect.getmembers(module, inspect.isclass) if not issubclass(error, Warning)]
    assert errors
    for error in errors:

        def command(error=error):
            raise error("no [red] lamp :smile: is on: switch one on")

        with pytest.raises(SystemExit) as stopped:
            console.run(command)
        assert stopped.value.code == 1
        assert capsys.readouterr().err == "error: no [red] lamp :smile: is on: switch one on\n"


HOSTILE = "a\x1b[31m\x1b]0;title\x07b\nerror: c\r\td\x7f\x9b2J\u202ee\u2066f\u2028g\u061c\u200fh\x00\udcfc"


def test_control_characters_from_outside_are_not_printed(monkeypatch, capsys):
    """In a result, a remark, an error, a warning, a table's cell and title."""
    from rich.table import Table

    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)

    def command():
        warnings.warn(HOSTILE, DecodeWarning, stacklevel=1)
        raise OutputError(HOSTILE)

    console.say(HOSTILE)
    console.remark(HOSTILE)
    with warnings.catch_warnings(), pytest.raises(SystemExit):
        warnings.simplefilter("always")
        console.run(command)
    told = capsys.readouterr()
    assert told.out == "a[31m]0;titleb error: c  d2Jef gh?\n"
    assert [line.partition(": ")[0] for line in told.err.splitlines()] == ["a[31m]0;titleb error", "warning", "error"]
    table = Table(HOSTILE, title=HOSTILE)
    table.add_row(HOSTILE)
    console.stdout.print(table)
    with console.steps() as step:
        step(HOSTILE)
    table_text = capsys.readouterr().out
    assert "title" in table_text
    assert all(character.isprintable() for character in table_text.replace("\n", ""))


def test_a_terminal_keeps_the_consoles_own_colours(monkeypatch):
    from io import StringIO

    shown = StringIO()
    monkeypatch.setattr(console, "stderr", console._Printed(file=shown, force_terminal=True, color_system="standard"))
    console.remark("red\x1b[31m")
    assert shown.getvalue() == "\x1b[33mred[31m\x1b[0m\n"


def test_other_errors_are_not_hidden(monkeypatch):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    with pytest.raises(ZeroDivisionError):
        console.run(lambda: 1 / 0)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "memory is used up: decode smaller frames, or with fewer --workers"),
        (RuntimeError("can't start new thread"), "the system starts no more threads: raise your limit (ulimit -u)"),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files: raise your limits (ulimit -n, ulimit -u)"),
    ],
)
def test_limits_of_the_system_are_one_line(error, said, monkeypatch, capsys):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)

    def command():
        raise error

    with pytest.raises(SystemExit) as stopped:
        console.run(command)
    assert stopped.value.code == 1
    assert capsys.readouterr().err == f"error: {said}\n"


@pytest.mark.parametrize(("message", "said"), [("", "interrupted"), ("stopped: run it again", "stopped: run it again")])
def test_ctrl_c_is_one_line_and_130(message, said, monkeypatch, capsys):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)

    def command():
        raise KeyboardInterrupt(*[message] * bool(message))

    with pytest.raises(SystemExit) as stopped:
        console.run(command)
    assert stopped.value.code == 130
    assert capsys.readouterr().err == f"{said}\n"


def test_warnings_are_one_line(monkeypatch, capsys):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)

    def command():
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            console.run(lambda: None)
            warnings.warn("no fringe stands out", DecodeWarning, stacklevel=1)
            warnings.warn("old", DeprecationWarning, stacklevel=1)

    command()
    assert capsys.readouterr().err == "warning: no fringe stands out\nDeprecationWarning: old\n"


def test_progress_is_silent_where_there_is_no_terminal(capsys):
    with console.steps() as step:
        step("no [/red] markup")
    with console.counted("meshes") as show:
        show(1, 3)
        show(3, 3)
    assert capsys.readouterr() == ("", "")


def test_where_there_is_no_terminal_a_line_tells_now_and_then(monkeypatch, capsys):
    """Of what takes long, on standard error; whole lines, without anything that moves the cursor."""
    monkeypatch.setattr(console, "_RARELY_S", 0.05)
    told = ""
    with console.steps() as step:
        step("meshing [red]")
        while "\n" not in told:
            time.sleep(0.01)
            said, more = capsys.readouterr()
            told += more
            assert said == ""
    assert told.startswith("meshing [red], after 0 s\n")
    with console.counted("decoding") as show:
        show(40, 100)
        show.progress(DecodeProgress(doing="decoding to about 2.1 GB"))
        capsys.readouterr()
        while "\n" not in (told := capsys.readouterr().err):
            time.sleep(0.01)
    assert told.startswith("decoding to about 2.1 GB 40 of 100, after 0 s\n") and "\x1b" not in told


def test_frames_that_were_done_before_are_counted_and_have_no_rate(monkeypatch):
    shown, now = [], [0.0]
    line = SimpleNamespace(count=lambda *told: shown.append(told), say=lambda what: None)
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    count = console.Count(line)
    for at_s, done in ((0, 400), (60, 412), (61, 422), (62, 432)):
        now[0] = at_s
        count(done, 500)
    assert shown == [
        (400, 500, ""),
        (412, 500, ""),
        (422, 500, "10.0 frames/s, 0:00:08 left"),
        (432, 500, "10.0 frames/s, 0:00:07 left"),
    ]


def test_progress_on_a_terminal(monkeypatch):
    """What is said is shown as it is, brackets and all; what was done before does not count for the rate."""
    from io import StringIO

    from rich.console import Console

    shown = StringIO()
    terminal = Console(file=shown, force_terminal=True, width=120, markup=False, emoji=False)
    monkeypatch.setattr(console, "stderr", terminal)
    with console.steps() as step:
        step("reading [red] film")
    assert "reading [red] film" in shown.getvalue()
    with console.counted("decoding") as show:
        show.progress(DecodeProgress(doing="compiling kernels"))
        show(40, 50)
        show(50, 50)
    assert all(text in shown.getvalue() for text in ("decoding", "compiling kernels", "50/50"))
