"""A simulated camera, whose automatics and processing may change its picture."""

from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from tikernels.raw.linearization import srgb_values

# Automatic exposure aims at this mean of a frame, of full scale, and reaches it with this time constant, as automatic
# white balance does; both change the picture by at most these factors.
_AIM, _SETTLES_S, _MOST_GAIN, _MOST_BALANCE = 0.3, 0.2, 4.0, 2.0
# Mean of a frame without light, for ratios.
_LEAST_MEAN = 1e-6
# Sharpening and the S-curve: sigma of the unsharp mask, px.
_MASK_PX = 1.0

_Light = npt.NDArray[np.float32]


@dataclass(frozen=True)
class CameraFaults:
    """The processing of the simulated camera."""

    auto_exposure: bool = False
    auto_white_balance: bool = False
    curve: Literal["linear", "srgb", "s"] = "linear"
    curve_strength: float = 1.0  # of the S-curve: 1 is a smoothstep, 0 is linear
    sharpening: float = 0.0  # amount of the unsharp mask
    jpeg_quality: int | None = None
    chroma: Literal["replicated", "interpolated"] | None = None  # 4:2:0, and how it is brought back to full size
    black_levels: float = 0.0  # level of no light, of 255; below zero it is clipped
    blur_px: float = 0.0  # sigma of the defocused lens


#: `[camera] serial` of a rig file that makes the simulated camera a webcam.
WEBCAM_NAME = "webcam"
#: What that does: sRGB, mild sharpening, and MJPEG with colour at half the resolution.
WEBCAM = CameraFaults(curve="srgb", sharpening=0.3, chroma="interpolated", jpeg_quality=90)


class SimulatedCamera:
    """The way from light to levels.

    Parameters
    ----------
    faults : CameraFaults
        Faults of the camera.
    noise : float
        Standard deviation, of 255 levels.
    rng : Generator
        Of the noise.
    """

    def __init__(self, faults: CameraFaults, noise: float, rng: np.random.Generator) -> None:
        self._faults, self._noise, self._rng = faults, noise, rng
        self._series = np.zeros(0, np.float32)
        self._gains = np.ones(3)  # of the automatics
        self._time_s: float | None = None

    def develop(self, light: _Light, time_s: float) -> npt.NDArray[np.uint8]:
        """Return the frame, (H, W, 3), of light, 1 at full scale, that was exposed at a time."""
        faults = self._faults
        if faults.blur_px:
            light = np.asarray(cv2.GaussianBlur(light, (0, 0), faults.blur_px), np.float32)
        if faults.auto_exposure or faults.auto_white_balance:
            self._adapt(light.mean(axis=(0, 1), dtype=np.float64), time_s)
            light = light * self._gains.astype(np.float32)
        values = light + np.float32(faults.black_levels / 255)
        values += np.float32(self._noise / 255) * self._drawn(light.shape)
        values = _curved(values, faults.curve, faults.curve_strength)
        if faults.sharpening:
            values = np.clip(values, 0, 1)
            values += np.float32(faults.sharpening) * (values - cv2.GaussianBlur(values, (0, 0), _MASK_PX))
        levels = np.clip(np.rint(255 * values), 0, 255).astype(np.uint8)
        in_jpeg = faults.chroma == "interpolated" and faults.jpeg_quality is not None
        if faults.chroma is not None and not in_jpeg:
            levels = _subsampled(levels, faults.chroma)
        if faults.jpeg_quality is not None:
            levels = _compressed(levels, faults.jpeg_quality, subsampled=in_jpeg)
        return levels

    def _drawn(self, shape: tuple[int, ...]) -> _Light:
        """Return noise: a part of a long series, which begins anywhere."""
        size = int(np.prod(shape))
        if len(self._series) < 2 * size:
            self._series = self._rng.standard_normal(3 * size, dtype=np.float32)
        begin = int(self._rng.integers(len(self._series) - size))
        return self._series[begin : begin + size].reshape(shape)

    def _adapt(self, means: npt.NDArray[np.float64], time_s: float) -> None:
        """Bring the automatics' gains nearer to those that the present light calls for."""
        aims = np.ones(3)
        if self._faults.auto_exposure:
            aims *= np.clip(_AIM / max(means.mean(), _LEAST_MEAN), 1 / _MOST_GAIN, _MOST_GAIN)
        if self._faults.auto_white_balance:
            aims *= np.clip(means[1] / np.maximum(means, _LEAST_MEAN), 1 / _MOST_BALANCE, _MOST_BALANCE)
        passed_s = np.inf if self._time_s is None else time_s - self._time_s
        self._gains += (aims - self._gains) * (1 - np.exp(-passed_s / _SETTLES_S))
        self._time_s = time_s


def _curved(values: _Light, curve: str, strength: float) -> _Light:
    if curve == "linear":
        return values
    values = np.clip(values, 0, 1)
    if curve == "srgb":
        return np.asarray(_srgb()[(values * 65535).astype(np.uint16)])
    return np.asarray(values + np.float32(strength) * (values**2 * (3 - 2 * values) - values), np.float32)


@cache
def _srgb() -> _Light:
    """Return the sRGB value of each of 65536 steps of light (IEC 61966-2-1)."""
    return srgb_values(np.linspace(0, 1, 65536, dtype=np.float32))


def _subsampled(levels: npt.NDArray[np.uint8], way: str) -> npt.NDArray[np.uint8]:
    """Return levels whose chroma has half the resolution, both ways."""
    planes = cv2.cvtColor(levels, cv2.COLOR_RGB2YCrCb)
    height, width = levels.shape[:2]
    small = cv2.resize(planes[..., 1:], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    back = cv2.INTER_NEAREST if way == "replicated" else cv2.INTER_LINEAR
    planes[..., 1:] = cv2.resize(small, (width, height), interpolation=back)
    return np.asarray(cv2.cvtColor(planes, cv2.COLOR_YCrCb2RGB), np.uint8)


def _compressed(levels: npt.NDArray[np.uint8], quality: int, *, subsampled: bool) -> npt.NDArray[np.uint8]:
    """Return what JPEG leaves of levels, its chroma at full resolution or at half, both ways."""
    chroma = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420 if subsampled else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    how = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, chroma]
    stored = cv2.imencode(".jpg", levels[..., ::-1], how)[1]
    return np.ascontiguousarray(np.asarray(cv2.imdecode(stored, cv2.IMREAD_COLOR), np.uint8)[..., ::-1])
