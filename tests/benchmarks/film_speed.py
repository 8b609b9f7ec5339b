"""Films of full frames, off screen: python tests/benchmarks/film_speed.py [PICTURES [COLORS]], 96 and clay by default.

A store of 640x480 frames of a bust before a wall, some 300,000 vertices each, becomes an MP4 file of 1280x960. Said are
pictures a second, without the first ones (a process compiles its kernels before), the CPU time of a picture, and the
memory of each process that draws, at a quarter of the film and at its end. Linux only, for its `/proc`.
"""

import resource
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import _tests_path  # noqa: F401 - puts support on the path
import numpy as np

from pipeline import Decoder
from pipeline.output.film import render_film
from pipeline.output.pictures.drawing_process import PictureOptions
from pipeline.output.store import ResultStore, chosen_fields
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

FIELDS = ("mask", "modulation", "phase_sigma", "range_image", "points", "point_sigma", "texture")
#: Frames that differ; the film repeats them.
DIFFERENT = 4


def main() -> None:
    """Make a store, draw it, and say how fast."""
    n_pictures = int(sys.argv[1]) if len(sys.argv) > 1 else 96
    options = PictureOptions.model_validate({"colors": sys.argv[2] if len(sys.argv) > 2 else "clay", "sway_deg": 20.0})
    with tempfile.TemporaryDirectory() as name:
        location = Path(name, "result.zarr")
        vertices = make_store(location, n_pictures)
        times, sizes = [], {}

        def notify(done: int, of: int) -> None:
            times.append((time.perf_counter(), done))
            if done in (of // 4, of - 1):
                sizes[done] = drawing_sizes_mb()

        before = cpu_s()
        made = render_film(location, Path(name, "film.mp4"), options, notify=notify)
        size_mb = Path(name, "film.mp4").stat().st_size / 1e6
    # The first of each process is drawn after its kernels are compiled.
    (start_s, first), (end_s, last) = times[3], times[-1]
    print(f"{n_pictures} pictures of {vertices} vertices, {made.renderer}, {made.codec}, {size_mb:.1f} MB")
    print(f"{(last - first) / (end_s - start_s):.2f} pictures a second (goal: 6)")
    print(f"{(cpu_s() - before) / n_pictures:.3f} s of CPU time a picture, start and compiling included")
    for done, megabytes in sizes.items():
        print(f"memory after picture {done}: {' '.join(f'{size:.0f}' for size in megabytes)} MB a process")


def make_store(location: Path, n_frames: int) -> int:
    """Write a store of decoded frames, some of them again and again, and return how many pixels are measured."""
    runtime.init("cpu")
    rig = simulated_rig(code="contrast")
    frames = []
    for number in range(DIFFERENT):
        light = SimulationSettings(seed=number, object_motion_mm=(3.0 * number, 0.0, 0.0))
        calibration = rig.model_copy(update={"crosstalk_matrix": light.crosstalk_matrix})
        frame = Decoder(calibration=calibration, arch="cpu").decode(simulate_frame(rig, light).image)
        frames.append(SimpleNamespace(**{name: getattr(frame, name) for name in (*FIELDS, "calibrated", "warnings")}))
    fields = chosen_fields(FIELDS, in_mm=True)
    identity = {"colorphase_version": "1", "settings": {}, "step": 1, "range_unit": "mm"}
    height, width = frames[0].mask.shape
    store = ResultStore.make(location, identity, fields, n_frames, (width, height))
    for number in range(n_frames):
        frame = frames[number % DIFFERENT]
        frame.period_px, frame.noise_levels, frame.constant_known = 12.0, 1.0, True
        store.commit([store.write(number, frame)])
    return int(np.mean([frame.mask.sum() for frame in frames]))


def drawing_sizes_mb() -> list[float]:
    """Return the memory of each process that draws, MB."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if b"drawing_child" in (folder / "cmdline").read_bytes():
                found.append(int((folder / "statm").read_text().split()[1]) * resource.getpagesize() / 1e6)
        except OSError:  # it has ended
            continue
    return found


def cpu_s() -> float:
    """Return the CPU time of this process and of those that it has waited for."""
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


if __name__ == "__main__":
    main()
