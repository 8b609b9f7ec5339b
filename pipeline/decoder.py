"""Turn one colour frame into phase, orders and points: `Decoder.decode` is the way of a frame, top to bottom."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.causes import Cause, Key
from pipeline.contrast_code import ContrastCode
from pipeline.decoding.buffers import BufferPool, PhaseBuffers, SurfaceBuffers, clear_buffers
from pipeline.decoding.doubts import (
    CODE_SHOWN,
    Changed,
    few_pixels_doubt,
    folded_lens_doubt,
    fringe_doubt,
    light_doubts,
    motion_doubts,
    over_exposure_doubt,
    repeated_chroma_doubt,
    reversed_doubt,
)
from pipeline.decoding.expected_fringe import ExpectedFringe
from pipeline.decoding.footage_light import with_transfer_of
from pipeline.decoding.frame import (
    CameraRays,
    DecodedFrame,
    FrameMemory,
    FrameSetup,
    Measured,
    buffers_of,
    emptied_on_error,
    memory_of,
    refill,
)
from pipeline.decoding.frame_reader import FrameReader, LinearFrame
from pipeline.decoding.front_side import RimVotes, ask_rims
from pipeline.decoding.light_model import LightModel
from pipeline.decoding.rig_state import Asked, RigState
from pipeline.decoding.self_calibration import LightEstimate, estimate_light
from pipeline.decoding.thresholds import frame_levels
from pipeline.decoding.workspace import Workspace
from pipeline.errors import CalibrationError, DecodeWarning, FootageError
from pipeline.footage.footage import BadFrame, Footage, OnBad, check_on_bad
from pipeline.linear_algebra import one_thread
from pipeline.models import CodeName
from pipeline.orders.order_finder import OrderFinder, SeenPhase
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.arrays import LevelsImage
from tikernels.depth.point_uncertainty import point_sigma
from tikernels.depth.triangulation import leave_out_blind, triangulate
from tikernels.order_evidence import follow_phase
from tikernels.phase.camera_blur import undo_camera_blur
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.field_motion import FieldMotion, RowMotion, doubt_motion, hold_still, measure_motion, measure_rows
from tikernels.phase.frame_statistics import FrameLevels, FrameStatistics, measure_frame
from tikernels.phase.phase_change import RATE_ACROSS, measure_rates
from tikernels.phase.phase_fit import FittedPhase, fit_phase
from tikernels.phase.white_light import FrameLight
from tikernels.raw.development import develop
from tikernels.unwrapping import GivenRegions, UserUnwrapper
from tikernels.unwrapping.rim_growing import doubt_rims, grow_rims
from tikernels.unwrapping.rim_pixels import leave_out_strangers

_log = logging.getLogger("colorphase.decoder")

# While it is not clear which side is in front, this many frames are checked, and then one of as many: a check takes up
# to a fourth of the time that decoding does.
_ASKED = 16


class Decoder:
    """Decode frames of one rig, one after another.

    Parameters
    ----------
    settings : DecodeSettings, optional
        Settings of the decoding.
    calibration : Calibration, optional
        The rig; with it, results are in mm.
    reference : DecodedFrame, optional
        A frame of a plane, which `range_image` is measured from without a calibration.
    arch : {"auto", "cpu", "vulkan", "cuda", "metal"}
        The device; a named one never falls back.
    unwrapper : UserUnwrapper, optional
        Your own unwrapping: an object with ``unwrap(phase, quality) -> (unwrapped, region)``,
        stripes along the rows; see `tikernels.unwrapping.UserUnwrapper`.

    Attributes
    ----------
    state : RigState
        The rig's state as estimated from frames; assign another decoder's, and this one omits the checks that it has
        settled.
    settings, calibration
        As given.
    arch : str
        Its device.

    Raises
    ------
    DeviceNotReady
        The machine lacks the arch.
    SettingsError, CalibrationError
        Settings and calibration contradict each other.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(sheet.image)
    >>> f"{np.nanmedian(frame.points[..., 2]):.0f} mm"
    '900 mm'
    """

    def __init__(
        self,
        settings: DecodeSettings | None = None,
        calibration: Calibration | None = None,
        reference: DecodedFrame | None = None,
        arch: str = "auto",
        unwrapper: UserUnwrapper | None = None,
    ) -> None:
        plane = None if reference is None else reference.unwrapped_phase.copy()  # its frame may become `out`
        self._begin(settings or DecodeSettings(), calibration, plane, arch, unwrapper)

    def _begin(
        self,
        settings: DecodeSettings,
        calibration: Calibration | None,
        plane: npt.NDArray[np.float32] | None,
        arch: str,
        unwrapper: UserUnwrapper | None,
    ) -> None:
        self.settings, self.calibration, self._unwrapper = settings, calibration, unwrapper
        self._light = LightModel(self.settings, calibration)
        geometry = calibration.geometry() if calibration is not None and calibration.has_geometry else None
        self._estimated_light: LightEstimate | None = None
        self._rims = RimVotes()
        self._asks_rims = geometry is None and self.settings.projector_side is None
        self._unclear_frames = 0
        self._reader = FrameReader(self.settings, self._light, geometry, plane)
        depth_range_mm = None if calibration is None else calibration.depth_range_mm
        self._orders = OrderFinder(self._light.code, geometry, depth_range_mm)
        self._expected = None if geometry is None else ExpectedFringe.of(geometry, depth_range_mm)
        self._given = None if unwrapper is None else GivenRegions(unwrapper)
        fields = self.settings.fields
        frame_s = self.settings.frame_s or np.inf  # rows are 0 frames apart where that is not known
        self._row = self.settings.row_s / frame_s
        self._fields = None if fields is None else fields.in_cycles(frame_s, self.settings.row_s)
        self._pool = BufferPool()
        self._workspace: Workspace | None = None
        self.arch = runtime.init(arch)
        rays = None if geometry is None else CameraRays.of(geometry, self.settings.stripes)
        self._setup = FrameSetup(self.settings, calibration, rays, plane)

    def __repr__(self) -> str:
        calibrated = "in rad, no geometry" if self.calibration is None else repr(self.calibration)
        return f"<Decoder on {self.arch}: {self.settings.stripes} stripes, {calibrated}>"

    def decode(
        self,
        image: LevelsImage,
        previous: DecodedFrame | None = None,
        out: DecodedFrame | None = None,
        elapsed: float = 1.0,
    ) -> DecodedFrame:
        """Decode one frame.

        Meanwhile NumPy's linear algebra has one thread, in all threads of this program.

        Parameters
        ----------
        image : (H, W, 3) uint8, uint16 or float32
            RGB, levels from 0 to the white level (floats: 0..1): a NumPy array, a Taichi ndarray, or the array of
            another library (PyTorch, JAX: all that support DLPack) in the host's memory, which is not copied.
        previous : DecodedFrame, optional
            The frame before in a video, decoded with the same settings. Region by region its orders are carried on
            where no code determines them, as long as a surface's phase changes by less than a third of a cycle, or by
            as much more or less than a frame before, and its edges move by less than 10 px; and its phases count when
            the response is equalised. A frame that shows nothing of it starts afresh, with a `DecodeWarning`.
        out : DecodedFrame, optional
            An earlier result of the same size, whose arrays are used again: what was read from it changes.
        elapsed : float
            Time since `previous`, in times from frame to frame: 2 after a frame that was dropped. It matters where
            colours come one after another (`DecodeSettings.fields`).

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
            `previous` was decoded with stripes the other way, or `elapsed` is not above 0.
        FootageError
            The image holds NaN, or values outside 0..white level.
        DeviceNotReady
            Another arch has been started since this decoder was made.
        """
        with runtime.lock, one_thread():
            runtime.require(self.arch)
            frame = self._reader.read(image)  # linear light, colours aligned, stripes along the rows
            memory = None
            if previous is not None:
                memory = memory_of(previous).checked(frame.shape, self._setup.stripes, elapsed)
            if out is None:
                buffers = self._pool.lend(frame.shape, points=self._setup.rays is not None)
            else:
                buffers = buffers_of(out, frame.shape, self._setup)
            statistics = measure_frame(frame.image, frame.white)
            levels = frame_levels(self.settings, statistics, frame.white)
            period_px = self.settings.camera_period_px or statistics.period_px
            looks_for_code = self._light.code_unknown
            with nullcontext() if out is None else emptied_on_error(out):
                if statistics.period_px is None or period_px is None:
                    clear_buffers(*buffers)
                    measured = Measured(*buffers, order_doubt=fringe_doubt(frame, self._setup.stripes, levels.clipped))
                else:
                    measured = self._measure(frame, levels, period_px, memory, *buffers)
                    if self._learn_light(frame, levels, period_px, measured.surface):
                        memory = None if out is previous else memory  # its buffers have just been written
                        measured = self._measure(frame, levels, period_px, memory, *buffers)
                    measured = self._doubted(measured, frame, levels, statistics, period_px)
                    if looks_for_code and self._light.code is not None and not self._light.code_unknown:
                        measured = replace(measured, light_doubts=(CODE_SHOWN, *measured.light_doubts))
                    if self._setup.rays is None:
                        sign, clear = self._find_front(measured.surface, self._work(frame, period_px))
                        measured = replace(measured, range_sign=sign, front_known=clear)
            found = [] if frame.repeated is None else [repeated_chroma_doubt(frame.repeated)]
            if self._setup.rays is not None and self._setup.rays.n_blind:
                found.append(folded_lens_doubt(self._setup.rays.n_blind, frame.shape))
            measured = replace(measured, light_doubts=(*measured.light_doubts, *found))
            for doubt in measured.doubts:
                warnings.warn(doubt, DecodeWarning, stacklevel=2)
            result = DecodedFrame(period_px, levels.noise, measured.doubts, measured, self._setup)
            return result if out is None else refill(out, result)

    def decode_all(
        self, footage: Footage, start: int = 0, stop: int | None = None, step: int = 1, *, on_bad: OnBad = "raise"
    ) -> Iterator[DecodedFrame]:
        """Decode the frames of footage in their order, each with the one before.

        Light is treated as encoded as the footage states, where neither settings nor calibration do, and the
        calibration is that of the part of the sensor which frames are. Frames have their `number` and `time_s`.

        Parameters
        ----------
        footage : Footage
            As `open_footage` opens it.
        start, stop, step : int
            The frames, as of a slice.
        on_bad : {"raise", "skip"}
            End at a damaged frame, or skip it with a `DecodeWarning`.

        Yields
        ------
        DecodedFrame
            Fresh arrays.

        Raises
        ------
        FootageError
            A frame is damaged, and `on_bad` is "raise".
        CalibrationError
            The calibration is of other frames.
        SettingsError
            `on_bad` is something else.

        Examples
        --------
        >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
        >>> with colorphase.Recorder("film.zarr", colorphase.PixelFormat("rgb"), rate_hz=30) as film:
        ...     for seed in range(2):
        ...         simulation = colorphase.SimulationSettings(scene="plane", seed=seed)
        ...         film.add(colorphase.simulate_frame(rig, simulation).image)
        >>> decoder = colorphase.Decoder(calibration=rig, arch="cpu")
        >>> with colorphase.open_footage("film.zarr") as footage:
        ...     for frame in decoder.decode_all(footage):
        ...         print(frame.number, f"{frame.time_s:.3f} s, {np.nanmedian(frame.range_image):.0f} mm")
        0 0.000 s, 900 mm
        1 0.033 s, 900 mm
        """
        check_on_bad(on_bad)
        decoder, times = self._suited_to(footage), footage.times
        frame_s = decoder.settings.frame_s
        previous: DecodedFrame | None = None
        for stored in footage.frames(start, stop, step):
            try:
                if isinstance(stored, BadFrame):
                    raise FootageError(stored.reason)
                elapsed = 1.0
                if previous is not None and previous.number is not None:
                    elapsed = stored.number - previous.number
                    if times is not None and frame_s is not None:
                        elapsed = times.elapsed(previous.number, stored.number, frame_s)
                image = develop(stored.planes, stored.format, stripes=decoder.settings.stripes)
                frame = decoder.decode(image, previous, elapsed=elapsed)
            except FootageError as error:
                if on_bad == "raise":
                    raise FootageError(f"frame {stored.number} of {footage.name}: {error}") from None
                message = f"frame {stored.number} of {footage.name} is left out: {error}"
                warnings.warn(message, DecodeWarning, stacklevel=2)
                continue
            frame.number = stored.number
            if times is not None:
                frame.time_s, frame.dated = times.of(stored.number), times.since is not None
            previous = frame
            yield frame

    def _suited_to(self, footage: Footage) -> "Decoder":
        """Return a decoder for the encoding of the footage's light and its part of the sensor; this one if it suits."""
        settings, _ = with_transfer_of(footage, self.settings, self.calibration)
        calibration = self.calibration
        if calibration is not None:
            calibration = calibration.as_read_out(footage.size_px, footage.sensor, footage.name)
        known = self._light.transfer
        same_light = settings.transfer is None or (isinstance(known, str) and settings.transfer == known)
        if same_light and calibration is self.calibration:
            return self
        suited = Decoder.__new__(Decoder)
        suited._begin(settings, calibration, self._setup.reference, self.arch, self._unwrapper)
        return suited

    @property
    def state(self) -> RigState:
        """The rig's state as estimated from frames."""
        code = None if self._light.code_unknown or self._light.code is None else self._light.code.name
        asked: dict[Asked, bool] = {
            "light": self._light.unknown,
            "code": self._light.code_unknown,
            "rims": self._asks_rims and not self._rims.clear,
        }
        return RigState(
            self._estimated_light, code, self._rims, frozenset(name for name, is_asked in asked.items() if is_asked)
        )

    @state.setter
    def state(self, state: RigState) -> None:
        if "code" not in state.asks:
            self._use_code(state.code)
        if "light" not in state.asks:
            self._estimated_light = state.light
            self._light.learn(state.light)
        if "rims" not in state.asks:
            self._rims, self._asks_rims = state.rims, False

    def _use_code(self, code: CodeName | None) -> None:
        """Take a code that was seen; one that settings or calibration state stays."""
        if self._light.code_unknown:
            self._light.use_code(None if code is None else ContrastCode.named(code))
            self._orders.code = self._light.code

    def _measure(
        self,
        frame: LinearFrame,
        levels: FrameLevels,
        period_px: float,
        memory: FrameMemory | None,
        phases: PhaseBuffers,
        surface: SurfaceBuffers,
    ) -> Measured:
        """Go through all stages, from a frame with fringes to its points."""
        known, work = self._light, self._work(frame, period_px)
        gains, model, rates = work.gains, work.model, work.rates
        rays = self._setup.rays
        image, motion = self._hold_still(frame, levels, work, memory)
        # The phase of every pixel: balance, response, surfaces, each channel's wave, and a fit to all three.
        light = known.fit(image, levels, model, before=None if memory is None else memory.surfaces)
        crosstalk, correction = light.crosstalk, light.correction
        fit = FittedPhase(work.fitted_phase, phases.modulation, phases.precision, phases.misfit, work.brightness)
        fit_phase(image, model, crosstalk, levels, correction, known.contrast_doubt, out=fit)
        if motion is not None:
            doubt_motion(motion, phases.precision, out=phases.misfit)
        undo_camera_blur(work.fitted_phase, work.brightness, phases.precision, out=(work.raw_phase, phases.misfit))
        if rays is not None and rays.n_blind:
            leave_out_blind(rays.rays, out=work.raw_phase)
        # Its neighbours: smoothing, patches joined to regions, and the whole cycles of each.
        measure_rates(work.raw_phase, phases.modulation, out=rates)
        work.smoother.along(work.raw_phase, phases.precision, rates, out=work.phase)
        patches = work.unwrapper.join(work.phase, phases.modulation, rates)
        smoothed = (work.phase, phases.modulation, rates)
        seen = SeenPhase(image, gains, crosstalk, *smoothed, correction, period_px, float(model.contrast), levels.noise)
        if known.code_unknown:  # up to here as if there were a code: without, its contrasts look like more surfaces
            self._use_code("contrast" if self._orders.shows_a_code(seen, patches) else None)
            if known.code is None:
                return self._measure(frame, levels, period_px, memory, phases, surface)
        placement = self._orders.find(seen, patches, rays, memory)
        if placement.roots is not None:
            patches.split(placement.roots, placement.left_out)
        if rays is not None and self._orders.expected_depth_mm is not None:
            patches.place(work.phase, rays.rays, rays.projector, self._orders.expected_depth_mm)
        patches.set_orders(*placement.offsets())
        rows = replace(surface, unwrapped=work.unwrapped)
        regions = patches.write(work.phase, work.brightness, rates, rows.unwrapped, rows.mask, rows.region)
        orders = placement.region_orders(patches, regions, memory)
        corrected, lost = self._orders.refine(seen, work.raw_phase, regions, orders, placement.shift_px, out=rows)
        if corrected:
            work.smoother.along(work.raw_phase, phases.precision, rates, out=work.fitted_phase)
            follow_phase(work.fitted_phase, work.phase, out=rows.unwrapped)
        light_and_phase = (work.brightness, phases.modulation, work.phase)
        leave_out_strangers(*light_and_phase, out=(rows.unwrapped, rows.mask, rows.region))
        # What smoothing and unwrapping had no place for at the rims, each pixel by itself.
        grown = (rows.unwrapped, rows.mask, rows.region)
        grow_rims(work.raw_phase, phases.precision, phases.misfit, work.brightness, rates, out=grown)
        work.smoother.across(rows.unwrapped, rows.mask, rates, out=(surface.unwrapped, phases.variance))
        doubt_rims(work.brightness, rows.region, out=phases.variance)
        # Its place, at the time of the middle row.
        row_motion = self._carry_rows(phases, surface, memory, work)
        if rays is not None:
            triangulate(surface.unwrapped, rays.rays, rays.projector, out=surface.points)
        doubted = (model.contrast, light.mismatch, light.odd, lambda: self._mm_per_rad(surface))
        moved = motion_doubts(motion, row_motion, self._fields, memory)
        order_doubt = placement.warning or lost
        code_lost = order_doubt is not None and order_doubt.key in {"code too weak", "orders guessed"}
        mask = runtime.to_host(surface.mask)  # synchronises
        return Measured(
            phases,
            surface,
            light=self._kept_light(frame, image, levels, work, crosstalk),
            mask=mask,
            n_measured=int(np.count_nonzero(mask)),
            surfaces=light.surfaces,
            stripe_shift_px=placement.shift_px,
            fields=None if motion is None else motion.shares,
            since_middle=None if row_motion is None else row_motion.since_middle,
            orders=orders,
            constant_known=known.constant_known,
            constant_sigma=light.constant_sigma,
            mismatch=light.mismatch,
            order_doubt=order_doubt,
            light_doubts=(*light_doubts(*doubted, constant_known=known.constant_known, code_lost=code_lost), *moved),
        )

    def _kept_light(
        self, frame: LinearFrame, image: LevelsImage, levels: FrameLevels, work: Workspace, crosstalk: Crosstalk
    ) -> FrameLight:
        """Return the light that a frame keeps, which is not written again."""
        model, white = work.model, self._light.white
        return FrameLight(
            image=self._pool.keep(image) if frame.shared and image is frame.image else image,
            white=frame.white,
            clipped=levels.clipped,
            nodes=model.nodes,
            sharpness=model.sharpness.values,
            spacing_px=model.gains.spacing_px,
            template=model.template,
            crosstalk=crosstalk,
            neutral=np.ones(3, np.float32) if white is None else np.asarray(white / white.mean(), np.float32),
            coded=self._light.code is not None,
        )

    def _find_front(self, surface: SurfaceBuffers, work: Workspace) -> tuple[int, bool]:
        """Return -1 if the phase grows towards the camera, else 1, and whether settings or frames make that clear."""
        side = self.settings.projector_side
        if self._asks_rims and not self._rims.clear:
            if self._unclear_frames < _ASKED or self._unclear_frames % _ASKED == 0:
                self._rims = ask_rims(runtime.to_host(surface.unwrapped), runtime.to_host(surface.region))
            self._unclear_frames += 1
        if side is not None:
            # A projector above lights lower places of what is nearer.
            rising = float(runtime.to_host(work.rates)[-1, RATE_ACROSS]) > 0  # synchronises
            return (-1 if rising == (side in ("above", "left")) else 1), True
        return (-1 if self._rims.clear and self._rims.falls > self._rims.grows else 1), self._rims.clear

    def _doubted(
        self,
        measured: Measured,
        frame: LinearFrame,
        levels: FrameLevels,
        statistics: FrameStatistics,
        period_px: float,
    ) -> Measured:
        """Return the measurement with warnings about its exposure, or nothing where the rig cannot show it."""
        few = few_pixels_doubt(frame, levels, float(self._work(frame, period_px).model.contrast), measured.n_measured)
        if few is not None:  # about which little else is known
            orders = measured.order_doubt if measured.n_measured else None
            return replace(measured, order_doubt=orders, light_doubts=(few,))
        over = over_exposure_doubt(statistics.clipped)
        if over is not None:
            measured = replace(measured, light_doubts=(over, *measured.light_doubts))
        if self._expected is not None:
            rate = float(runtime.to_host(self._work(frame, period_px).rates)[-1, RATE_ACROSS])  # synchronises
            seen_px = statistics.period_px or period_px
            if self._expected.is_reversed(rate):
                contradiction: Cause | None = reversed_doubt(self._decode_changed(frame, levels, period_px, measured))
            else:
                contradiction = self._expected.contradiction(rate, seen_px)
            if contradiction is not None:
                clear_buffers(measured.phases, measured.surface)
                return Measured(measured.phases, measured.surface, order_doubt=contradiction)
            surprise = self._expected.surprise(rate, seen_px)
            if surprise is not None:
                measured = replace(measured, light_doubts=(surprise, *measured.light_doubts))
        return measured

    def _decode_changed(
        self, frame: LinearFrame, levels: FrameLevels, period_px: float, measured: Measured
    ) -> dict[Key, Changed]:
        """Decode a frame turned over, and with red and blue exchanged, into the same buffers."""
        image, changed = runtime.to_host(frame.image), dict[Key, Changed]()
        others: dict[Key, LevelsImage] = {"turned over": image[::-1, ::-1], "colours swapped": image[..., ::-1]}
        for key, other in others.items():
            again = LinearFrame(runtime.to_device(np.ascontiguousarray(other)), frame.white, shared=False)
            found = self._measure(again, levels, period_px, None, measured.phases, measured.surface)
            known = found.orders.known[runtime.to_host(found.surface.region)].sum() / max(1, found.n_measured)
            changed[key] = Changed(
                read=None if self._light.code is None else float(known),
                mismatch=found.mismatch if self._light.constant_known and self._estimated_light is None else None,
            )
        return changed

    def _mm_per_rad(self, surface: SurfaceBuffers) -> float | None:
        """Return by how much a radian moves the points of a frame, mm; None without any."""
        rays = self._setup.rays
        if rays is None or surface.points is None:
            return None
        radian = np.ones((rays.rays.shape[0], rays.rays.shape[1]), np.float32)
        moved = point_sigma(surface.unwrapped, runtime.to_device(radian), surface.points, rays.rays, rays.projector)
        shift = runtime.to_host(moved)  # synchronises
        return float(np.nanmedian(shift)) if np.isfinite(shift).any() else None

    def _hold_still(
        self, frame: LinearFrame, levels: FrameLevels, work: Workspace, memory: FrameMemory | None
    ) -> tuple[LevelsImage, FieldMotion | None]:
        """Return the image as if its colours were of one moment, and what has moved between them; None: unknown.

        By a first pass over the phase, and the previous frame.
        """
        known, model = self._light, work.model
        if self._fields is None or memory is None:
            return frame.image, None
        light = known.fit(frame.image, levels, model, before=memory.surfaces)
        fit = fit_phase(frame.image, model, light.crosstalk, levels, light.correction, known.contrast_doubt)
        motion = measure_motion(
            fit.phase,
            memory.surface.unwrapped,
            self._fields,
            memory.fields,
            work.period_px,
            elapsed=memory.elapsed,
            rows_last=self._setup.stripes == "vertical",
        )
        lags = motion.lags(fit.modulation)
        return hold_still(frame.image, fit, motion, model, light.crosstalk, lags), motion

    def _carry_rows(
        self, phases: PhaseBuffers, surface: SurfaceBuffers, memory: FrameMemory | None, work: Workspace
    ) -> RowMotion | None:
        """Carry the phase to the time of the middle row; return what has moved between rows; None: unknown."""
        if not self._row or memory is None:
            return None
        before, rows_last = memory.surface.unwrapped, self._setup.stripes == "vertical"
        seen = (surface.unwrapped, before, self._row, work.period_px)
        motion = measure_rows(*seen, elapsed=memory.elapsed, rows_last=rows_last)
        runtime.write(runtime.to_host(surface.unwrapped) - motion.since_middle, surface.unwrapped)  # synchronises
        doubt_motion(motion, phases.precision, out=phases.misfit)
        return motion

    def _learn_light(self, frame: LinearFrame, levels: FrameLevels, period_px: float, surface: SurfaceBuffers) -> bool:
        """Learn crosstalk and response from a frame that was decoded without them; return whether it shows them."""
        if not self._light.unknown:
            return False
        phases = runtime.to_host(surface.unwrapped)[runtime.to_host(surface.mask) != 0]  # synchronises
        if phases.size:
            cycles = float(np.ptp(np.quantile(phases, (0.01, 0.99)))) / (2 * np.pi)
            with suppress(CalibrationError):
                self._estimated_light = estimate_light(
                    frame.image, levels, self._work(frame, period_px).period_px, cycles
                )
        self._light.learn(self._estimated_light)
        return self._estimated_light is not None and self._estimated_light.reliable

    def _work(self, frame: LinearFrame, period_px: float) -> Workspace:
        """Return the buffers for a frame's size and period."""
        # A few per cent of period change nothing; the buffers stay while it drifts.
        period_px = float(2 ** (np.round(8 * np.log2(period_px)) / 8))
        if self._workspace is None or not self._workspace.fits(frame.shape, period_px):
            _log.info("buffers for %dx%d px", *frame.shape[::-1])
            self._workspace = Workspace(*frame.shape, period_px, self._setup.smoothing_pairs, self._given)
        return self._workspace
