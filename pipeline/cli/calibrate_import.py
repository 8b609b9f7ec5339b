"""`colorphase calibrate import`: calibrations of other programs, and of a camera that is read out otherwise."""

from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from pipeline.calibration.foreign import read_foreign
from pipeline.cli.console import Replace, above_zero, check_target, part_of, say, size_of
from pipeline.cli.project import PatternOptions
from pipeline.errors import SettingsError

_FRINGES = PatternOptions()


def import_calibration(
    file: Path,
    /,
    *,
    out: Path,
    camera_size: str | None = None,
    projector_size: str | None = None,
    mm_per_unit: Annotated[float | None, Parameter(validator=above_zero)] = None,
    fringes: PatternOptions = _FRINGES,
    region: str | None = None,
    binning: str | None = None,
    force: Replace = False,
) -> None:
    """Make a calibration of one by OpenCV, Kalibr or MATLAB, or of one whose camera is now cropped or binned.

    Example: colorphase calibrate import stereo.yml --camera-size 640x480 --projector-size 1024x768 --mm-per-unit 1
    --out calibration.json, or colorphase calibrate import calibration.json --binning 2x2 --out binned.json

    Parameters
    ----------
    file
        OpenCV's YAML or XML, Kalibr's camchain.yaml, or MATLAB's jsonencode(toStruct(stereoParams)), of the camera and
        then the projector; or a calibration.json.
    out
        The calibration to write.
    camera_size
        The camera's width and height in px, where the file does not state them.
    projector_size
        The projector's, likewise.
    mm_per_unit
        The file's unit of length in mm, where it does not state it.
    region
        The part of its sensor that the camera shows now: x,y,width,height in px of the calibration.
    binning
        Number of columns and rows it now joins to one, as in 2x2; after the region.
    """
    check_target(out, force=force)
    camera_px = None if camera_size is None else size_of(camera_size, "--camera-size")
    projector_px = None if projector_size is None else size_of(projector_size, "--projector-size")
    rig = read_foreign(file, fringes.pattern(None), camera_px, projector_px, mm_per_unit)
    if (region or binning) and rig.camera is None:
        raise SettingsError(f"{file} holds no geometry: omit --region and --binning")
    if region is not None and rig.camera is not None:
        x, y, width, height = part_of(region, "--region")
        rig = rig.cropped(x, y, (width, height))
    if binning is not None:
        rig = rig.binned(*size_of(binning, "--binning"))
    if rig.has_geometry:
        rig = fringes.shown_to(rig)
    rig.write(out, force=force)
    if rig.has_geometry:
        geometry = rig.geometry()
        baseline_mm = float(np.linalg.norm(geometry.translation_mm))
        say(
            "camera {}x{}, projector {}x{}, {:.1f} mm apart".format(
                *geometry.camera.size_px, *geometry.projector.size_px, baseline_mm
            )
        )
    say(f"wrote {out}")
