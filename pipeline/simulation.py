"""Simulated frames with exact truth: a rig, a scene, and everything that goes wrong between projector and camera."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from pipeline.calibration import Calibration, Lens, Pattern
from pipeline.calibration.model import DEFAULT_PERIOD_PX, DEFAULT_PROJECTOR_PX, Geometry, Shift
from pipeline.models import CodeName, Matrix3, Model, NonNegative, Positive
from pipeline.pattern import make_pattern
from tikernels import runtime
from tikernels.raw.linearization import srgb_values
from tikernels.scene import scene_rendering as projection

# A 640 px wide image at this focal length sees 12 px a cycle at the working distance below.
_FOCAL_FRACTION = 1232 / 640
_PROJECTOR_FOCAL_PX = 1792.0
_BASELINE_MM = 180.0
_DISTANCE_MM = 900.0

# k1 k2 p1 p2 k3 of ordinary lenses: a picture's corner lies nearly a hundredth from where a pinhole shows it.
_CAMERA_LENS, _PROJECTOR_LENS = (-0.12, 0.08, 0.001, -0.0008, 0.0), (-0.06, 0.05, -0.001, 0.0005, 0.0)
#: The simulated rig's calibration, as it has found it itself (`tests/benchmarks/simulated_calibration.py`).
OWN_CALIBRATION = Path(__file__).with_name("simulated_calibration.json")

#: Crosstalk of a single-chip projector with a colour camera; camera = matrix @ projector in linear light.
TYPICAL_CROSSTALK = ((0.92, 0.10, 0.02), (0.12, 0.85, 0.16), (0.02, 0.20, 0.90))
SKIN = (0.75, 0.52, 0.42)
WHITE = (0.8, 0.8, 0.8)

Triple = tuple[float, float, float]


class SimulationSettings(Model):
    """The path from the pattern to the frame; the defaults are an ordinary, imperfect rig.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> noisy = colorphase.SimulationSettings(scene="plane", noise_levels=4.0)
    >>> f"{np.nanmedian(colorphase.simulate_frame(rig, noisy).points[..., 2]):.0f} mm"
    '900 mm'
    """

    scene: Literal["bust", "plane", "waves", "objects", "ball", "portrait"] = "bust"
    gamma: Positive = 2.0  # the projector's response: light = code ** gamma
    crosstalk_matrix: Matrix3 = np.array(TYPICAL_CROSSTALK)
    reflectance: Triple = SKIN
    texture: Annotated[float, Field(ge=0, lt=1)] = 0.1  # how far the reflectance varies, as a fraction
    reflectance_bands: Literal["broad", "narrow"] = "broad"  # acts on camera channels, or on projector primaries
    ambient: NonNegative = 0.05  # relative to the projector's white
    exposure: Positive | None = None  # None: the brightest half per cent reaches 0.9 of full scale
    noise_levels: NonNegative = 1.5  # standard deviation, in 1/255 of full scale
    bits: Literal[8, 10, 12, 16] = 8
    transfer: Literal["linear", "srgb"] = "linear"
    projector_blur_px: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)  # sigma for R, G, B
    camera_blur_px: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)
    projector_shift_px: Shift = np.zeros((3, 2))  # lateral colour: x, y of R, G, B
    camera_shift_px: Shift = np.zeros((3, 2))
    pixel_rays: Literal[1, 3, 5] = 1  # along either side of a pixel: with one it sees a point, with more an area
    object_motion_mm: Triple = (0.0, 0.0, 0.0)  # where the objects, but not the wall behind them, have moved to
    object_turn_deg: float = 0.0  # and turned, about an upright axis through them
    field_motion_mm: Triple = (0.0, 0.0, 0.0)  # objects' motion between sequential colour fields
    seed: int = 0


@dataclass(frozen=True)
class SimulatedFrame:
    """One frame and its truth, at the pixel centres; NaN where the camera sees nothing.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> truth = colorphase.simulate_frame(rig)
    >>> truth.image.shape, f"{np.nanmedian(truth.points[..., 2]):.0f} mm"
    ((120, 160, 3), '977 mm')
    """

    rig: Calibration  # what it was taken with
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]  # (H, W, 3) RGB
    white_level: int  # full scale of the image
    phase: npt.NDArray[np.float64]  # (H, W) rad, absolute
    mask: npt.NDArray[np.bool_]  # (H, W) lit by the projector
    points: npt.NDArray[np.float32]  # (H, W, 3) mm, camera frame
    reflectance: npt.NDArray[np.float32]  # (H, W, 3)

    @property
    def fringe_order(self) -> npt.NDArray[np.int32]:
        """(H, W) int32: phase = wrapped phase + 2 pi order; 0 outside the mask."""
        return np.rint(np.where(self.mask, self.phase, 0.0) / (2 * np.pi)).astype(np.int32)


def simulated_rig(
    size_px: tuple[int, int] = (640, 480),
    *,
    period_px: float = DEFAULT_PERIOD_PX,
    stripes: Literal["horizontal", "vertical"] = "horizontal",
    tilt_deg: float = 0.0,
    camera_distortion: tuple[float, ...] = (0.0,) * 5,
    projector_distortion: tuple[float, ...] = (0.0,) * 5,
    code: CodeName | None = None,
) -> Calibration:
    """Return a rig of a camera and a 1024x768 projector, 180 mm apart, both turned to a point 900 mm away.

    Parameters
    ----------
    size_px : (width, height)
        The camera's; its field of view stays, so a 640 px wide image sees about 12 px per cycle.
    period_px : float
        The pattern's period in projector px.
    stripes : {"horizontal", "vertical"}
        The baseline is across them.
    tilt_deg : float
        Rotation of the projector about its own axis, and with it of the stripes.
    camera_distortion, projector_distortion : 4, 5, 8, 12 or 14 floats
        OpenCV's coefficients.
    code : {"contrast", "contrast2"}, optional
        The pattern's code.

    Examples
    --------
    >>> f"{np.linalg.norm(colorphase.simulated_rig().translation_mm):.0f} mm"
    '180 mm'
    """
    width, height = size_px
    focal = _FOCAL_FRACTION * width
    camera = Lens(
        size_px=size_px,
        matrix=np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]),
        distortion=np.array(camera_distortion),
    )
    projector = Lens(
        size_px=DEFAULT_PROJECTOR_PX,
        matrix=np.array([[_PROJECTOR_FOCAL_PX, 0, 511.5], [0, _PROJECTOR_FOCAL_PX, 383.5], [0, 0, 1]]),
        distortion=np.array(projector_distortion),
    )
    centre = np.array([0.0, -_BASELINE_MM, 0.0] if stripes == "horizontal" else [-_BASELINE_MM, 0.0, 0.0])
    forward = np.array([0.0, 0.0, _DISTANCE_MM]) - centre
    forward /= np.linalg.norm(forward)
    if stripes == "horizontal":
        right = np.array([1.0, 0.0, 0.0])
        down = np.cross(forward, right)
    else:
        down = np.array([0.0, 1.0, 0.0])
        right = np.cross(down, forward)
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.stack([right, down, forward])
    return Calibration(
        camera=camera,
        projector=projector,
        rotation=rotation,
        translation_mm=-rotation @ centre,
        pattern=Pattern(period_px=period_px, stripes=stripes),
    ).with_pattern(code=code)


def simulated_truth(code: CodeName | None = "contrast") -> Calibration:
    """Return the true geometry of the simulated rig, by which results are judged, and never decoded."""
    return simulated_rig(camera_distortion=_CAMERA_LENS, projector_distortion=_PROJECTOR_LENS, code=code)


def own_calibration() -> Calibration:
    """Return that rig's calibration as it has found it itself, from pictures of a sheet and a board."""
    return Calibration.read(OWN_CALIBRATION)


def simulate_frame(
    rig: Calibration,
    settings: SimulationSettings | None = None,
    codes: npt.NDArray[np.float32] | None = None,
) -> SimulatedFrame:
    """Photograph a scene under the rig's pattern.

    Parameters
    ----------
    rig : Calibration
        Lenses, geometry and pattern.
    settings : SimulationSettings, optional
        Imperfections on the way.
    codes : (Hp, Wp, 3) float32, optional
        Projector codes, 0..1, to show instead of the rig's pattern.

    Returns
    -------
    SimulatedFrame
        The image, and the truth that it was made from.

    Raises
    ------
    DeviceNotReady
        No device has been started.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> truth = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="ball"))
    >>> f"{np.nanmin(truth.points[..., 2]):.0f} mm"
    '795 mm'
    """
    settings = settings or SimulationSettings()
    runtime.started()
    geometry = rig.geometry()
    if codes is None:
        codes = make_pattern(geometry.projector.size_px, geometry.pattern)
    light = _blur(cv2.pow(codes, settings.gamma), settings.projector_blur_px)
    middle = _rendered(geometry, settings, light, np.zeros(2))
    arrives = middle.light
    if settings.pixel_rays > 1:
        places = (np.arange(settings.pixel_rays) + 0.5) / settings.pixel_rays - 0.5
        for place in np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2):
            if place.any():
                arrives = arrives + _rendered(geometry, settings, light, place).light
        arrives /= settings.pixel_rays**2
    image, white_level = _expose(_blur(arrives, settings.camera_blur_px), settings)
    across = middle.projector_px[..., geometry.phase_axis].astype(np.float64)
    return SimulatedFrame(
        rig=rig,
        image=image,
        white_level=white_level,
        phase=2 * np.pi / geometry.pattern.period_px * across,
        mask=middle.lit != 0,
        points=middle.points,
        reflectance=middle.reflectance,
    )


def _rendered(
    geometry: Geometry, settings: SimulationSettings, light: npt.NDArray[np.float32], place: npt.NDArray[np.float64]
) -> projection.SceneTruth:
    """Render the view along one ray per pixel, this far (px) from its middle."""
    lens = geometry.camera.model_dump_json()
    return projection.render_scene(
        settings.scene,
        np.stack([_rays(lens, *(shift - place)) for shift in _distinct(settings.camera_shift_px)]),
        light,
        crosstalk_matrix=settings.crosstalk_matrix,
        rotation=geometry.rotation,
        translation_mm=geometry.translation_mm,
        projector_matrix=geometry.projector.matrix,
        projector_distortion=geometry.projector.distortion,
        projector_shift_px=settings.projector_shift_px,
        color=settings.reflectance,
        texture=settings.texture,
        ambient=settings.ambient,
        falloff_mm=float(np.hypot(_DISTANCE_MM, _BASELINE_MM)),
        object_motion_mm=settings.object_motion_mm,
        object_turn_deg=settings.object_turn_deg,
        field_motion_mm=settings.field_motion_mm,
        narrow_band=settings.reflectance_bands == "narrow",
    )


@lru_cache(maxsize=9)  # of three rays along either side of a pixel
def _rays(lens: str, x_px: float, y_px: float) -> npt.NDArray[np.float32]:
    """Return where every pixel of a lens looks, shifted; frames of one rig share it."""
    return Lens.model_validate_json(lens).rays(np.array([x_px, y_px]))


def _distinct(shift_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return one shift for each of the camera's channels, or a single one where they all agree."""
    return shift_px if np.any(shift_px != shift_px[0]) else shift_px[:1]


def _blur(image: npt.NDArray[np.float32], sigma_px: Triple) -> npt.NDArray[np.float32]:
    if not any(sigma_px):
        return image
    channels = [
        cv2.GaussianBlur(np.ascontiguousarray(image[..., i]), (0, 0), sigma) if sigma > 0 else image[..., i]
        for i, sigma in enumerate(sigma_px)
    ]
    return np.ascontiguousarray(np.stack(channels, axis=-1), dtype=np.float32)


def _expose(
    light: npt.NDArray[np.float32], settings: SimulationSettings
) -> tuple[npt.NDArray[np.uint8] | npt.NDArray[np.uint16], int]:
    exposure = settings.exposure
    if exposure is None:
        exposure = 0.9 / max(float(np.quantile(light, 0.995)), 1e-6)
    noise = np.random.default_rng(settings.seed).standard_normal(light.shape, dtype=np.float32)
    signal = np.clip(exposure * light + settings.noise_levels / 255 * noise, 0, 1)
    if settings.transfer == "srgb":
        signal = srgb_values(signal)
    white_level = 2**settings.bits - 1
    levels = np.rint(signal * white_level)
    return (levels.astype(np.uint8) if settings.bits == 8 else levels.astype(np.uint16)), white_level
