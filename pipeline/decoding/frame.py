"""Decoded frames: the fields of every pixel, and the state carried to the next frame of a video."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from dataclasses import field as attribute
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration, Geometry
from pipeline.calibration.lens import Lens
from pipeline.causes import Cause
from pipeline.decoding.buffers import PhaseBuffers, SurfaceBuffers, clear_buffers
from pipeline.decoding.fields import (
    MODULATION_DIGITS,
    PHASE_DIGITS,
    RELATIVE_RANGE_DIGITS,
    SIGMA_DIGITS,
    WRAPPED_PHASE_DIGITS,
    Field,
    field,
    fields_of,
)
from pipeline.decoding.frame_fields import FrameFields
from pipeline.decoding.labels import result_attributes
from pipeline.decoding.surface_search import FoundSurfaces, OnlyColor
from pipeline.errors import SettingsError
from pipeline.settings import DecodeSettings
from pipeline.text import sizes_differ
from tikernels import runtime
from tikernels.arrays import F32, Array
from tikernels.depth.point_uncertainty import point_sigma
from tikernels.depth.triangulation import ProjectorGeometry
from tikernels.errors import ShapeError
from tikernels.phase.surface_edges import edge_variance
from tikernels.phase.texture import measure_texture
from tikernels.phase.uncertainty import estimate_phase_sigma
from tikernels.phase.white_light import FrameLight
from tikernels.transposing import transpose

Floats = npt.NDArray[np.float32]

# A frame's constant is never known better, rad: what balance and ambient light leave of it on clean frames.
_LEAST_CONSTANT = 0.0006
_CYCLE = np.float32(2 * np.pi)


@dataclass(frozen=True, eq=False)
class CameraRays:
    """The geometry that turns a phase into a point: every camera pixel's ray, and the projector."""

    rays: F32  # (H, W, 2) x and y at unit depth, stripes along the rows
    projector: ProjectorGeometry
    n_blind: int  # pixels without a ray, which is NaN: their lens folds

    @classmethod
    def of(cls, geometry: Geometry, stripes: str) -> "CameraRays":
        """Return those of a calibrated rig, on the device."""
        rays = geometry.camera.rays()
        along_rows = np.ascontiguousarray(rays.transpose(1, 0, 2)) if stripes == "vertical" else rays
        blind = int(np.count_nonzero(np.isnan(rays[..., 0])))
        return cls(runtime.to_device(along_rows), geometry.for_triangulation(), blind)


@dataclass(frozen=True, eq=False)
class RegionOrders:
    """Orders of a frame's regions; index 0 means "no region"."""

    known: npt.NDArray[np.bool_]  # (regions + 1,) whether they are absolute
    error_probability: Floats  # (regions + 1,) that they are not the absolute ones; NaN for 0
    change: Floats  # (regions + 1, 3) rad by which the phase has changed since the frame before; see `vote_orders`

    @classmethod
    def of_no_region(cls) -> "RegionOrders":
        """Return those of a frame without regions."""
        return cls(np.zeros(1, np.bool_), np.full(1, np.nan, np.float32), np.zeros((1, 3), np.float32))


@dataclass(frozen=True, eq=False)
class FrameMemory:
    """All that travels from a frame to the next one of a video."""

    stripes: str
    surface: SurfaceBuffers
    orders: RegionOrders
    surfaces: FoundSurfaces | OnlyColor | None  # effect of surfaces on the crosstalk; None: none
    fields: npt.NDArray[np.float64] | None  # see `FieldMotion.shares`; None: the colours' times are unknown
    elapsed: float = 1.0  # time since that frame, in times from frame to frame

    def checked(self, shape: tuple[int, int], stripes: str, elapsed: float) -> "FrameMemory":
        """Return this memory some time later, for a frame whose image has a shape with its stripes along the rows.

        Raises
        ------
        SettingsError, ShapeError
            The frame before had other stripes, or another size, or was no frame before.
        """
        if not elapsed > 0:
            raise SettingsError(f"elapsed is {elapsed:g}: it must be above 0, from the frame before to this one")
        if self.stripes != stripes:
            raise SettingsError(f"stripes are {stripes}, those of the frame before were not: leave previous away")
        before = self.surface.mask.shape
        if before != shape:
            turn = 1 if stripes == "vertical" else -1
            raise ShapeError(sizes_differ("frame", shape[::turn], "the one before is", before[::turn]))
        return replace(self, elapsed=elapsed)


@dataclass(frozen=True, eq=False)
class FrameSetup:
    """Properties that all frames of a decoder share."""

    settings: DecodeSettings
    calibration: Calibration | None
    rays: CameraRays | None  # with the calibration's geometry
    reference: Floats | None  # (H, W) rad, unwrapped phase of a plane that ranges are measured from without one

    @property
    def stripes(self) -> str:
        """Direction of the stripes, "horizontal" or "vertical"; in the buffers they are along the rows."""
        return self.settings.stripes

    @property
    def smoothing_pairs(self) -> int:
        """Number of neighbours on either side that the smoothing fits."""
        return self.settings.smoothing_px // 2


@dataclass(frozen=True, eq=False)
class Measured:
    """Results of the stages for a frame; none for one without fringes."""

    phases: PhaseBuffers
    surface: SurfaceBuffers
    stripe_shift_px: float | None = None  # see `DecodedFrame`
    order_doubt: Cause | None = None  # what the user should know of the orders, or why there are none
    light_doubts: tuple[Cause, ...] = ()  # and of the light
    mask: npt.NDArray[np.uint8] | None = None  # the surface's, read back; None: nothing is measured
    n_measured: int = 0  # pixels in the mask
    orders: RegionOrders = attribute(default_factory=RegionOrders.of_no_region)
    surfaces: FoundSurfaces | OnlyColor | None = None
    range_sign: int = 1  # without a calibration: -1 where the phase grows towards the camera
    front_known: bool = False  # whether that is more than a guess
    light: FrameLight | None = None  # image and model; None: no fringe
    fields: npt.NDArray[np.float64] | None = None  # see `FrameMemory`
    since_middle: Floats | None = None  # (H, W) rad, see `RowMotion`; None: the phase is as the rows show it
    constant_known: bool = False
    constant_sigma: float = np.nan  # rad, by the light alone
    mismatch: float = np.nan  # of the colours from those that the crosstalk predicts, as a fraction

    @property
    def seen_phase(self) -> F32:
        """(H, W) rad: the unwrapped phase at the rows' own times, as the image shows it."""
        unwrapped = self.surface.unwrapped
        if self.since_middle is None:
            return unwrapped
        return runtime.to_device(runtime.to_host(unwrapped) + self.since_middle)  # synchronises

    @property
    def doubts(self) -> tuple[Cause, ...]:
        """Warnings for the user."""
        return self.light_doubts if self.order_doubt is None else (self.order_doubt, *self.light_doubts)


@dataclass(eq=False, repr=False)
class DecodedFrame(FrameFields):
    """A decoded frame: every pixel's phase, its order and, with a calibration, its position.

    The fields are NumPy arrays, read back from the device when they are first used, from any thread. On the CPU they
    may be the very buffers that the next frame of a video reads: copy what you want to change.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(sheet.image)
    >>> frame
    <DecodedFrame: 160x120 px, 100.0% measured, 826 to 988.8 mm>
    >>> f"{np.nanmedian(frame.point_sigma):.1f} mm"
    '0.3 mm'
    """

    period_px: float | None
    """Camera px a cycle that the frame was decoded with; None: no fringe was found."""
    noise_levels: float
    """Standard deviation of a channel where the frame is half as bright as at its brightest, grey levels."""
    warnings: tuple[Cause, ...]
    """Warnings about this frame, each with the `key` of its cause."""
    _measured: Measured
    _setup: FrameSetup
    number: int | None = None
    time_s: float | None = None
    dated: bool = False

    @property
    def measured_px(self) -> int:
        """Number of pixels in the mask."""
        return self._measured.n_measured

    @property
    def constant_known(self) -> bool:
        """True if the constant of all phases is known: unknown crosstalk turns all colours about grey."""
        return self._measured.constant_known

    @property
    def calibrated(self) -> bool:
        """True if `range_image` is a depth in mm."""
        return self._setup.rays is not None

    @property
    def settings(self) -> DecodeSettings:
        """Settings, calibration and version of the decoding."""
        return self._setup.settings

    @property
    def calibration(self) -> Calibration | None:
        """The rig by which it was decoded."""
        return self._setup.calibration

    @property
    def camera(self) -> Lens | None:
        """The camera whose pixels it has; None: without a calibration."""
        return None if self.calibration is None else self.calibration.camera

    @property
    def attributes(self) -> dict[str, Any]:
        """Provenance: settings, the calibration's hash, version, unit of ranges."""
        return result_attributes(self.settings, self.calibration)

    @property
    def fields(self) -> dict[str, Field[Any]]:
        """The fields that it has, by name."""
        return {name: entry for name, entry in FIELDS.items() if self.calibrated or not entry.in_mm}

    @property
    def front_known(self) -> bool:
        """True if a calibration, the settings or rims determine which side of `range_image` faces the camera."""
        return self.calibrated or self._measured.front_known

    @property
    def orders_known(self) -> npt.NDArray[np.bool_]:
        """(regions + 1,) bool: by region, whether its orders are absolute; False for 0, no region."""
        return self._measured.orders.known

    @field("float32", "rad", needs=("unwrapped_phase",), rounding=WRAPPED_PHASE_DIGITS)
    def wrapped_phase(self) -> Floats:
        """Phase in [-pi, pi], corrected and smoothed; NaN outside the mask."""
        phase = self.unwrapped_phase
        return np.asarray(phase - _CYCLE * np.rint(phase / _CYCLE))

    @field("float32", "rad", needs=("unwrapped_phase",), rounding=PHASE_DIGITS)
    def unwrapped_phase(self) -> Floats:
        """The phase with its whole cycles; NaN outside the mask."""
        return self._read(self._measured.surface.unwrapped)

    @field("int32", needs=("mask", "unwrapped_phase"))
    def fringe_order(self) -> npt.NDArray[np.int32]:
        """Whole cycles: unwrapped = wrapped + 2 pi order; 0 outside the mask."""
        return np.rint(np.where(self.mask, self.unwrapped_phase / _CYCLE, 0)).astype(np.int32)

    @field("bool", needs=("mask",))
    def mask(self) -> npt.NDArray[np.bool_]:
        """Lit, modulated, and not between two surfaces: where the other fields hold."""
        measured = self._measured
        return self._read(measured.surface.mask if measured.mask is None else measured.mask).view(np.bool_)

    @field("float32", "grey levels", needs=("modulation",), vertex="modulation", rounding=MODULATION_DIGITS)
    def modulation(self) -> Floats:
        """The fringe's amplitude, in levels of the input."""
        return self._read(self._measured.phases.modulation)

    @field("int32", needs=("region",))
    def region(self) -> npt.NDArray[np.int32]:
        """Connected surfaces from 1, the largest first; 0: none."""
        return self._read(self._measured.surface.region)

    @field("bool", needs=("region",))
    def absolute(self) -> npt.NDArray[np.bool_]:
        """True where the order is absolute, not only relative to its region.

        A plain pattern determines it only where a calibration's depth range leaves a region one order; a coded pattern
        does where a region shows enough of it.
        """
        return self._measured.orders.known[self.region]

    @field("float32", "1", needs=("region",), vertex="order_error_probability")
    def order_error_probability(self) -> Floats:
        """Probability that the order is not the absolute one; NaN outside the mask.

        The same all over a region, and 1 where neither a code, a depth range nor the previous frame determines it.
        """
        return self._measured.orders.error_probability[self.region]

    @field("float32", "rad", needs=("phase_sigma",), vertex="sigma_rad", rounding=SIGMA_DIGITS)
    def phase_sigma(self) -> Floats:
        """One standard deviation of `wrapped_phase`; NaN outside the mask.

        The camera's noise through the chain, and the local error of the light's model, as on a surface of another
        colour than most; scaled to the actual differences of neighbouring rows. Errors that are constant over a whole
        cycle or more are not included.
        """
        return self._read(self._phase_sigma)

    @property
    def stripe_shift_px(self) -> float | None:
        """Shift of the pattern along the stripes from its calibrated place, projector px.

        Only a pattern with the code "contrast2" shows it; None: unknown.
        """
        return self._measured.stripe_shift_px

    @field("float32", "rad", axes=(), needs=("unwrapped_phase",))
    def constant_sigma(self) -> np.float32:
        """One standard deviation of the constant by which all phases may be wrong; it is not in `phase_sigma`.

        Crosstalk that is not as calibrated, or channels that respond differently, show in the channels' waves: they
        turn the phase by about as much as these differ from what they should be. Only what turns all three colours
        alike leaves no trace. NaN without fringes.
        """
        return np.float32(np.hypot(_LEAST_CONSTANT, self._measured.constant_sigma))

    @field("float32", "mm", axes=("y", "x", "xyz"), needs=("points",), in_mm=True)
    def points(self) -> Floats | None:
        """Place in the camera's frame (x right, y down, z forward); NaN outside the mask; only with a calibration."""
        return None if self._measured.surface.points is None else self._read(self._measured.surface.points)

    @field("float32", "mm", needs=("point_sigma",), in_mm=True, vertex="sigma_mm", rounding=SIGMA_DIGITS)
    def point_sigma(self) -> Floats | None:
        """One standard deviation along the pixel's ray, by `phase_sigma`; NaN where there is no point."""
        rays, surface = self._setup.rays, self._measured.surface
        if rays is None or surface.points is None:
            return None
        # Other fields first: whoever holds the device's lock must not wait for a thread that computes a field.
        known = (surface.unwrapped, self._phase_sigma, surface.points)
        with runtime.lock:
            return self._read(point_sigma(*known, rays.rays, rays.projector))

    @field("float32", "range", needs=("points", "mask", "unwrapped_phase"), rounding=RELATIVE_RANGE_DIGITS)
    def range_image(self) -> Floats:
        """Depth in mm with a calibration, else relative, in rad; larger is farther; NaN outside the mask.

        Relative is not metric: the unwrapped phase minus that of the reference, or minus the linear ramp that fits it
        best; times -1 where phase grows towards the camera, as `DecodeSettings.projector_side` or the rims of surfaces
        show (see `front_known`).
        """
        if self.points is not None:
            return np.ascontiguousarray(self.points[..., 2])
        plane = self._setup.reference
        if plane is None:
            plane = _best_ramp(self.unwrapped_phase, self.mask)
        return np.float32(self._measured.range_sign) * (self.unwrapped_phase - plane)

    @field("uint8", axes=("y", "x", "rgb"), needs=("texture",))
    def texture(self) -> npt.NDArray[np.uint8]:
        """The surface's colour without fringes, sRGB, 255 at 1.5 times full scale; 0 outside the mask.

        The camera's picture if the projector sent white: reflectance times shading, room light included. The brightness
        is every pixel's own; the colour is smooth over about a cycle of the fringe, but for edges between surfaces that
        the frame distinguishes. With a calibration, or a crosstalk matrix in the settings, a white surface is neutral;
        else colours are those of the camera's white balance. A frame keeps a copy of its image for it.
        """
        light, surface = self._measured.light, self._measured.surface
        if light is None:
            height, width = self.mask.shape
            return np.zeros((height, width, 3), np.uint8)
        with runtime.lock:
            return self._read(measure_texture(light, self._measured.seen_phase, surface.mask, self.period_px or 1.0))

    @property
    def row_sigma(self) -> Floats:
        """(H, W) float32, rad: `phase_sigma` by what rows really differ by alone, whatever the light's model is."""
        return self._read(self._sigma(None))

    @cached_property
    def _phase_sigma(self) -> F32:
        """`phase_sigma` on the device, stripes along the rows."""
        return self._sigma(self._measured.phases.misfit)

    def _sigma(self, misfit: F32 | None) -> F32:
        """Estimate the standard deviations; without the misfit the light's model is treated as right."""
        phases, surface = self._measured.phases, self._measured.surface
        with runtime.lock:
            known = (surface.unwrapped, phases.precision, phases.variance, misfit, surface.mask)
            found = self._measured.surfaces
            edges = None
            if misfit is not None and isinstance(found, FoundSurfaces):
                edges = edge_variance(found.crosstalk)
            return estimate_phase_sigma(*known, edges, self._setup.smoothing_pairs, self.period_px or 1.0)

    def _read(self, buffer: Array[Any]) -> npt.NDArray[Any]:
        """Return a buffer on the host, turned as the image was."""
        with runtime.lock:
            return runtime.to_host(transpose(buffer) if self._setup.stripes == "vertical" else buffer)


#: Every field of a frame by name: the one table that store, reader, meshes and docs take them from.
FIELDS = fields_of(DecodedFrame)


def memory_of(frame: DecodedFrame) -> FrameMemory:
    """Return the state of a frame that the next one of a video may use."""
    measured = frame._measured
    surface = replace(measured.surface, unwrapped=measured.seen_phase)
    return FrameMemory(frame._setup.stripes, surface, measured.orders, measured.surfaces, measured.fields)


def read_back(frame: DecodedFrame, fields: Iterable[str]) -> None:
    """Read the data of a frame's fields from the device now; reading the fields later does not access it."""
    for name in {needed for wanted in fields for needed in FIELDS[wanted].needs}:
        getattr(frame, name)


def buffers_of(frame: DecodedFrame, shape: tuple[int, int], setup: FrameSetup) -> tuple[PhaseBuffers, SurfaceBuffers]:
    """Return a frame's buffers, to be written again for an image of a shape.

    Raises
    ------
    ShapeError
        They do not fit.
    """
    there = (frame._measured.surface.mask.shape, frame._setup.stripes, frame.calibrated)
    if there != (shape, setup.stripes, setup.rays is not None):
        raise ShapeError("out is of another size, stripes or calibration: leave it away for this frame")
    return frame._measured.phases, frame._measured.surface


@contextmanager
def emptied_on_error(frame: DecodedFrame) -> Iterator[None]:
    """Leave nothing in a frame that was to be written again and could not."""
    try:
        yield
    except BaseException:
        phases, surface = frame._measured.phases, frame._measured.surface
        clear_buffers(phases, surface)
        refill(frame, replace(frame, _measured=Measured(phases, surface)))
        raise


def refill(frame: DecodedFrame, other: DecodedFrame) -> DecodedFrame:
    """Let a frame hold all that another one does, and forget what has been read; return it."""
    vars(frame).clear()
    vars(frame).update(vars(other))
    return frame


def _best_ramp(phase: Floats, mask: npt.NDArray[np.bool_]) -> Floats:
    """(H, W) float32: the least-squares plane through the masked phase, at every pixel."""
    height, width = phase.shape
    y, x = np.nonzero(mask)
    if len(y) < 3:
        return np.zeros(phase.shape, np.float32)
    # Centred coordinates keep the normal equations well conditioned.
    columns = np.stack([np.ones(len(y)), y - (height - 1) / 2, x - (width - 1) / 2])
    offset, down, right = np.linalg.lstsq(columns @ columns.T, columns @ phase[mask].astype(np.float64))[0]
    ramp = offset + down * (np.arange(height)[:, None] - (height - 1) / 2)
    return np.asarray(ramp + right * (np.arange(width) - (width - 1) / 2), np.float32)
