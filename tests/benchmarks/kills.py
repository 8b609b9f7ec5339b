"""Kill decoding and capturing at random moments: python tests/benchmarks/kills.py [KILLS [SEED]], 20 by default.

Half of them are runs of `colorphase decode` over one footage, which then finishes: the store must have the same keys
and bytes as that of an undisturbed run, and no frame that was done is written again. The others are captures of a
simulated rig; `colorphase verify` finishes what they leave: every frame of the recording must be
whole and have its line in the log, and the log no line more.
"""

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import _tests_path  # noqa: F401 - puts support on the path
from support.command_line import command
from support.recorded_footage import contents, kill_again_and_again, record

from pipeline.errors import FootageError
from pipeline.footage.opening import open_footage
from pipeline.verification import verify
from tikernels import runtime

RIG = """
[trigger]
driver = "simulated"
strobe = true
[timing]
period_s = 0.01
frames = {frames}
[camera]
driver = "simulated"
exposure_s = 0.005
"""
# Few places, which are rendered soon.
CAPTURE = (
    "import sys; from pipeline.acquisition import simulated_capture as scene; from pipeline.cli.main import main;"
    "scene._PLACES = 2; sys.argv[0] = 'colorphase'; main()"
)


def main() -> None:
    """Kill, finish, compare."""
    given = [int(argument) for argument in sys.argv[1:]]
    runtime.init("cpu")
    kills, seed = given + [20, 1][len(given) :]
    with tempfile.TemporaryDirectory() as name:
        same = kill_decoding(Path(name), kills // 2, seed)
    with tempfile.TemporaryDirectory() as name:
        whole = kill_captures(Path(name), kills - kills // 2, random.Random(seed))
    sys.exit(not (same and whole))


def kill_decoding(folder: Path, kills: int, seed: int) -> bool:
    """Kill runs over one footage; say whether the result is that of an undisturbed run."""
    record(folder / "film.zarr", max(200, 25 * kills))
    killed = kill_again_and_again(folder / "film.zarr", folder / "killed", kills, seed)
    for out in ("killed", "whole"):
        subprocess.run(command("decode", folder / "film.zarr", "--out", folder / out, "--arch", "cpu"), check=True)
    ours = {name: digest for name, digest in contents(folder / "killed").items() if not name.endswith(".lock")}
    same = ours == contents(folder / "whole")
    print(f"decode, killed {killed} times while it ran: the store is {'the same' if same else 'DIFFERENT'}")
    return same


def kill_captures(folder: Path, kills: int, rng: random.Random) -> bool:
    """Kill captures, each of its own; say whether what is left of them is whole once it is finished."""
    n_frames, n_empty, wrong = 0, 0, []
    for k in range(kills):
        out = folder / str(k)
        rig = folder / "rig.toml"
        rig.write_text(RIG.format(frames=rng.choice((1, 1, 3, 20))))
        options = ["capture", "--rig", rig, "--out", out, "--bursts", "100000", "--arch", "cpu"]
        options += ["--endless"] * rng.choice((0, 1))
        with subprocess.Popen(
            [sys.executable, "-c", CAPTURE, *map(str, options)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=os.getcwd(),
        ) as process:
            log, deadline = out / "log.jsonl", time.monotonic() + 60
            while process.poll() is None and not log.exists() and time.monotonic() < deadline:
                time.sleep(0.01)
            time.sleep(rng.uniform(0, 1.0))
            process.send_signal(signal.SIGKILL)
        found = _finished(out)
        if isinstance(found, str):
            wrong.append(f"{k}: {found}")
        else:
            n_frames += found
            n_empty += not found
    print(f"capture, killed {kills} times: {n_frames} frames are whole and in the log; {n_empty} captures had none yet")
    for line in wrong:
        print(f"  WRONG: {line}")
    return not wrong


def _finished(out: Path) -> int | str:
    """Finish what a capture has left, and return how many frames it holds, or what is wrong."""
    try:
        found = verify(str(out))
    except FootageError as error:
        return 0 if "holds no result and no recording" in str(error) else str(error)
    if not all(each.whole for each in found):
        return f"{[(each.faults, each.damage) for each in found]}"
    recordings = [path for path in out.iterdir() if path.name.startswith("recording")]
    events = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    logged = [event["frame"] for event in events if event["event"] == "frame"]
    n_frames = 0
    if recordings:
        source = open_footage(recordings[0])
        n_frames = len(source)
        source.close()
    return n_frames if logged == list(range(n_frames)) else f"{n_frames} frames, and in the log {logged[-5:]}"


if __name__ == "__main__":
    main()
