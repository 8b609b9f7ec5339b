import json
import signal
import subprocess
import time

import pytest
from support.command_line import command

from pipeline.footage.opening import open_footage


def log_of(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


@pytest.mark.usefixtures("kernels_on_disk")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_stops_when_told_to(tmp_path, number):
    """Whatever moment it comes at, and however often: exit code, folder and pulses fit together."""
    out = tmp_path / "out"
    arguments = command("capture", "--rig", "simulated", "--out", out, "--endless", "--arch", "cpu")
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        end = time.monotonic() + 120
        while not ((out / "log.jsonl").exists() and '"event": "burst"' in (out / "log.jsonl").read_text()):
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < end, "no burst ever came"
            time.sleep(0.02)
        for _ in range(3):
            process.send_signal(number)
            time.sleep(0.01)
        stdout, stderr = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, stderr
    assert "frames of" in stdout and "Traceback" not in stderr
    n_frames = sum(line["event"] == "frame" for line in log_of(out))
    assert n_frames == len(open_footage(out / "recording.zarr")) > 0
    assert log_of(out)[-1]["event"] == "end"
