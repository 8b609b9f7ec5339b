"""Turn one colour frame into phase, orders and points."""

import sys
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.absolute_order import AbsoluteOrders, blur_shift, find_absolute_orders
from pipeline.calibration import Calibration, Capture, Geometry
from pipeline.calibration.board_free import LightEstimate, estimate_light
from pipeline.contrast_code import cycle_modulations
from pipeline.errors import CalibrationError, FootageError, SettingsError
from pipeline.results import DecodedFrame, PhaseNoise
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.absolute_order import SLOTS as ORDER_SLOTS
from tikernels.absolute_order import adopt_pixels_kernel, correct_by_modulation_kernel, measure_contrast_kernel
from tikernels.balance import Gains
from tikernels.crosstalk import invert_crosstalk
from tikernels.equalization import (
    SLOTS,
    correction_table,
    count_phases_kernel,
    modulation_tables,
    pattern_light,
    prefers_response,
    response_table,
)
from tikernels.errors import ShapeError
from tikernels.filtering import measure_rates_kernel, rates_buffer, smooth_phase_kernel
from tikernels.linearization import WHITE_LEVELS, Transfer, linearize
from tikernels.registration import align_channels
from tikernels.statistics import count_out_of_range, measure_frame
from tikernels.transposing import transpose
from tikernels.triangulation import triangulate_kernel
from tikernels.unwrapping import PatchGraph, Unwrapper
from tikernels.wrapped_phase import phase_weights, recover_phase_kernel

# Smaller pictures hold no surface.
_MIN_SIZE_PX = 16
_BINS = 256
# The fringe must stand out of the noise by five standard deviations, where chance makes one pixel in 300,000 valid, and
# reach this fraction of the picture's brightness, below which ambient light and stray light decide.
_MODULATION_SIGMAS = 5.0
_MODULATION_FRACTION = 0.03
_INTENSITY_SIGMAS = 3.0
_INTENSITY_FRACTION = 0.02
# Share of the pixels a cycle up to which the equalisation keeps harmonics; at one, the pixel grid itself looks like
# one.
_HARMONICS_A_PIXEL = 0.8


# With a code, the share of pixels without an absolute order from which the user is told, and the smallest correction
# (rad) that is worth a pass over the image.
_MAX_LOST = 0.02
_MIN_CORRECTION = 1e-3
# Every eighth column tells how far blur shifts the phase.
_EVERY_COLUMN = 8


class DecodeWarning(UserWarning):
    """A frame decoded, but not as its user will have hoped."""


class _Workspace:
    """Device buffers for one image size and fringe period."""

    def __init__(self, height: int, width: int, period_px: float) -> None:
        self.key = (height, width, period_px)
        self.gains = Gains(height, width, period_px)
        self.rates = rates_buffer(height)
        self.raw_phase = runtime.empty((height, width), np.float32)
        # Some 60,000 samples pin the equalisation down to a milliradian: more only cost time.
        self.histogram_step = max(1, height * width // 2**16)
        self.histogram = np.zeros((SLOTS, _BINS), np.int32)
        self.unwrapper = Unwrapper(height, width)


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
        self._transfer: Transfer = self.settings.transfer
        self._shift: Any = None
        self._rays: Any = None
        self._geometry: Geometry | None = None
        matrix, lag, light = self.settings.crosstalk_matrix, None, np.ones(3)
        self._response: Any = None  # of a pattern in which it has not been undone, or may not have been
        self._compensated = calibration.pattern.compensated if calibration and calibration.pattern else None
        if calibration is not None:
            if calibration.pattern is not None and calibration.pattern.stripes != self._stripes:
                raise SettingsError(
                    f"settings say {self._stripes} stripes but the calibration's pattern has "
                    f"{calibration.pattern.stripes} ones: set stripes to {calibration.pattern.stripes!r}"
                )
            self._transfer = _transfer(self.settings, calibration)
            matrix = calibration.crosstalk_matrix if matrix is None else matrix
            if calibration.response is not None and self._compensated is not True:
                self._response = calibration.response
                if self._compensated is False:
                    light = pattern_light(calibration.response)
            if calibration.has_geometry:
                self._geometry = calibration.geometry()
                self._depth_mm = _expected_depth(self._geometry, calibration.depth_range_mm)
                self._projector = self._geometry.for_triangulation()
            if calibration.color_shift_px is not None:
                self._shift = calibration.color_shift_px.camera
                if self._geometry is not None:
                    axis, period = self._geometry.phase_axis, self._geometry.pattern.period_px
                    lag = 2 * np.pi / period * calibration.color_shift_px.projector[:, axis]
        self._code = self.settings.code
        if calibration is not None and calibration.pattern is not None:
            self._code = calibration.pattern.code
        self._code_looked_for = False
        self._balance_first = self.settings.reflectance_bands == "broad"
        # Without any word of the light the first frame with fringes tells it; not, though, how bright the camera's
        # channels are to each other, which matters where the crosstalk is undone before the balance.
        self._light_unknown = matrix is None and self._balance_first
        self._lag = lag
        self._own_correction: npt.NDArray[np.float32] | None = None
        self._constant_known = matrix is not None
        self._use_matrix(np.eye(3) if matrix is None else matrix @ np.diag(light))
        self._workspace: _Workspace | None = None
        self._last_buffers: dict[str, Any] = {}
        self.arch = runtime.init(arch)

    def _use_matrix(self, matrix: npt.NDArray[np.float64]) -> None:
        # With the balance first a neutral colour is grey by definition, whatever the rows of the matrix sum up to.
        inverse = invert_crosstalk(matrix, normalize_rows=self._balance_first)
        self._inverse, self._matrix = inverse.astype(np.float32), np.linalg.inv(inverse).astype(np.float32)
        self._weights = phase_weights(inverse if self._balance_first else np.eye(3), self._lag).astype(np.float32)
        # The phase vector's noise after the crosstalk has been undone, for a channel's noise of one.
        self._noise_gain = float(np.sqrt((phase_weights(inverse) ** 2).sum() / 2))

    def decode(self, image: Any, out: DecodedFrame | None = None) -> DecodedFrame:
        """Decode one frame.

        Parameters
        ----------
        image : (H, W, 3) uint8, uint16 or float32
            RGB, levels from 0 to the white level (floats: 0..1); a NumPy array or a Taichi ndarray.
        out : DecodedFrame, optional
            An earlier result of the same size, whose arrays are used again: what was read from it changes.

        Returns
        -------
        DecodedFrame
            Fresh arrays, or `out`. A frame without fringes gives an empty mask and a `DecodeWarning`.

        Raises
        ------
        ShapeError
            The image has another shape or type, or `out` another size.
        CalibrationError
            The calibration is for another image size.
        FootageError
            The image holds NaN, or values outside 0..white level.
        """
        image, scale = self._read_image(image)
        if self._shift is not None:
            image = align_channels(image, self._shift)
        vertical = self._stripes == "vertical"
        if vertical:
            image = transpose(image)
        height, width = int(image.shape[0]), int(image.shape[1])
        frame = self._frame(height, width, vertical, out)
        statistics = measure_frame(image, 1.0 / scale)
        period = self.settings.camera_period_px or statistics.period_px
        noise = statistics.noise if self.settings.noise is None else self.settings.noise[0] * scale
        frame.noise_levels = noise / scale
        frame.period_px = period
        frame.warnings = ()
        if statistics.period_px is None:
            self._warn(frame, _no_fringe(image, 1.0 / scale, self._stripes))
            period = None
        if period is None:
            self._clear(frame)
            frame._placed = None
            return frame
        intensity = self._threshold(self.settings.min_intensity, scale, _INTENSITY_SIGMAS * noise)
        modulation = self._threshold(self.settings.min_modulation, scale, _MODULATION_SIGMAS * self._noise_gain * noise)
        if self.settings.min_intensity is None:
            intensity = max(intensity, _INTENSITY_FRACTION * statistics.brightness)
        if self.settings.min_modulation is None:
            modulation = max(modulation, _MODULATION_FRACTION * statistics.brightness)
        doubt = self._run(image, scale, period, intensity, modulation, frame)
        if self._light_unknown:
            self._light_unknown = False
            if self._learn_light(image, scale, period, frame):
                doubt = self._run(image, scale, period, intensity, modulation, frame)
        if doubt is not None:
            self._warn(frame, doubt)
        frame.constant_known = self._constant_known
        return frame

    def _learn_light(self, image: Any, scale: float, period: float, frame: DecodedFrame) -> bool:
        """Learn crosstalk and response from a frame that was decoded without; return whether it told them."""
        unwrapped = runtime.to_host(frame._buffers["unwrapped"])  # synchronises
        mask = runtime.to_host(frame._buffers["mask"]) != 0
        try:
            light = estimate_light([runtime.to_host(image)], 1.0 / scale, [unwrapped], [mask], period)
        except CalibrationError:
            return False
        if light.reliable:
            self._use_matrix(light.crosstalk_matrix)
            self._own_correction = light.correction
            self._constant_known = light.constant_known
        self.light = light
        return light.reliable

    def _run(
        self, image: Any, scale: float, period: float, intensity: float, modulation: float, frame: DecodedFrame
    ) -> str | None:
        """Decode, and return what the user should know of the code."""
        # A few per cent of period change nothing; the buffers stay while it drifts.
        period = float(2 ** (np.round(8 * np.log2(period)) / 8))
        key = (int(image.shape[0]), int(image.shape[1]), period)
        if self._workspace is None or self._workspace.key != key:
            self._workspace = _Workspace(*key)
        work, buffers = self._workspace, frame._buffers
        light = (image, scale, self._inverse, self._matrix, intensity, modulation)
        gains = work.gains.measure(*light, balance_first=self._balance_first, lag=self._lag)
        recover_phase_kernel(self._balance_first)(
            image,
            1.0 / scale,
            self._inverse,
            self._weights,
            gains,
            work.gains.cell,
            intensity / scale,
            modulation / scale,
            work.raw_phase,
            buffers["modulation"],
        )
        table = self._correction(work, period)
        slope = np.gradient(table, 2 * np.pi / (len(table) - 1))
        pairs = self.settings.smoothing_px // 2
        frame._noise = PhaseNoise(self._noise_gain * frame.noise_levels, pairs, (1 + slope).astype(np.float32))
        if self._geometry is not None:
            frame._rig = (self._rays, self._projector)
        measure_rates_kernel(work.raw_phase, buffers["modulation"], work.rates)
        smooth_phase_kernel(pairs)(work.raw_phase, table, work.rates, buffers["phase"])
        work.unwrapper.join(buffers["phase"], buffers["modulation"], work.rates)
        orders = self._read_code(image, gains, work, buffers) if self._code == "contrast" else None
        if self._geometry is not None:
            work.unwrapper.place(buffers["phase"], self._rays, self._projector, self._depth_mm)
        if orders is not None:
            work.unwrapper.set_orders(orders.parts[orders.absolute], orders.offsets[orders.absolute])
        outputs = (buffers["unwrapped"], buffers["mask"], buffers["region"])
        work.unwrapper.write(buffers["phase"], work.rates, *outputs)
        doubt = None if orders is None else self._use_orders(orders, table, work, frame)
        if self._geometry is not None:
            projector = self._projector.arguments()
            triangulate_kernel(buffers["unwrapped"], self._rays, *projector, buffers["points"])
        if self._code is None and not self._code_looked_for:
            self._code_looked_for = True
            graph = work.unwrapper.graph()
            found = self._find_orders(image, gains, work, buffers, graph)
            if graph.pixels[np.isin(found.roots, found.parts[found.absolute])].sum() > graph.pixels.sum() / 2:
                doubt = 'the frame shows a contrast code: set code = "contrast" to use it'
        return doubt

    def _read_code(self, image: Any, gains: Any, work: _Workspace, buffers: dict[str, Any]) -> AbsoluteOrders:
        """Find the absolute orders, and split the regions that the code contradicts."""
        graph = work.unwrapper.graph()
        orders = self._find_orders(image, gains, work, buffers, graph)
        if not np.array_equal(orders.roots, graph.root):
            work.unwrapper.split(orders.roots)
        return orders

    def _find_orders(
        self, image: Any, gains: Any, work: _Workspace, buffers: dict[str, Any], graph: PatchGraph
    ) -> AbsoluteOrders:
        unwrapper = work.unwrapper
        sums = runtime.empty((unwrapper.patch_count, ORDER_SLOTS, 4), np.float32)
        light = (image, self._inverse, gains, work.gains.cell, buffers["phase"], buffers["modulation"])
        patches = (unwrapper.labels, unwrapper.firsts, unwrapper.draft_bits)
        measure_contrast_kernel(self._balance_first)(*light, *patches, sums)
        width = int(image.shape[1])
        rising = float(runtime.to_host(work.rates)[-1, 1]) > 0
        return find_absolute_orders(runtime.to_host(sums), graph, width, rising, self._order_bounds(graph, width))

    def _order_bounds(self, graph: PatchGraph, width: int) -> npt.NDArray[np.float64] | None:
        """Return the absolute phases, in cycles, that the depth range allows the first pixel of each patch."""
        depths = None if self.calibration is None else self.calibration.depth_range_mm
        if self._geometry is None or depths is None:
            return None
        rays = runtime.to_host(self._rays)[graph.first // width, graph.first % width]
        ends = [self._geometry.pattern_cycles(np.column_stack([rays, np.ones(len(rays))]) * z) for z in depths]
        return np.sort(np.stack(ends, axis=1), axis=1)

    def _use_orders(
        self, orders: AbsoluteOrders, table: npt.NDArray[np.float32], work: _Workspace, frame: DecodedFrame
    ) -> str | None:
        """Note what is known of each region, and correct the phases by the modulation that their cycles have.

        Returns what the user should know.
        """
        roots, buffers = work.unwrapper.roots, frame._buffers
        part = np.searchsorted(orders.parts, roots)
        known = np.append(np.False_, orders.absolute[part])
        errors = orders.error_probability(work.unwrapper.orders(orders.parts).astype(np.int64))[part]
        frame._placed = known, np.append(np.nan, errors).astype(np.float32)
        if known.any():
            absolute = known.astype(np.int32)
            adopted = runtime.empty((*buffers["region"].shape, 2), np.float32)
            outputs = (buffers["unwrapped"], buffers["mask"], buffers["region"])
            adopt_pixels_kernel(
                buffers["phase"], work.raw_phase, buffers["modulation"], table, work.rates, absolute, adopted, *outputs
            )
        # The response is taken from all cycles alike; a table of the pattern's own response holds for full modulation.
        usual = 0.5 if self._own_correction is None and self._response is not None else cycle_modulations().mean()
        departures, tables = modulation_tables(table, cycle_modulations() / usual - 1)
        columns = (slice(None), slice(None, None, _EVERY_COLUMN))
        sampled = runtime.to_host(buffers["unwrapped"])[columns], runtime.to_host(buffers["region"])[columns]
        shift = blur_shift(*sampled, known, departures, frame.period_px or 0.0)
        if max(np.abs(tables).max(), abs(shift)) > _MIN_CORRECTION and known.any():
            arguments = (buffers["region"], known.astype(np.int32), departures, tables, shift)
            correct_by_modulation_kernel(*arguments, buffers["phase"], buffers["unwrapped"])
        pixels = np.bincount(runtime.to_host(buffers["region"]).ravel(), minlength=len(known))[1:]
        lost = float(pixels[~known[1:]].sum() / max(pixels.sum(), 1))
        if not orders.readable:
            return "the frame does not show the contrast code: project a pattern made with --code contrast"
        if lost > _MAX_LOST:
            return f"{lost:.0%} of the pixels show too little of the code, or contradict it: their order is a guess"
        return None

    def _correction(self, work: _Workspace, period: float) -> npt.NDArray[np.float32]:
        """Return what undoes the projector's response, as a table over the cycle.

        What is known of the response is better than the assumption that a surface shows every phase equally often.
        """
        if self._own_correction is not None:
            return self._own_correction
        if self._compensated:
            return np.zeros(2, np.float32)
        if self._response is not None and self._compensated is False:
            return response_table(self._response)
        if self._response is None and not self.settings.equalize:
            return np.zeros(2, np.float32)
        work.histogram.fill(0)
        count_phases_kernel(work.raw_phase, work.histogram_step, work.histogram)
        histogram = work.histogram.sum(axis=0)
        if self._response is None:
            return correction_table(histogram, max(3, int(_HARMONICS_A_PIXEL * period)))
        known = prefers_response(histogram, self._response)
        return response_table(self._response) if known else np.zeros(2, np.float32)

    def _read_image(self, image: Any) -> tuple[Any, float]:
        """Return linear light in levels, and the factor that takes them to 0..1."""
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
        if not isinstance(self._transfer, str) or self._transfer != "linear":
            return linearize(image, self._transfer, white), 1.0
        return image, 1.0 / white

    def _frame(self, height: int, width: int, vertical: bool, out: DecodedFrame | None) -> DecodedFrame:
        if self._geometry is not None and self._rays is None:
            rays = self._geometry.camera.rays()
            self._rays = runtime.to_device(np.ascontiguousarray(rays.transpose(1, 0, 2)) if vertical else rays)
        if self._reference is not None and self._reference.shape != ((width, height) if vertical else (height, width)):
            raise ShapeError(f"frame is {height}x{width} but the reference is {_size(self._reference.shape)}")
        if out is not None:
            if tuple(out._buffers["mask"].shape) != (height, width) or out.calibrated != (self._geometry is not None):
                raise ShapeError("out is a result of another size or calibration: leave it away for this frame")
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
            types = {"phase": np.float32, "modulation": np.float32, "unwrapped": np.float32, "mask": np.uint8}
            buffers = {name: runtime.empty((height, width), dtype) for name, dtype in types.items()}
            buffers["region"] = runtime.empty((height, width), np.int32)
            if self._geometry is not None:
                buffers["points"] = runtime.empty((height, width, 3), np.float32)
        self._last_buffers = buffers
        return buffers

    def _clear(self, frame: DecodedFrame) -> None:
        empty = {"mask": 0, "region": 0, "modulation": 0.0}
        for name, buffer in frame._buffers.items():
            buffer.fill(empty.get(name, np.nan))

    def _threshold(self, level: float | None, scale: float, automatic: float) -> float:
        return automatic if level is None else level * scale

    def _warn(self, frame: DecodedFrame, message: str) -> None:
        frame.warnings = (*frame.warnings, message)
        warnings.warn(message, DecodeWarning, stacklevel=4)


def _transfer(settings: DecodeSettings, calibration: Calibration) -> Transfer:
    """Return how the camera encodes light, and warn where it stands otherwise than at calibration."""
    before, now = calibration.capture or Capture(), settings.capture or Capture()
    chosen: Transfer = settings.transfer
    if before.transfer is not None and "transfer" not in settings.model_fields_set:
        chosen = before.transfer
    differ = [
        (name, getattr(before, name), getattr(now, name))
        for name in ("exposure_s", "gain", "white_balance")
        if getattr(before, name) is not None and getattr(now, name) is not None
        if not np.allclose(getattr(before, name), getattr(now, name), rtol=1e-3)
    ]
    if before.transfer is not None and not np.array_equal(chosen, before.transfer):
        differ.append(("transfer", before.transfer, chosen))
    for name, was, is_now in differ:
        message = f"{name} is {is_now} but was {was} at calibration: set the camera as it was, or calibrate again"
        warnings.warn(message, DecodeWarning, stacklevel=3)
    return chosen


def _expected_depth(geometry: Geometry, depth_range_mm: tuple[float, float] | None) -> float:
    if depth_range_mm is not None:
        return float(np.mean(depth_range_mm))
    depth = geometry.working_distance_mm()
    if depth is None:
        raise CalibrationError(
            "camera and projector look in parallel, so nothing tells how far the object is: give depth_range_mm"
        )
    return depth


def _no_fringe(image: Any, white_level: float, stripes: str) -> str:
    """Say why no fringe was found."""
    if measure_frame(transpose(image), white_level).period_px is not None:
        other = "vertical" if stripes == "horizontal" else "horizontal"
        return f"no {stripes} fringe stands out, but a {other} one does: set stripes to {other!r}"
    return "no fringe stands out of this frame: check that the pattern is projected, in focus and not over-exposed"


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[0]}x{shape[1]}"
