"""The main job on a simulated frame, with nothing else needed."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.decoder import Decoder
from pipeline.errors import RenderError
from pipeline.output.folder import output_folder, write_frame
from pipeline.output.range_image import write_png
from pipeline.output.render import render_mesh
from pipeline.output.report import frame_report, measure_against_truth
from pipeline.output.surface_mesh import frame_mesh
from pipeline.settings import DecodeSettings
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime


@dataclass(frozen=True)
class DemoSummary:
    """What the demo measured, ready to be printed."""

    measured: dict[str, str]
    notes: list[str]
    picture: Path


def run_demo(out: Path, arch: str, *, force: bool, step: Callable[[str], None]) -> DemoSummary:
    """Simulate a frame of a bust, decode it with the rig's calibration, draw it, measure it.

    Parameters
    ----------
    out : Path
        Output folder.
    arch : str
        Where to compute.
    force : bool
        Whether the folder may hold other things.
    step : callable
        Told what is being done.

    Raises
    ------
    DeviceNotReady
        The machine lacks the arch.
    OutputError
        The folder holds something else, or cannot be written.
    """
    notes = []
    with output_folder(out, force=force) as folder:
        step("simulating one colour frame")
        runtime.init(arch)
        simulation = SimulationSettings()
        rig = simulated_rig()
        truth = simulate_frame(rig, simulation)
        calibration = rig.model_copy(update={"crosstalk_matrix": simulation.crosstalk_matrix})
        step("decoding it")
        settings = DecodeSettings()
        frame = Decoder(settings, calibration, arch=arch).decode(truth.image)
        step("measuring it")
        measured = measure_against_truth(frame, truth)
        report = {**frame_report(frame, settings, calibration, "simulated bust"), "against_truth": measured}
        step("writing")
        write_png(folder / "frame.png", np.asarray(truth.image, np.uint8))
        calibration.write(folder / "calibration.json")
        write_frame(folder, frame, settings, calibration, report)
        picture = out / "render.png"
        step("drawing the mesh")
        try:
            render_mesh(frame_mesh(frame), folder / "render.png")
        except RenderError as error:
            notes.append(str(error))
            picture = out / "shaded.png"
    summary = {
        "pixels measured (of those well lit)": f"{measured['coverage']:.1%}",
        "phase error, RMS": f"{measured['phase_rms_rad']:.4f} rad",
        "constant phase error": f"{measured['phase_constant_rad']:+.4f} rad",
        "wrong fringe orders inside a surface": f"{measured['wrong_orders']}",
        "depth error, RMS, each surface's order known": f"{measured['depth_rms_mm']:.3f} mm",
    }
    return DemoSummary(summary, notes, picture)
