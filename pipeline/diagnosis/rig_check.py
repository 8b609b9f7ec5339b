"""Check that a rig still is as it was calibrated, by one picture, frames in a row, or the captures of a pose.

A picture of a plane or ball is compared with a perfect one, captures of anything that holds still with the rig's
epipolar lines. Where the light is at fault, one frame can correct the calibration.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from pipeline.calibration.captures import CapturedFolder, captured_files
from pipeline.calibration.model import Calibration, Geometry
from pipeline.calibration.multishot import WHITE, decode_multishot, multishot_sequence
from pipeline.causes import Cause
from pipeline.decoder import Decoder
from pipeline.decoding.frame import DecodedFrame
from pipeline.diagnosis.channel_spectra import KnownLight
from pipeline.diagnosis.frame_sequence import MIN_FRAMES, SequenceDiagnosis, diagnose_sequence
from pipeline.diagnosis.picture_reader import PictureReader
from pipeline.diagnosis.ripple import Diagnosis, diagnose, other_transfer
from pipeline.errors import CalibrationError, DecodeWarning
from pipeline.footage.footage import Footage
from pipeline.models import CameraState, FloatArray, ImageArray
from pipeline.robust import fit_plane, fit_sphere, robust_sigma
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.depth.triangulation import triangulate
from tikernels.raw.lateral_color import align_channels
from tikernels.raw.linearization import WHITE_LEVELS, Transfer, linearize

# A measured figure may exceed the predicted one by this factor before the calibration is doubted.
_TOLERANCE = 2.0

#: What each kind of check cannot show.
BLIND_SPOTS = {
    "plane": "a plane stays flat, or nearly, whatever the baseline's length and however the projector turns about the "
    "stripes' direction: a ball of known radius shows that, the captures of calibrate geometry every other turn",
    "ball": "a ball of unknown radius shows no wrong scale: give its radius",
    "epipolar": "epipolar lines do not show the baseline's length, nor a turn of the projector towards the camera or "
    "away from it: a ball of known radius does",
}
Shape = Literal["plane", "ball"]

# A surface this large, px, shows a shape.
_MIN_SURFACE_PX = 2000
# Residuals further out than this many deviations are highlights and rims.
_OUTLIER_SIGMAS = 4.0
# Averages over tiles of this side, px, are free of noise: what is left there is shape.
_TILE_PX = 24
# A surface whose averages deviate from the shape by more than this fraction of its distance is another shape: no rig
# gets that far out of adjustment by itself.
_OTHER_SHAPE = 0.01
# Cycles to either side of the expected order in which a ball is searched for.
_ORDERS = 5
# A deviation from the shape, mm, free of noise, that no calibration promises to be better than.
_SHAPE_FLOOR_MM = 0.1
# A distance to an epipolar line, px, that no calibration promises to be better than.
_FLOOR_PX = 0.1


@dataclass(frozen=True)
class Measure:
    """One figure of a check."""

    name: str
    measured: float
    predicted: float  # what the calibration and the frame's noise lead one to expect
    unit: str

    @property
    def fine(self) -> bool:
        """True where it is within twice the prediction."""
        return abs(self.measured) <= _TOLERANCE * self.predicted


@dataclass(frozen=True)
class CheckResult:
    """Result of a check."""

    measures: tuple[Measure, ...]
    position_mm: tuple[float, float, float] | None  # a ball's centre, or the plane's point on the camera's axis
    radius_mm: float | None  # a ball's
    blind_spot: str = ""  # what this shape cannot show, and what does

    @property
    def fine(self) -> bool:
        """True where every figure is within twice its prediction; if not, calibrate again."""
        return all(measure.fine for measure in self.measures)


def check_surface(
    frame: DecodedFrame, calibration: Calibration, shape: Shape, radius_mm: float | None = None
) -> CheckResult:
    """Compare a decoded plane or ball with a perfect one.

    Parameters
    ----------
    frame : DecodedFrame
        Decoded with the calibration.
    calibration : Calibration
        The one to check.
    shape : {"plane", "ball"}
        The captured shape: the largest surface in view for a plane, the one nearest to a ball for a ball.
    radius_mm : float, optional
        The ball's true radius.

    Raises
    ------
    CalibrationError
        No surface is large enough or of that shape, or the calibration holds no geometry.
    """
    if radius_mm is not None and not radius_mm > 0:
        raise CalibrationError(f"the ball's radius is given as {radius_mm:g} mm: measure it")
    geometry = calibration.geometry()
    if frame.points is None or frame.point_sigma is None:
        raise CalibrationError("the frame was decoded without this calibration: decode it with it")
    surfaces = [n for n, size in enumerate(np.bincount(frame.region.ravel())) if n > 0 and size >= _MIN_SURFACE_PX]
    if not surfaces:
        raise CalibrationError(f"no surface of {_MIN_SURFACE_PX} px is in view: fill the picture with the {shape}")
    placed = {0: frame.points}
    if shape == "ball":
        # Where orders are not absolute, a surface's is a guess; a ball of the right radius, or else the roundest one,
        # determines it.
        rays, projector = geometry.camera.rays(), geometry.for_triangulation()
        for cycles in range(-_ORDERS, _ORDERS + 1):
            phase = frame.unwrapped_phase + np.float32(2 * np.pi * cycles)
            placed[cycles] = runtime.to_host(triangulate(phase, rays, projector))
    fits = [
        fit
        for n in (surfaces if shape == "ball" else surfaces[:1])
        for cycles, points in placed.items()
        if cycles == 0 or not frame.absolute[frame.region == n].any()
        if (fit := _fit_shape(points, frame.point_sigma, frame.region == n, shape)) is not None
    ]
    if not fits:
        raise CalibrationError(f"no surface is large enough to show a {shape}: fill the picture with it")
    if shape == "ball":
        # A wall behind the ball fits a huge one.
        known = [fit for fit in fits if fit.radius is not None and 5 < fit.radius < 1000]
        if not known:
            raise CalibrationError("no surface in view is a ball: show it alone, before something far or dark")
        fits = sorted(known, key=lambda fit: fit.spread if radius_mm is None else abs((fit.radius or 0) - radius_mm))
    best = fits[0]
    coarse, distance = float(np.sqrt(np.mean(best.coarse**2))), float(np.linalg.norm(best.position))
    if coarse > _OTHER_SHAPE * distance:
        off = f"the surface is {coarse:.1f} mm from the nearest {shape}, more than a rig gets out of adjustment"
        raise CalibrationError(Cause("other shape", f"{off}: show a {shape} alone"))
    bias = _predicted_bias(calibration)
    noise = float(np.sqrt(np.mean(best.sigma**2)))
    # The words are those of a certificate (`certificate.py`), which has the errors' ranges, too.
    name = "flatness measurement error" if shape == "plane" else "probing error, form"
    measures = [
        Measure("noise of a point", float(np.sqrt(np.mean(best.fine**2))), noise, "mm"),
        Measure(f"{name}, trueness", coarse, float(np.hypot(_SHAPE_FLOOR_MM, 0.5 * bias)), "mm"),
    ]
    if best.radius is not None and radius_mm is not None:
        # Depth that is off by a part is so for every length.
        expected = np.hypot(_SHAPE_FLOOR_MM, bias * radius_mm / best.position[2])
        size_mm = 2 * (best.radius - radius_mm)  # of the diameter
        measures.append(Measure("probing error, size", size_mm, 2 * float(expected), "mm"))
    x, y, z = (float(value) for value in best.position)
    blind_spot = BLIND_SPOTS[shape] if radius_mm is None or shape == "plane" else ""
    return CheckResult(tuple(measures), (x, y, z), best.radius, blind_spot)


@dataclass(frozen=True)
class _ShapeFit:
    """A shape laid through a surface."""

    position: FloatArray  # (3,) mm
    radius: float | None
    sigma: FloatArray  # (N,) mm, predicted, across the surface
    fine: FloatArray  # (N,) mm, residuals without what is smooth
    coarse: FloatArray  # (B,) mm, their averages over tiles
    spread: float  # mm, RMS of all


def _fit_shape(
    all_points: npt.NDArray[np.float32],
    point_sigma: npt.NDArray[np.float32],
    surface: npt.NDArray[np.bool_],
    shape: Shape,
) -> _ShapeFit | None:
    """Lay a shape through a surface; None where too little of it is in front of the camera, or in one piece."""
    surface = surface & np.isfinite(all_points[..., 2])
    points, sigma = all_points[surface].astype(np.float64), point_sigma[surface].astype(np.float64)
    if len(points) < _MIN_SURFACE_PX // 2:
        return None
    if shape == "plane":
        middle, normal = fit_plane(points)
        residual, towards = (points - middle) @ normal, np.broadcast_to(normal, points.shape)
        position, radius = np.array([0.0, 0.0, middle @ normal / normal[2]]), None
    else:
        sphere = fit_sphere(points)
        if sphere is None:
            return None
        position, radius = sphere
        distance = np.linalg.norm(points - position, axis=1)
        residual, towards = distance - radius, (points - position) / distance[:, None]
    keep = np.abs(residual) <= max(_OUTLIER_SIGMAS * robust_sigma(residual), 1e-6)
    # A point moves along its ray; across the surface it moves by the cosine.
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    across = sigma * np.abs((rays * towards).sum(axis=1))
    y, x = (place[keep] for place in np.nonzero(surface))
    tile = (y // _TILE_PX) * (1 + x.max() // _TILE_PX) + x // _TILE_PX
    counts = np.bincount(tile)
    means = np.bincount(tile, residual[keep]) / np.maximum(counts, 1)
    whole = counts > 0.5 * _TILE_PX**2
    if not whole.any():
        return None
    inside = whole[tile]
    return _ShapeFit(
        position=position,
        radius=radius,
        sigma=across[keep][inside],
        fine=(residual[keep] - means[tile])[inside],
        coarse=means[whole],
        spread=float(np.sqrt(np.mean(residual[keep] ** 2))),
    )


def _predicted_bias(calibration: Calibration) -> float:
    if calibration.uncertainty is None or calibration.uncertainty.depth_bias_mm is None:
        return 0.0
    return calibration.uncertainty.depth_bias_mm


def check_epipolar(
    captures: Mapping[str, ImageArray],
    calibration: Calibration,
    where: str = "captures",
    white_level: float | None = None,
) -> CheckResult:
    """Measure how far projector pixels lie from the epipolar lines of the camera pixels that see them.

    Parameters
    ----------
    captures : mapping from name to (H, W, 3)
        The captures of `multishot_sequence`, of anything that holds still.
    calibration : Calibration
        The one to check.
    where : str
        Name for messages.
    white_level : float, optional
        Full scale; None: the type's.

    Raises
    ------
    CalibrationError
        The captures cannot be decoded, are of another size, or camera and projector are swapped.
    """
    geometry = calibration.geometry()
    height, width = next(iter(captures.values())).shape[:2]
    geometry.check_frame((width, height), where)
    seen = decode_multishot(captures, geometry.projector.size_px, where, white_level)
    known = ~np.isnan(seen.position_px[..., 0])
    uncertainty = calibration.uncertainty
    rms = (0.0, 0.0) if uncertainty is None or uncertainty.reprojection_px is None else uncertainty.reprojection_px
    predicted = float(np.hypot(_FLOOR_PX, max(rms)))

    def measure(as_if: Geometry) -> Measure:
        error = epipolar_error_px(as_if, np.argwhere(known)[:, ::-1].astype(np.float64), seen.position_px[known])
        return Measure("epipolar error", float(np.nanmedian(np.abs(error))), predicted, "px")

    found = measure(geometry)
    if not found.fine and measure(_swapped(geometry)).fine:
        words = f"{where} fit the calibration with camera and projector swapped in it: calibrate geometry again"
        raise CalibrationError(Cause("swapped", words))
    return CheckResult((found,), None, None, BLIND_SPOTS["epipolar"])


def _swapped(geometry: Geometry) -> Geometry:
    back = geometry.rotation.T
    return Geometry(geometry.projector, geometry.camera, back, -back @ geometry.translation_mm, geometry.pattern)


def epipolar_error_px(geometry: Geometry, camera_px: FloatArray, projector_px: FloatArray) -> FloatArray:
    """Return the distances of projector pixels from the epipolar lines of camera pixels, (N,) px; NaN: no ray.

    Parameters
    ----------
    geometry : Geometry
        The poses of camera and projector.
    camera_px, projector_px : (N, 2)
        x, y of pixels that see each other.
    """
    rays, light = geometry.camera.rays_through(camera_px), geometry.projector.rays_through(projector_px)
    t = geometry.translation_mm / np.linalg.norm(geometry.translation_mm)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    lines = np.insert(rays, 2, 1.0, axis=1) @ (cross @ geometry.rotation).T
    distance = (np.insert(light, 2, 1.0, axis=1) * lines).sum(axis=1) / np.hypot(lines[:, 0], lines[:, 1])
    return np.asarray(distance * np.sqrt(geometry.projector.matrix[0, 0] * geometry.projector.matrix[1, 1]))


def correct_light(
    calibration: Calibration,
    diagnosis: Diagnosis,
    image: ImageArray,
    white_level: float,
    frame: DecodedFrame,
    transfer: Transfer = "linear",
) -> Calibration:
    """Return the calibration with the light that a frame shows in place of its own.

    Crosstalk and response are estimated anew from the frame, where they, or what looks like them, were found at fault.
    The response is that of the pattern as it was projected, so measure the radiometry before making a new pattern. A
    transfer is set. What needs more than a frame (lateral colour, motion, a black level) stays, as the advice states.

    Parameters
    ----------
    calibration : Calibration
        The one at fault.
    diagnosis : Diagnosis
        Findings.
    image : (H, W, 3)
        The image that the frame was decoded from, levels as they came.
    white_level : float
        Full scale.
    frame : DecodedFrame
        The frame, decoded.
    transfer : {"linear", "srgb", "bt709"} or (N,) floats
        By which the levels were read.

    Raises
    ------
    CalibrationError
        Nothing is at fault that a frame could correct, or the frame shows too little.
    """
    if any(finding.causes == ("transfer",) for finding in diagnosis.findings):
        camera = calibration.capture or CameraState()
        changed = camera.replace(transfer=other_transfer(transfer))
        return calibration.replace(capture=changed)
    causes = {cause for finding in diagnosis.findings for cause in finding.causes}
    if not causes & {"response", "crosstalk", "even crosstalk"}:
        raise CalibrationError("no fault was found that one frame can correct: do what the check advises")
    if not isinstance(transfer, str) or transfer != "linear":
        image, white_level = runtime.to_host(linearize(image, transfer, white_level)), 1.0
    decoder = Decoder(DecodeSettings.model_validate({"stripes": frame.settings.stripes, "white_level": white_level}))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecodeWarning)
        decoder.decode(image)
    light = decoder.state.light
    if light is None or not light.reliable:
        raise CalibrationError("the frame shows too little of the light to correct it: capture a larger smooth surface")
    update: dict[str, Any] = {"crosstalk_matrix": light.crosstalk_matrix}
    if "response" in causes or calibration.response is None:
        update["response"] = np.tile(light.response, (3, 1))
        if calibration.pattern is not None:
            # The response that a frame shows is what the pattern has not undone.
            update["pattern"] = calibration.pattern.replace(compensated=False)
    return calibration.replace(**update)


def holds_captures(folder: Path) -> bool:
    """Return whether a folder holds the captures that geometry is measured from."""
    return WHITE in captured_files(folder)


def check_captures(folder: Path, calibration: Calibration, settings: DecodeSettings) -> CheckResult:
    """Measure the epipolar error from captures of anything that holds still; see `check_epipolar`."""
    names = multishot_sequence(calibration.geometry().projector.size_px).names
    captures = CapturedFolder(folder, names)
    height, width = captures[names[0]].shape[:2]
    known = calibration.as_read_out((width, height), captures.sensor, str(folder))
    return check_epipolar(captures, known, str(folder), settings.white_level)


@dataclass(frozen=True)
class PictureCheck:
    """Result of the check of one picture of a smooth surface."""

    surface: CheckResult | None  # compared with a perfect plane or ball, where the picture shows one
    diagnosis: Diagnosis
    calibration: Calibration
    transfer: Transfer  # by which the levels were read
    light: ImageArray  # (H, W, 3) levels, colours aligned
    white_level: float
    frame: DecodedFrame

    def corrected(self) -> Calibration:
        """Return the calibration with the light that the picture shows; see `correct_light`."""
        return correct_light(self.calibration, self.diagnosis, self.light, self.white_level, self.frame, self.transfer)


def check_picture(
    source: Footage,
    calibration: Calibration,
    settings: DecodeSettings,
    arch: str = "auto",
    shape: Shape | None = None,
    radius_mm: float | None = None,
) -> PictureCheck | None:
    """Decode a picture of a smooth surface, and explain why it is wavy.

    Parameters
    ----------
    source : Footage
        The picture, opened.
    calibration : Calibration
        The one to check.
    settings : DecodeSettings
        Settings to decode with, as `with_transfer_of` completes them for this picture.
    arch : str
        Device to compute on.
    shape : {"plane", "ball"}, optional
        The captured shape, to be compared with a perfect one.
    radius_mm : float, optional
        The ball's true radius.

    Returns
    -------
    PictureCheck or None
        None: no fringe was found, and a warning has explained why.

    Raises
    ------
    FootageError
        The picture cannot be read, or there are several.
    CalibrationError
        It is of another camera, or shows nothing of that shape.
    """
    reader = PictureReader.of_one(source, calibration, settings, arch)
    ((image, frame),) = reader.frames()
    if not frame.mask.any():
        return None
    surface = None if shape is None else check_surface(frame, reader.calibration, shape, radius_mm)
    shift = reader.calibration.color_shift_px
    light = image if shift is None else runtime.to_host(align_channels(image, shift.camera))
    white = settings.white_level or WHITE_LEVELS[image.dtype.name]
    known = KnownLight.of(settings, reader.calibration, reader.code)
    found = diagnose(light, white, frame.unwrapped_phase, frame.mask, known, reader.transfer, frame.absolute)
    return PictureCheck(surface, found, calibration, reader.transfer, light, white, frame)


def check_sequence(
    source: Footage, calibration: Calibration, settings: DecodeSettings, arch: str = "auto"
) -> tuple[int, SequenceDiagnosis]:
    """Return how many frames there are, and what they show of beat and motion.

    Raises
    ------
    FootageError
        A frame cannot be read.
    CalibrationError
        There are too few, or they are of another camera.
    """
    if len(source) < MIN_FRAMES:
        raise CalibrationError(
            f"{source.name} holds {len(source)} pictures: at least {MIN_FRAMES} frames in a row are needed"
        )
    reader = PictureReader(source, calibration, settings, arch)
    light: list[ImageArray] = []
    phases, masks = [], []
    for image, frame in reader.frames():
        light.append(runtime.to_host(linearize(image, reader.transfer, settings.white_level)))
        phases.append(frame.unwrapped_phase)
        masks.append(frame.mask)
    place = reader.calibration.geometry() if calibration.has_geometry else None
    return len(source), diagnose_sequence(light, 1.0, phases, masks, place, calibration.crosstalk_matrix)
