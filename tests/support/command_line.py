"""The command line, as its user runs it: in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path


def command(*arguments: object) -> list[str]:
    """Return the command line of `colorphase` with these arguments."""
    code = "import sys; from pipeline.cli.main import main; sys.argv[0] = 'colorphase'; main()"
    return [sys.executable, "-c", code, *map(str, arguments)]


def colorphase(*arguments: object, cwd: Path) -> "subprocess.CompletedProcess[str]":
    """Run the command to its end."""
    return subprocess.run(
        command(*arguments),
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "COLUMNS": "200"},
        check=False,
    )
