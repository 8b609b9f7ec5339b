"""Turn one colour frame into phase, orders and points."""

import sys
import warnings
from typing import Any

import numpy as np

from pipeline.calibration import Calibration, Geometry
from pipeline.decoding.frame import DecodedFrame
from pipeline.decoding.light_path import LightPath
from pipeline.decoding.self_calibration import LightEstimate, estimate_light
from pipeline.decoding.workspace import Workspace
from pipeline.errors import CalibrationError, DecodeWarning, FootageError, SettingsError
from pipeline.orders.order_finder import OrderFinder
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.depth.triangulation import triangulate
from tikernels.errors import ShapeError
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.frame_statistics import FrameLevels, FrameStatistics, count_out_of_range, measure_frame
from tikernels.phase.phase_fit import count_phases, fit_phase
from tikernels.phase.smoothing import measure_rates, smooth_phase
from tikernels.raw.lateral_color import align_channels
from tikernels.raw.linearization import WHITE_LEVELS, linearize
from tikernels.transposing import transpose

# Smaller pictures hold no surface.
_MIN_SIZE_PX = 16
# The fringe must stand out of the noise by five standard deviations, where chance makes one pixel in 300,000 valid, and
# reach this fraction of the picture's brightness, below which ambient light and stray light decide.
_MODULATION_SIGMAS = 5.0
_MODULATION_FRACTION = 0.03
_INTENSITY_SIGMAS = 3.0
_INTENSITY_FRACTION = 0.02
# Below this contrast, blur may have turned the fringe over; a sharp pattern in as much other light has a third.
_MIN_CONTRAST = 0.12
# A fringe that differs by more from what the crosstalk makes is more than the leaks of a good calibration are off by.
_MAX_MISMATCH = 0.12
# What the phases of the frames before still count when the response is equalised, from frame to frame.
_MEMORY = 0.9
# Noise below this share of full scale is not to be relied on.
_LEAST_NOISE = 1e-5
# How far a pixel's contrast may be from what its neighbourhood shows, as a standard deviation: it hardly changes within
# a surface, but a code changes it from cycle to cycle, and taken for constant it would bend the phase by 0.02 rad.
_CONTRAST_DOUBT = {None: 0.02, "contrast": 0.08}


class Decoder:
    """Decode frames of one rig, one after another.

    Parameters
    ----------
    settings : DecodeSettings, optional
        How to decode.
    calibration : Calibration, optional
        The rig; with it, results are in mm.
    reference : DecodedFrame, optional
        A frame of a plane, which `range_image` is measured from without a calibration.
    arch : {"auto", "cpu", "vulkan", "cuda", "metal"}
        Where to compute; a named one never falls back.

    Attributes
    ----------
    light : LightEstimate or None
        What the first frame with fringes told of crosstalk and response, where neither settings nor calibration say
        anything of the crosstalk. It is used for that frame and all after it if it is `reliable`.

    Raises
    ------
    DeviceNotReady
        The machine lacks the arch.
    SettingsError, CalibrationError
        Settings and calibration contradict each other.
    """

    light: LightEstimate | None = None

    def __init__(
        self,
        settings: DecodeSettings | None = None,
        calibration: Calibration | None = None,
        reference: DecodedFrame | None = None,
        arch: str = "auto",
    ) -> None:
        self.settings = settings or DecodeSettings()
        self.calibration = calibration
        self._reference = None if reference is None else reference.unwrapped_phase
        self._stripes = self.settings.stripes
        self._path = LightPath(self.settings, calibration)
        self._geometry: Geometry | None = None
        self._rays: Any = None
        if calibration is not None and calibration.has_geometry:
            self._geometry = calibration.geometry()
            self._projector = self._geometry.for_triangulation()
        self._code = self.settings.code
        if calibration is not None and calibration.pattern is not None:
            self._code = calibration.pattern.code
        depth_range_mm = None if calibration is None else calibration.depth_range_mm
        self._orders = OrderFinder(self._code, self._path, self._geometry, depth_range_mm)
        self._workspace: Workspace | None = None
        self._last_buffers: dict[str, Any] = {}
        self.arch = runtime.init(arch)

    def decode(self, image: Any, previous: DecodedFrame | None = None, out: DecodedFrame | None = None) -> DecodedFrame:
        """Decode one frame.

        Parameters
        ----------
        image : (H, W, 3) uint8, uint16 or float32
            RGB, levels from 0 to the white level (floats: 0..1); a NumPy array or a Taichi ndarray.
        previous : DecodedFrame, optional
            The frame before in a video, decoded with the same settings. Region by region its orders are carried on
            where no code tells them, as long as a surface's phase changes by less than a third of a cycle and its edges
            move by less than 10 px; and its phases count when the response is equalised. A frame that shows nothing
            of it again starts afresh, with a `DecodeWarning`.
        out : DecodedFrame, optional
            An earlier result of the same size, whose arrays are used again: what was read from it changes.

        Returns
        -------
        DecodedFrame
            Fresh arrays, or `out`. A frame without fringes gives an empty mask and a `DecodeWarning`.

        Raises
        ------
        ShapeError
            The image has another shape or type, or `previous` or `out` another size.
        CalibrationError
            The calibration is for another image size.
        SettingsError
            `previous` was decoded with stripes the other way.
        FootageError
            The image holds NaN, or values outside 0..white level.
        """
        image, white = self._read_image(image)
        if self._path.camera_shift_px is not None:
            image = align_channels(image, self._path.camera_shift_px)
        vertical = self._stripes == "vertical"
        if vertical:
            image = transpose(image)
        height, width = int(image.shape[0]), int(image.shape[1])
        frame = self._frame(height, width, vertical, out)
        statistics = measure_frame(image, white)
        period = self.settings.camera_period_px or statistics.period_px
        levels = self._levels(statistics, white)
        frame.noise_levels = levels.noise
        frame.period_px = period
        frame.warnings = ()
        frame._constant_sigma = np.nan
        if self._geometry is not None:
            frame._rig = (self._rays, self._projector)
        if statistics.period_px is None:
            self._warn(frame, _no_fringe(image, white, self._stripes))
            period = None
        if period is None:
            self._clear(frame)
            frame._placed = frame._histogram = None
            frame.constant_known = False
            return frame
        if previous is not None:
            self._check_previous(previous, frame)
        # A few per cent of period change nothing; the buffers stay while it drifts.
        period = float(2 ** (np.round(8 * np.log2(period)) / 8))
        work = self._workspace
        if work is None or work.key != (height, width, period):
            work = self._workspace = Workspace(height, width, period, self.settings.unwrap_method)
        doubt = self._run(image, work, levels, period, frame, previous)
        if self._path.unknown:
            self._path.unknown = False
            if self._learn_light(image, levels.white, period, frame):
                # What the first run has said of the code holds; the frame before is gone if `out` was its buffers.
                before = None if out is previous else previous
                again = self._run(image, work, levels, period, frame, before)
                doubt = again or doubt
        if doubt is not None:
            self._warn(frame, doubt)
        self._warn_of_light(frame, work.model)
        frame.constant_known = self._path.constant_known
        return frame

    def _warn_of_light(self, frame: DecodedFrame, model: ChannelModel) -> None:
        """Say where the light is not what decoding takes it for."""
        if model.contrast < _MIN_CONTRAST:
            self._warn(
                frame,
                f"the fringe's contrast is only {model.contrast:.0%}: less motion blur, a sharper focus or less other "
                "light would make it certain",
            )
        if self._path.constant_known and model.mismatch > _MAX_MISMATCH:
            self._warn(
                frame,
                f"the colours' fringes differ by {model.mismatch:.0%} from what the crosstalk matrix makes of them: "
                "calibrate the light anew (colorphase calibrate check says what is wrong)",
            )

    def _check_previous(self, previous: DecodedFrame, frame: DecodedFrame) -> None:
        if previous._vertical != frame._vertical:
            raise SettingsError(f"stripes are {self._stripes}, those of the frame before were not: leave previous away")
        before, here = (tuple(f._buffers["mask"].shape) for f in (previous, frame))
        if before != here:
            turn = -1 if frame._vertical else 1
            raise ShapeError(f"frame is {_size(here[::turn])} but the one before is {_size(before[::turn])}")

    @property
    def asks_for_light(self) -> bool:
        """Whether the next frame with fringes is to tell the light, of which nothing is known."""
        return self._path.unknown

    def use_light(self, light: LightEstimate | None) -> None:
        """Take what another decoder has learnt, instead of asking the first frame; None: nothing could be learnt.

        Then a frame's result does not depend on which frames came before it, but for `previous`.
        """
        self.light = light
        self._path.unknown = False
        self._orders.ask_for_no_code()
        if light is not None and light.reliable:
            self._path.learn(light)

    def _learn_light(self, image: Any, white: float, period: float, frame: DecodedFrame) -> bool:
        """Learn crosstalk and response from a frame that was decoded without; return whether it told them."""
        unwrapped = runtime.to_host(frame._buffers["unwrapped"])  # synchronises
        mask = runtime.to_host(frame._buffers["mask"]) != 0
        try:
            light = estimate_light([runtime.to_host(image)], white, [unwrapped], [mask], period)
        except CalibrationError:
            return False
        if light.reliable:
            self._path.learn(light)
        self.light = light
        return light.reliable

    def _run(
        self,
        image: Any,
        work: Workspace,
        levels: FrameLevels,
        period: float,
        frame: DecodedFrame,
        previous: DecodedFrame | None,
    ) -> str | None:
        """Decode, and return what the user should know of the orders."""
        buffers, path = frame._buffers, self._path
        crosstalk = path.crosstalk
        work.gains.measure(image, crosstalk, levels)
        # `out` may be the frame before.
        earlier = None if previous is None else previous._histogram
        frame._histogram = count_phases(image, work.gains, crosstalk, levels).astype(np.float64)
        work.model.recover_samples(crosstalk, levels)
        if earlier is not None:
            frame._histogram += _MEMORY * earlier
        correction = path.correction(frame._histogram, period)
        work.model.fit(correction, path.template())
        frame._constant_sigma = float(np.hypot(path.constant_sigma, work.model.mismatch))
        out = (work.raw_phase, buffers["modulation"], buffers["precision"])
        doubted = _CONTRAST_DOUBT[self._code]
        fit_phase(image, work.gains, work.model, crosstalk, levels, correction, doubted, out=out)
        pairs = self.settings.smoothing_px // 2
        frame._pairs = pairs
        measure_rates(work.raw_phase, buffers["modulation"], out=work.rates)
        smooth_phase(work.raw_phase, buffers["precision"], work.rates, pairs, out=buffers["phase"])
        work.patches = work.unwrapper.join(buffers["phase"], buffers["modulation"], work.rates)
        doubt = self._orders.find(image, work, frame, previous, correction)
        if self._geometry is not None:
            triangulate(buffers["unwrapped"], self._rays, self._projector, out=buffers["points"])
        return doubt

    def _read_image(self, image: Any) -> tuple[Any, float]:
        """Return linear light in levels, and their full scale."""
        if not isinstance(image, np.ndarray) and not runtime.is_device_array(image):
            raise ShapeError(f"image is a {type(image).__name__}: pass a NumPy array of shape (H, W, 3)")
        shape = tuple(image.shape)
        if len(shape) == 2 or (len(shape) == 3 and shape[2] == 1):
            raise ShapeError(f"image is grey ({_size(shape)}): the phase is in the colours, pass (H, W, 3) RGB")
        if len(shape) == 3 and shape[2] == 4:
            raise ShapeError("image has four channels: drop the transparency with image[..., :3]")
        if len(shape) != 3 or shape[2] != 3:
            raise ShapeError(f"image has shape {shape}: pass (H, W, 3) RGB")
        if min(shape[:2]) < _MIN_SIZE_PX:
            raise ShapeError(f"image is {_size(shape)}: at least {_MIN_SIZE_PX}x{_MIN_SIZE_PX} px are needed")
        if self._geometry is not None and self._geometry.camera.size_px != (shape[1], shape[0]):
            width, height = self._geometry.camera.size_px
            raise CalibrationError(
                f"frame is {_size(shape)} but the calibration is for {height}x{width}: recalibrate or crop"
            )
        dtype = image.dtype.name if isinstance(image, np.ndarray) else runtime.dtype_name(image)
        if dtype not in WHITE_LEVELS:
            raise ShapeError(f"image is {dtype}: pass uint8, uint16 or float32 levels")
        if isinstance(image, np.ndarray):
            image = np.ascontiguousarray(image)
            if self.arch != "cpu" and not image.flags.writeable:
                image = image.copy()
        white = self.settings.white_level or WHITE_LEVELS[dtype]
        if dtype == "float32" or white < WHITE_LEVELS[dtype]:
            missing, outside = count_out_of_range(image, white)
            if missing:
                raise FootageError(f"image holds NaN in {missing} values: replace them, by 0 for pixels to be masked")
            if outside:
                raise FootageError(
                    f"image has {outside} values outside 0..{white:g}: scale it, or set white_level to its full scale"
                )
        transfer = self._path.transfer
        if not isinstance(transfer, str) or transfer != "linear":
            image = linearize(image, transfer, white, white)
        return image, white

    def _levels(self, statistics: FrameStatistics, white: float) -> FrameLevels:
        """Return noise and thresholds: the settings', and what they leave open from the frame."""
        settings, brightness = self.settings, statistics.brightness * white
        read, gain = settings.noise or (statistics.noise[0] * white, statistics.noise[1] * white)
        read = max(read, _LEAST_NOISE * white)
        noise = float(np.sqrt(read**2 + gain * brightness / 2))
        intensity, modulation = settings.min_intensity, settings.min_modulation
        if intensity is None:
            intensity = max(_INTENSITY_SIGMAS * noise, _INTENSITY_FRACTION * brightness)
        if modulation is None:
            modulation = max(
                _MODULATION_SIGMAS * self._path.crosstalk.noise_gain * noise, _MODULATION_FRACTION * brightness
            )
        return FrameLevels(white, read, gain, noise, intensity, modulation)

    def _frame(self, height: int, width: int, vertical: bool, out: DecodedFrame | None) -> DecodedFrame:
        if self._geometry is not None and self._rays is None:
            rays = self._geometry.camera.rays()
            self._rays = runtime.to_device(np.ascontiguousarray(rays.transpose(1, 0, 2)) if vertical else rays)
        if self._reference is not None and self._reference.shape != ((width, height) if vertical else (height, width)):
            raise ShapeError(f"frame is {height}x{width} but the reference is {_size(self._reference.shape)}")
        if out is not None:
            fits = tuple(out._buffers["mask"].shape) == (height, width) and out._vertical == vertical
            if not fits or out.calibrated != (self._geometry is not None):
                raise ShapeError("out is of another size, stripes or calibration: leave it away for this frame")
            out._forget()
            return out
        buffers = self._unused_buffers(height, width)
        return DecodedFrame(
            None, 0.0, (), self._geometry is not None, False, vertical, buffers, _reference=self._reference
        )

    def _unused_buffers(self, height: int, width: int) -> dict[str, Any]:
        """Return the buffers of the frame before if nobody holds it or its arrays any more, else new ones."""
        buffers, self._last_buffers = self._last_buffers, {}
        # A buffer that only the dictionary and this expression know of is free; the dictionary goes with its frame.
        free = bool(buffers) and sys.getrefcount(buffers) == 2 and buffers["mask"].shape == (height, width)
        if not free or any(sys.getrefcount(buffers[name]) > 2 for name in buffers):
            floats = ("phase", "modulation", "precision", "unwrapped")
            buffers = {name: runtime.empty((height, width), np.float32) for name in floats}
            buffers["mask"] = runtime.empty((height, width), np.uint8)
            buffers["region"] = runtime.empty((height, width), np.int32)
            if self._geometry is not None:
                buffers["points"] = runtime.empty((height, width, 3), np.float32)
        self._last_buffers = buffers
        return buffers

    def _clear(self, frame: DecodedFrame) -> None:
        empty = {"mask": 0, "region": 0, "modulation": 0.0}
        for name, buffer in frame._buffers.items():
            buffer.fill(empty.get(name, np.nan))

    def _warn(self, frame: DecodedFrame, message: str) -> None:
        frame.warnings = (*frame.warnings, message)
        warnings.warn(message, DecodeWarning, stacklevel=4)


def _no_fringe(image: Any, white_level: float, stripes: str) -> str:
    """Say why no fringe was found."""
    if measure_frame(transpose(image), white_level).period_px is not None:
        other = "vertical" if stripes == "horizontal" else "horizontal"
        return f"no {stripes} fringe stands out, but a {other} one does: set stripes to {other!r}"
    return "no fringe stands out of this frame: check that the pattern is projected, in focus and not over-exposed"


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[0]}x{shape[1]}"
