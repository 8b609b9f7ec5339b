"""`colorphase calibrate simulate` as its user meets it; what it makes, in `test_practice_set.py`."""

import shlex

from pipeline.acquisition import practice_set
from pipeline.acquisition.practice_set import practice_rig
from pipeline.cli.main import command_line


def test_it_says_what_is_true_and_what_comes_next(monkeypatch, command, tmp_path):
    """Sides, baseline and radius; and commands that the program understands."""

    def made(folder, arch, tell):
        folder.mkdir()
        return practice_rig()

    monkeypatch.setattr(practice_set, "write_practice", made)  # which takes a minute
    done = command("calibrate", "simulate", "--out", "my practice")
    assert done.returncode == 0, done.stderr
    first, _, *commands = done.stdout.strip().splitlines()
    assert "squares are 22 mm, the second board's 18 mm" in first and "stand 180 mm apart" in first
    assert "the ball's radius is 85 mm" in first
    assert [line.split()[1] for line in commands] == ["calibrate", "calibrate", "calibrate", "decode"]
    for line in commands:
        words = shlex.split(line)[1:]
        command_line(words).parse_args(words, exit_on_error=False, print_error=False)


def test_a_folder_that_is_there_is_refused(command, tmp_path):
    (tmp_path / "practice").mkdir()
    done = command("calibrate", "simulate", "--out", "practice")
    assert done.returncode == 1 and done.stderr == "error: practice exists already: choose another name\n"
