"""A guided capture that is interrupted at random, by kill -9, Ctrl-C and SIGTERM: what is lost of it.

Pictures that were kept must stay as they were, to the last bit, unless their pose was begun anew, and the calibration
at the end must be as good as one without interruptions.

python tests/benchmarks/interrupted_captures.py [--times 50] [--seed 0]
"""

import argparse
import os
import signal
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import _tests_path  # noqa: F401
import numpy as np
from calibration_accuracy import depth_error_mm
from support.command_line import command

from pipeline.calibration import Calibration
from pipeline.simulation import simulated_truth

LIGHT = ("calibrate", "capture", "radiometry", "--rig", "simulated", "--out", "captures")
BOARD = ("--board", "chessboard", "--squares", "11x8", "--square-mm", "24")
GEOMETRY = ("calibrate", "capture", "geometry", "--rig", "simulated", "--out", "captures", *BOARD)
SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
#: How long a run may take, s, before it is interrupted.
LONGEST_S = 25.0


def main() -> None:
    """Interrupt, go on, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    left, interrupted, begun_anew = options.times, 0, 0
    with TemporaryDirectory() as folder:
        captures = Path(folder) / "captures"
        complete: dict[str, bytes] = {}
        partial: dict[str, bytes] = {}
        for arguments in (LIGHT, GEOMETRY):
            while True:
                ended = run(arguments, folder, float(rng.uniform(2, LONGEST_S)) if left else None, rng)
                now = {str(path.relative_to(captures)): path.read_bytes() for path in captures.rglob("*.png")}
                lost = [name for name, content in complete.items() if now.get(name) != content]
                assert not lost, f"lost or changed: {lost[:3]}"
                complete = {name: content for name, content in now.items() if not name.startswith((".", "poses/."))}
                # A partial pose or light stays, is finished, or is begun anew because the scene has changed.
                finished = {name: now.get(name.replace("/.", "/").removeprefix(".")) for name in partial}
                begun_anew += any(
                    now.get(name) != content and finished[name] != content for name, content in partial.items()
                )
                partial = {name: content for name, content in now.items() if name.startswith((".", "poses/."))}
                complete = {name: content for name, content in complete.items() if "/" in name}
                if ended:
                    break
                left, interrupted = max(left - 1, 0), interrupted + 1
                print(f"{interrupted}: {len(complete)} pictures, {len(partial)} of what is not complete", flush=True)
        found = Calibration.read(captures / "calibration.json")
        off_mm = depth_error_mm(found.geometry(), simulated_truth().geometry())
        print(f"{interrupted} interruptions: 0 complete pictures lost or changed, {begun_anew} times begun anew; depth")
        print(f"at 900 mm is off by {off_mm:.3f} mm RMS, {found.uncertainty.depth_bias_mm:.3f} predicted")


def run(arguments: tuple[str, ...], folder: str, seconds: float | None, rng: np.random.Generator) -> bool:
    """Run a command, and interrupt it after some seconds; return whether it had ended by then."""
    child = subprocess.Popen(command(*arguments), cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        _, complained = child.communicate(timeout=seconds)
        assert child.returncode == 0, complained.decode()
        return True
    except subprocess.TimeoutExpired:
        os.kill(child.pid, SIGNALS[rng.integers(len(SIGNALS))])
        child.communicate(timeout=60)
        return False


if __name__ == "__main__":
    main()
