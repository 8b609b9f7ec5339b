"""Whether a rig is still as it was calibrated, from files: one picture, frames in a row, or the captures of a pose."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.calibration.captures import CapturedFolder, captured_files, refuse_other_camera
from pipeline.calibration.model import Calibration
from pipeline.calibration.multishot import WHITE, multishot_sequence
from pipeline.decoder import Decoder
from pipeline.decoding.frame import DecodedFrame
from pipeline.diagnosis.check_result import CheckResult
from pipeline.diagnosis.corrected_light import correct_light
from pipeline.diagnosis.epipolar_check import check_epipolar
from pipeline.diagnosis.expected_light import KnownLight
from pipeline.diagnosis.frame_sequence import MIN_FRAMES, SequenceDiagnosis, diagnose_sequence
from pipeline.diagnosis.ripple import Diagnosis, diagnose
from pipeline.diagnosis.surface_check import Shape, check_surface
from pipeline.errors import CalibrationError, FootageError
from pipeline.footage.source import BadFrame, Source
from pipeline.models import ImageArray
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.lateral_color import align_channels
from tikernels.raw.linearization import WHITE_LEVELS, Transfer, linearize


def holds_captures(folder: Path) -> bool:
    """Return whether a folder holds the captures that geometry is measured from."""
    return WHITE in captured_files(folder)


def check_captures(folder: Path, calibration: Calibration, settings: DecodeSettings) -> CheckResult:
    """Measure the epipolar error from captures of anything that holds still; see `check_epipolar`."""
    names = multishot_sequence(calibration.geometry().projector.size_px).names
    return check_epipolar(CapturedFolder(folder, names), calibration, str(folder), settings.white_level)


@dataclass(frozen=True)
class PictureCheck:
    """What one picture of a smooth surface tells."""

    surface: CheckResult | None  # beside a perfect plane or ball, where the picture shows one
    diagnosis: Diagnosis
    calibration: Calibration
    transfer: Transfer  # by which the levels were read
    light: ImageArray  # (H, W, 3) levels, colours aligned
    white_level: float
    frame: DecodedFrame

    def corrected(self) -> Calibration:
        """Return the calibration with what the picture tells of the light; see `correct_light`."""
        return correct_light(self.calibration, self.diagnosis, self.light, self.white_level, self.frame, self.transfer)


def check_picture(
    source: Source,
    calibration: Calibration,
    settings: DecodeSettings,
    arch: str = "auto",
    shape: Shape | None = None,
    radius_mm: float | None = None,
) -> PictureCheck | None:
    """Decode a picture of a smooth surface, and say why it is wavy.

    Parameters
    ----------
    source : Source
        The picture, opened.
    calibration : Calibration
        The one in doubt.
    settings : DecodeSettings
        How to decode, as `with_transfer_of` completes them for this picture.
    arch : str
        Where to compute.
    shape : {"plane", "ball"}, optional
        What was captured, to be compared with a perfect one.
    radius_mm : float, optional
        The ball's true radius.

    Returns
    -------
    PictureCheck or None
        None: no fringe was found, and a warning has said why.

    Raises
    ------
    FootageError
        The picture cannot be read, or there are several.
    CalibrationError
        It is of another camera, or shows nothing of that shape.
    """
    if len(source) != 1:
        raise FootageError(f"{source.name} holds {len(source)} frames: give one picture, or a folder of frames")
    reader = _Reader(source, calibration, settings, arch)
    ((image, frame),) = reader.frames()
    if not frame.mask.any():
        return None
    surface = None if shape is None else check_surface(frame, calibration, shape, radius_mm)
    shift = calibration.color_shift_px
    light = image if shift is None else runtime.to_host(align_channels(image, shift.camera))
    white = settings.white_level or WHITE_LEVELS[image.dtype.name]
    known = KnownLight.of(settings, calibration)
    found = diagnose(light, white, frame.unwrapped_phase, frame.mask, known, reader.transfer, frame.absolute)
    return PictureCheck(surface, found, calibration, reader.transfer, light, white, frame)


def check_sequence(
    source: Source, calibration: Calibration, settings: DecodeSettings, arch: str = "auto"
) -> tuple[int, SequenceDiagnosis]:
    """Say what frames, one after another, show of beat and motion; and how many frames there are.

    Raises
    ------
    FootageError
        A frame cannot be read.
    CalibrationError
        There are too few, or they are of another camera.
    """
    if len(source) < MIN_FRAMES:
        raise CalibrationError(
            f"{source.name} holds {len(source)} pictures: at least {MIN_FRAMES} frames in a row tell anything"
        )
    reader = _Reader(source, calibration, settings, arch)
    light: list[ImageArray] = []
    phases, masks = [], []
    for image, frame in reader.frames():
        light.append(runtime.to_host(linearize(image, reader.transfer, settings.white_level)))
        phases.append(frame.unwrapped_phase)
        masks.append(frame.mask)
    place = calibration.geometry() if calibration.has_geometry else None
    return len(source), diagnose_sequence(light, 1.0, phases, masks, place, calibration.crosstalk_matrix)


class _Reader:
    """Reads frames and decodes them; what the settings leave open, the calibration says."""

    def __init__(self, source: Source, calibration: Calibration, settings: DecodeSettings, arch: str) -> None:
        refuse_other_camera(calibration, source.size_px, source.name)
        if calibration.pattern is not None and "stripes" not in settings.model_fields_set:
            settings = settings.model_copy(update={"stripes": calibration.pattern.stripes})
        at_calibration = None if calibration.capture is None else calibration.capture.transfer
        self.transfer: Transfer = settings.transfer or "linear"
        if settings.transfer is None and at_calibration is not None:
            self.transfer = at_calibration
        self._source, self._stripes = source, settings.stripes
        self._decoder = Decoder(settings, calibration, arch=arch)

    def frames(self) -> Iterator[tuple[ImageArray, DecodedFrame]]:
        for stored in self._source.frames():
            if isinstance(stored, BadFrame):
                raise FootageError(stored.reason)
            image = runtime.to_host(develop(stored.planes, stored.format, stripes=self._stripes))
            yield image, self._decoder.decode(image)
