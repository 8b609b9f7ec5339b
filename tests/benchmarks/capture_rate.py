"""How many frames a second are kept: an in-memory camera at 640x480, pulses without a gap, every frame checked.

    python tests/benchmarks/capture_rate.py [--seconds 20] [--rate 200] [--live]

Says how many frames were whole, recorded and thrown away, what it took of the processor, and whether memory grows.
"""

import argparse
import json
import resource
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hardware.protocols import FrameFormat
from hardware.settings import RigSettings
from hardware.simulated import SimulatedInstruments
from pipeline.acquisition.capture_folder import CapturePlan, CaptureProgress
from pipeline.acquisition.session import Stopping, capture_bursts
from pipeline.settings import DecodeSettings
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

SIZE_PX = (640, 480)
N_IMAGES = 8
BLOCK = 20


def resident_mb() -> float:
    """Return how much memory this process holds."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6


def main() -> None:
    """Capture for a while, and print what came of it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=200.0)
    parser.add_argument("--live", action="store_true")
    parser.add_argument("--out", type=Path, default=None, help="a folder on the disk to be measured")
    options = parser.parse_args()

    runtime.init("cpu")
    rig = simulated_rig(SIZE_PX)
    images = [simulate_frame(rig, SimulationSettings(seed=seed)).image.astype(np.uint8) for seed in range(N_IMAGES)]
    n_exposed = 0

    def render(picture: int, time_s: float) -> npt.NDArray[np.uint8]:
        nonlocal n_exposed
        n_exposed += 1
        return images[n_exposed % N_IMAGES]

    settings = RigSettings.model_validate(
        {
            "trigger": {"driver": "simulated", "strobe": True},
            "timing": {"period_s": 1 / options.rate, "frames": BLOCK},
            "camera": {"driver": "simulated", "exposure_s": 0.3 / options.rate},
        }
    )
    devices = SimulatedInstruments.wired(render, SIZE_PX, FrameFormat("rgb"), settings)
    n_bursts = round(options.seconds * options.rate / BLOCK)
    resident: list[float] = []
    latencies: list[float] = []
    last: list[CaptureProgress] = []

    def notify(progress: CaptureProgress) -> None:
        last[:] = [progress]
        if progress.n_bursts % 20 == 0:
            resident.append(resident_mb())
            if progress.latency_s is not None:
                latencies.append(progress.latency_s)

    with tempfile.TemporaryDirectory(dir=options.out) as folder:
        out = Path(folder, "captured")
        wall, cpu = time.perf_counter(), time.process_time()
        summary = capture_bursts(
            settings,
            lambda: (devices.trigger, devices.camera),
            out,
            CapturePlan(n_bursts, endless=True, live=options.live, arch="cpu"),
            calibration=rig if options.live else None,
            decoding=DecodeSettings(),
            stopping=Stopping(),
            notify=notify,
        )
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        size = sum(path.stat().st_size for path in summary.recording.rglob("*") if path.is_file())
        logged = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
        shutil.rmtree(out)
    raw = summary.n_frames * images[0].nbytes
    kept = sum(line["event"] == "frame" for line in logged)
    print(f"{options.rate:g} pulses/s for {wall:.1f} s{', decoding live' if options.live else ''}")
    print(f"  exposed {n_exposed}, recorded {summary.n_frames}, logged {kept}, bursts thrown away {summary.n_rejected}")
    if summary.n_rejected:
        print(f"  the last because of: {last[0].note}")
    print(f"  {summary.n_frames / wall:.1f} frames/s whole and recorded, {size / raw:.2f} of their size")
    print(
        f"  this process took {cpu / wall:.2f} cores; memory {resident[0]:.0f} MB at first, {resident[-1]:.0f} at last"
    )
    if latencies:
        print(f"  strobe to range image: median {1e3 * float(np.median(latencies)):.0f} ms")


if __name__ == "__main__":
    main()
