"""Kill the command twenty times at random moments, then let it finish: python tests/benchmarks/kills.py [KILLS [SEED]].

The store must have the same keys and bytes as that of an undisturbed run, and no frame that was done is written again.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import _tests_path  # noqa: F401 - puts support on the path
from support.command_line import command
from support.recorded_footage import contents, kill_again_and_again, record

from tikernels import runtime


def main() -> None:
    """Kill, finish, compare."""
    given = [int(argument) for argument in sys.argv[1:]]
    runtime.init("cpu")
    kills, seed = given + [20, 1][len(given) :]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record(folder / "film.mkv", 200)
        killed = kill_again_and_again(folder / "film.mkv", folder / "killed", kills, seed)
        for out in ("killed", "whole"):
            subprocess.run(command("decode", folder / "film.mkv", "--out", folder / out, "--arch", "cpu"), check=True)
        same = contents(folder / "killed") == contents(folder / "whole")
        print(f"killed {killed} times while it ran: the store is {'the same' if same else 'DIFFERENT'}")
        sys.exit(not same)


if __name__ == "__main__":
    main()
