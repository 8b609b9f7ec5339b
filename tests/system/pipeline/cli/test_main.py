"""What all commands have in common: help, one line for a mistake, and nothing half-written."""

from importlib.metadata import version

import pytest

import colorphase
from pipeline.cli.main import command_line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("decode", "no.png", "--out", "x"), "cannot read no.png"),
        (("decode", "settings.toml", "--out", "x"), "is not a video that can be read"),
        (("decode", "nowhere", "--out", "x"), "there is no such file"),
        (("decode", "pictures", "--out", "frame.png", "--arch", "cpu"), "its folder is a file"),
        (("decode", "pictures", "--out", "."), "holds something else"),
        (("decode", "black.png", "--out", "x", "--calibration", "calibration.json"), "but the calibration is for"),
        (("decode", "frame.png", "--out", "x", "--calibration", "settings.toml"), "not what it should be"),
        (("decode", "frame.png", "--out", "x", "--settings", "calibration.json"), "not what it should be"),
        (("decode", "frame.png", "--out", "frame.png"), "is a file"),
        (("decode", "frame.png", "--out", "frame.png/x"), "its folder is a file"),
        (("decode", "frame.png", "--out", "."), "holds something else"),
        (("decode", "frame.png", "--out", "x", "--arch", "abacus"), "Invalid value"),
        (("decode", "frame.png", "--out", "x", "--roi", "0,0,64,64"), "only footage takes --roi: omit"),
        (("decode", "pictures", "--out", "x", "--fields", "mask", "--export", "ply"), "made of range_image: add that"),
        (("decode", "pictures", "--out", "memory://x", "--export", "ply"), "run colorphase export"),
        (("capture", "--rig", "simulated", "--out", "x", "--settings", "settings.toml"), "add --view, or omit"),
        (("capture", "--rig", "black.png", "--out", "x"), "black.png is not what it should be: it is no text file"),
        (("render", "frame.png", "--out", "x.png"), "no picture of depth"),
        (("render", "none.ply", "--out", "x.png"), "cannot read none.ply"),
        (("render", "none.ply", "--out", "x.gif"), "name it .png for a still picture, .mp4 for a film"),
        (("pattern", "x.png", "--size", "wide"), "as in 1024x768"),
        (("pattern", "x.png", "--period", "1"), "period_px"),
        (("pattern", "x/y.png"), "create the folder first"),
        (("pattern", "x.png", "--period", "0"), "period_px"),
        (("pattern", "x.pdf", "--board", "charuco", "--squares", "30x20", "--dictionary", "DICT_4X4_50"), "50 markers"),
        (("pattern", "x.pdf", "--board", "charuco", "--square-mm", "0"), "must be above 0"),
        (("project", "black.png", "--seconds", "nan"), "must be above 0"),
        (
            ("calibrate", "check", "black.png", "--calibration", "calibration.json", "--radius-mm", "-1"),
            "must be above 0",
        ),
        (("calibrate", "radiometry", ".", "--out", "y.json", "--white-level", "0"), "must be above 0"),
        (("calibrate", "radiometry", ".", "--out", "x/y.json"), "create the folder first"),
        (("calibrate", "radiometry", ".", "--out", "y.json", "--exposure-s", "0"), "exposure_s"),
    ],
)
def test_mistakes_get_one_line_and_leave_nothing(folder, arguments, message, command):
    before = sorted(p.name for p in folder.iterdir())
    done = command(*arguments, cwd=folder)
    assert done.returncode != 0
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    assert message in lines[0]
    assert sorted(p.name for p in folder.iterdir()) == before


@pytest.mark.parametrize(
    "name", ["demo", "pattern", "decode", "render", "devices", "plan", "rig", "settings", "export"]
)
def test_help_has_an_example(folder, name, command):
    done = command(name, "--help", cwd=folder)
    assert done.returncode == 0
    assert f"Example: colorphase {name}" in done.stdout


def test_names_are_printed_as_they_are(folder, command):
    """Brackets and colons are not markup."""
    for name in ("no [red] film", "no [/film].png", "a :smile:.ply"):
        for words in (("decode", name, "--out", "x"), ("render", name, "--out", "x.png")):
            done = command(*words, cwd=folder)
            assert done.returncode == 1 and f"cannot read {name}" in done.stderr, done.stderr
    done = command("decode", "x", "--out", "x", "--arch", "[/red]", cwd=folder)
    assert done.returncode == 2 and 'Invalid value "[/red]"' in done.stderr, done.stderr


def test_the_version_is_the_packages():
    assert command_line(()).version == colorphase.__version__ == version("colorphase")


def test_every_family_is_there(command):
    code, said, _ = command("--help")
    assert code == 0
    for name in (
        *("demo", "calibrate", "capture", "project", "projector", "pattern", "decode", "inspect", "render", "export"),
        *("devices", "plan", "rig", "settings", "verify"),
    ):
        assert f"│ {name} " in said


def test_a_command_gives_its_own_help(command):
    """Not the line that `colorphase --help` lists; words that happen to be names of commands change nothing."""
    for name in ("decode", "calibrate", "projector"):
        code, said, _ = command(name, "--help")
        assert code == 0 and f"Usage: colorphase {name}" in said
    assert "A picture gives result.zarr" in command("decode", "--help")[1]
    assert "cannot read plan" in command("decode", "plan", "--out", "export")[2]
    assert 'Unknown command "decoed". Did you mean "decode"?' in command("decoed")[2]


def commands_of(app, words=()):
    """Yield the words of every command."""
    for name in app:
        if not name.startswith("-"):
            yield (*words, name)
            yield from commands_of(app[name], (*words, name))


def test_no_help_lists_flags_that_empty_something(command):
    every = sorted(commands_of(command_line(())))
    assert {("decode",), ("calibrate", "capture", "geometry"), ("projector", "on")} <= {*every}
    for words in every:
        code, said, _ = command(*words, "--help")
        assert code == 0 and "Usage" in said and "--empty-" not in said, words
