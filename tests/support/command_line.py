"""The command line, as its user runs it."""

import os
import subprocess
import sys
from pathlib import Path


def colorphase(*arguments: object, cwd: Path) -> "subprocess.CompletedProcess[str]":
    """Run the command in a process of its own."""
    code = "import sys; from pipeline.cli.main import main; sys.argv[0] = 'colorphase'; main()"
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "COLUMNS": "200"},
        check=False,
    )
