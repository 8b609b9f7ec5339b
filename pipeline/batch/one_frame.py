"""One frame, decoded into a folder with its mesh, pictures and report: a picture, or one that is simulated."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.calibration import Calibration
from pipeline.decoder import Decoder
from pipeline.decoding.footage_light import with_transfer_of
from pipeline.decoding.frame import DecodedFrame
from pipeline.errors import FootageError, RenderError
from pipeline.footage.footage import BadFrame, StoredAs
from pipeline.footage.opening import open_footage
from pipeline.output.folder import output_folder, write_frame
from pipeline.output.range_image import write_png
from pipeline.output.render import render_mesh
from pipeline.output.report import frame_report, measure_against_truth
from pipeline.output.surface_mesh import MeshOptions, frame_mesh
from pipeline.settings import DecodeSettings
from pipeline.simulation import SimulationSettings, own_calibration, simulate_frame, simulated_truth
from tikernels import runtime
from tikernels.raw.development import develop


def decode_picture(
    picture: Path,
    out: str | Path,
    settings: DecodeSettings,
    calibration: Calibration | None,
    stored_as: StoredAs,
    arch: str,
    part: MeshOptions | None,
    *,
    force: bool,
    notify: Callable[[str], None],
    remark: Callable[[str], None] = lambda line: None,
) -> tuple[DecodedFrame, tuple[str, ...]]:
    """Decode a picture, and write all results of a single frame.

    Parameters
    ----------
    picture : Path
        Its file.
    out : str or Path
        Output folder.
    settings : DecodeSettings
        Settings of the decoding.
    calibration : Calibration or None
        The rig.
    stored_as : StoredAs
        Properties of its pixels that the file does not state.
    arch : str
        The device.
    part : MeshOptions or None
        Options of its mesh; None: no mesh.
    force : bool
        True if the folder may hold other things.
    notify : callable
        Called with each step.
    remark : callable
        Called with each line that the user should know before it is written.

    Returns
    -------
    DecodedFrame
        The frame that is written.
    tuple of str
        Notes about content of the file that is not used.

    Raises
    ------
    FootageError
        The picture cannot be read, or shows nothing that can be measured.
    OutputError
        The folder holds something else, or cannot be written.
    DeviceNotReady, CalibrationError, ShapeError
        See `Decoder`.
    """
    with output_folder(out, force=force) as folder:
        notify("reading")
        source = open_footage(picture, **vars(stored_as))
        settings, transfer_because = with_transfer_of(source, settings, calibration)
        (stored,) = source.frames()
        if isinstance(stored, BadFrame):
            raise FootageError(stored.reason)
        notify("compiling kernels, and decoding {}x{} px".format(*source.size_px))
        decoder = Decoder(settings, calibration, arch=arch)
        frame = decoder.decode(develop(stored.planes, stored.format, stripes=settings.stripes))
        if not frame.mask.any():  # a warning states why
            raise FootageError(f"nothing was measured in {picture.name}, so nothing is written")
        report = frame_report(frame, picture.name)
        report["transfer_because"] = transfer_because
        write_frame(folder, frame, report, part, notify, remark)
        notify(f"moving all into {out}")
    return frame, source.notes


@dataclass(frozen=True)
class SimulatedResult:
    """Results of a simulated frame."""

    measured: dict[str, float | int]  # against the truth; see `measure_against_truth`
    picture: Path  # of the surface
    notes: tuple[str, ...]


def decode_simulated(out: Path, arch: str, *, force: bool, notify: Callable[[str], None]) -> SimulatedResult:
    """Simulate a frame of a portrait, decode it with the calibration that the rig has found, draw and measure it.

    Parameters
    ----------
    out : Path
        Output folder.
    arch : str
        The device.
    force : bool
        True if the folder may hold other things.
    notify : callable
        Called with each step.

    Raises
    ------
    DeviceNotReady
        The machine lacks the arch.
    OutputError
        The folder holds something else, or cannot be written.
    """
    notes: tuple[str, ...] = ()
    with output_folder(out, force=force) as folder:
        notify("simulating one colour frame")
        runtime.init(arch)
        # As a camera and a projector see it: pixels with an area, and a lens that blurs.
        blur_px = (0.6, 0.6, 0.6)
        simulation = SimulationSettings(scene="portrait", object_turn_deg=4.0, pixel_rays=3, projector_blur_px=blur_px)
        truth = simulate_frame(simulated_truth(), simulation)
        calibration = own_calibration()
        notify("decoding it")
        settings = DecodeSettings()
        frame = Decoder(settings, calibration, arch=arch).decode(truth.image)
        notify("measuring it")
        measured = measure_against_truth(frame, truth)
        report = {**frame_report(frame, "simulated portrait"), "against_truth": measured}
        write_png(folder / "frame.png", np.asarray(truth.image, np.uint8))
        calibration.write(folder / "calibration.json")
        write_frame(folder, frame, report, notify=notify)
        picture = out / "render.png"
        notify("drawing the mesh")
        try:
            render_mesh(frame_mesh(frame, MeshOptions(without_background=True)), folder / "render.png")
        except RenderError as error:
            notes = (str(error),)
            picture = out / "shaded.png"
    return SimulatedResult(measured, picture, notes)
