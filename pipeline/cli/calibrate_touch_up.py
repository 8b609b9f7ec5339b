"""`colorphase calibrate touch-up`."""

from pathlib import Path

from pipeline.calibration.model import Calibration
from pipeline.cli.console import Arch, NewCalibration, Replace, SettingsFile, check_target, read_settings, say


def touch_up(
    picture: Path,
    /,
    *,
    before: Path,
    calibration: Path,
    out: NewCalibration = None,
    settings: SettingsFile = None,
    arch: Arch = "auto",
    force: Replace = False,
) -> None:
    """Take out of a calibration how far the projector has turned, and its lens has grown, since it was made.

    Take a picture of a sheet, or of a strip at the side that stays in view, when the rig is calibrated, and one more
    whenever it may have drifted: neither may move against the camera in between.

    Example: colorphase calibrate touch-up now.png --before calibrated.png --calibration calibration.json --out new.json

    Parameters
    ----------
    picture
        Taken now, under the pattern.
    before
        The picture of the same thing, taken when the calibration was right.
    calibration
        The calibration that both are decoded with.
    """
    from pipeline.decoding.footage_light import with_transfer_of
    from pipeline.diagnosis.drift import measure_drift
    from pipeline.diagnosis.picture_reader import PictureReader
    from pipeline.footage.opening import open_footage

    if out is not None:
        check_target(out, force=force)
    known = Calibration.read(calibration)
    frames, chosen = [], read_settings(settings)
    for path in (before, picture):
        source = open_footage(path)
        reader = PictureReader.of_one(source, known, with_transfer_of(source, chosen, known)[0], arch)
        frames += [frame for _, frame in reader.frames()]
    found = measure_drift(frames[0], frames[1], known)
    for name, (value, sigma), unit in (
        ("the pattern has moved across the stripes by", found.offset_px, " px"),
        ("turned by", found.roll_deg, " degrees"),
        ("and grown by", (found.scale[0] - 1, found.scale[1]), ""),
    ):
        say(f"{name} {value:+.4f} ± {sigma:.4f}{unit}")
    say(f"depths were off by {found.depth_mm:.2f} mm; {found.left_mm:.2f} mm are left (one standard deviation)")
    if out is not None:
        found.calibration.write(out, force=force)
        say(f"wrote {out}")
