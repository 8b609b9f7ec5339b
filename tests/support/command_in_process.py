"""The command line in this process, where kernels are compiled once."""

import warnings
from typing import NamedTuple

import pytest

from hardware.projector import pjlink, switching
from pipeline.cli import console
from pipeline.cli import main as cli


class Done(NamedTuple):
    """What a command left."""

    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    """Return a function that runs `colorphase` with some arguments, in a folder of its own or in another one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")  # of the consoles that Cyclopts makes
    for printed in (console.stdout, console.stderr):
        monkeypatch.setattr(printed, "width", 200)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(console, "_RARELY_S", 3600)  # on a busy machine a command may take longer than is usual
    monkeypatch.setattr(pjlink, "ANSWER_S", 0.5)
    monkeypatch.setattr(switching, "POLL_S", 0.02)

    def run(*arguments, cwd=tmp_path):
        monkeypatch.chdir(cwd)
        monkeypatch.setattr("sys.argv", ["colorphase", *(str(argument) for argument in arguments)])
        code = 0
        with warnings.catch_warnings():  # which it shows in a way of its own
            warnings.simplefilter("default")
            try:
                cli.main()
            except SystemExit as stopped:
                code = stopped.code
        return Done(code, *capsys.readouterr())

    return run
