"""Whether a rig is still as it was calibrated, from files: one picture, frames in a row, or the captures of a pose."""

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
from pipeline.diagnosis.frame_sequence import MIN_FRAMES, SequenceDiagnosis, diagnose_sequence
from pipeline.diagnosis.ripple import Diagnosis, diagnose
from pipeline.diagnosis.surface_check import Shape, check_surface
from pipeline.errors import CalibrationError
from pipeline.footage.image_file import read_image
from pipeline.footage.image_folder import natural_key
from pipeline.models import ImageArray
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.raw.lateral_color import align_channels
from tikernels.raw.linearization import WHITE_LEVELS, Transfer, linearize

_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")


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
    path: Path,
    calibration: Calibration,
    settings: DecodeSettings,
    arch: str = "auto",
    shape: Shape | None = None,
    radius_mm: float | None = None,
) -> PictureCheck | None:
    """Decode a picture of a smooth surface, and say why it is wavy.

    Parameters
    ----------
    path : Path
        The picture.
    calibration : Calibration
        The one in doubt.
    settings : DecodeSettings
        How to decode.
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
        The picture cannot be read.
    CalibrationError
        It is of another camera, or shows nothing of that shape.
    """
    reader = _Reader(calibration, settings, arch)
    image, frame = reader.read(path)
    if not frame.mask.any():
        return None
    surface = None if shape is None else check_surface(frame, calibration, shape, radius_mm)
    shift = calibration.color_shift_px
    light = image if shift is None else runtime.to_host(align_channels(image, shift.camera))
    white = settings.white_level or WHITE_LEVELS[image.dtype.name]
    compensated = calibration.pattern is not None and calibration.pattern.compensated is True
    found = diagnose(
        light,
        white,
        frame.unwrapped_phase,
        frame.mask,
        calibration.crosstalk_matrix if settings.crosstalk_matrix is None else settings.crosstalk_matrix,
        reader.transfer,
        None if compensated else calibration.response,
        calibration.projector_lag_rad(),
    )
    return PictureCheck(surface, found, calibration, reader.transfer, light, white, frame)


def check_sequence(
    folder: Path, calibration: Calibration, settings: DecodeSettings, arch: str = "auto"
) -> tuple[int, SequenceDiagnosis]:
    """Say what a folder of frames, one after another, shows of beat and motion; and how many frames there are.

    Raises
    ------
    FootageError
        A frame cannot be read.
    CalibrationError
        There are too few, they differ in size, or are of another camera.
    """
    reader = _Reader(calibration, settings, arch)
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
    paths.sort(key=lambda path: natural_key(path.name))
    if len(paths) < MIN_FRAMES:
        raise CalibrationError(
            f"{folder} holds {len(paths)} pictures: at least {MIN_FRAMES} frames in a row tell anything"
        )
    light: list[ImageArray] = []
    phases, masks = [], []
    for path in paths:
        image, frame = reader.read(path)
        if light and image.shape != light[0].shape:
            raise CalibrationError(f"{path} has another size than the frames before it: give frames of one camera")
        light.append(runtime.to_host(linearize(image, reader.transfer, settings.white_level)))
        phases.append(frame.unwrapped_phase)
        masks.append(frame.mask)
    place = calibration.geometry() if calibration.has_geometry else None
    return len(paths), diagnose_sequence(light, 1.0, phases, masks, place, calibration.crosstalk_matrix)


class _Reader:
    """Read pictures and decode them; what the settings leave open, the calibration says."""

    def __init__(self, calibration: Calibration, settings: DecodeSettings, arch: str) -> None:
        said = settings.model_fields_set
        if calibration.pattern is not None and "stripes" not in said:
            settings = settings.model_copy(update={"stripes": calibration.pattern.stripes})
        at_calibration = None if calibration.capture is None else calibration.capture.transfer
        self.transfer: Transfer = settings.transfer or "linear"
        if settings.transfer is None and at_calibration is not None:
            self.transfer = at_calibration
        self._calibration = calibration
        self._decoder = Decoder(settings, calibration, arch=arch)

    def read(self, path: Path) -> tuple[ImageArray, DecodedFrame]:
        image = read_image(path)
        refuse_other_camera(self._calibration, (image.shape[1], image.shape[0]), str(path))
        return image, self._decoder.decode(image)
