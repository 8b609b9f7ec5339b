"""What decoding a frame gives."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels.depth.point_uncertainty import point_sigma
from tikernels.depth.triangulation import ProjectorGeometry
from tikernels.phase.uncertainty import estimate_phase_sigma
from tikernels.transposing import transpose

# A frame's constant is never known better, rad: what balance and ambient light leave of it on clean frames.
_LEAST_CONSTANT = 0.0006
# The smoothing's bias is taken from second differences over so many px, most of whose noise averages out, in every
# fourth row.
_BEND_PX, _BEND_ROWS = 6, 4
# What the device has to be asked for each field.
_MADE_OF = {
    "wrapped_phase": ("mask", "_phase"),
    "unwrapped_phase": ("unwrapped_phase",),
    "fringe_order": ("mask", "_phase", "unwrapped_phase"),
    "mask": ("mask",),
    "modulation": ("modulation",),
    "region": ("region",),
    "absolute": ("region",),
    "order_error_probability": ("mask", "region"),
    "phase_sigma": ("phase_sigma",),
    "constant_sigma": ("unwrapped_phase",),
    "points": ("points",),
    "point_sigma": ("point_sigma",),
    "range_image": ("points", "mask", "unwrapped_phase"),
}


@dataclass(eq=False)
class DecodedFrame:
    """A decoded frame: every pixel's phase, its order and, with a calibration, its place.

    The fields are NumPy arrays, read back from the device when they are first looked at.
    """

    period_px: float | None
    """Camera px a cycle that the frame was decoded with; None: no fringe was found."""
    noise_levels: float
    """Standard deviation of a channel where the frame is half as bright as at its brightest, grey levels."""
    warnings: tuple[str, ...]
    """What the user should know about this frame."""
    calibrated: bool
    """Whether `range_image` is a depth in mm."""
    constant_known: bool
    """Whether the phase is known, not only but for one constant: crosstalk that is not known turns it about grey."""
    _vertical: bool
    _buffers: dict[str, Any] = field(repr=False)  # stripes along the rows, on the device
    _constant_sigma: float = field(default=np.nan, repr=False)  # rad, by the light
    _pairs: int = field(default=0, repr=False)  # neighbours on either side that the smoothing averages over
    _rig: tuple[Any, ProjectorGeometry] | None = field(default=None, repr=False)  # rays as the buffers lie, projector
    _histogram: npt.NDArray[np.float64] | None = field(default=None, repr=False)  # of bare phases, earlier frames'
    # too
    _placed: tuple[npt.NDArray[np.bool_], npt.NDArray[np.float32]] | None = field(default=None, repr=False)
    _reference: npt.NDArray[np.float32] | None = field(default=None, repr=False)

    @cached_property
    def wrapped_phase(self) -> npt.NDArray[np.float32]:
        """(H, W) float32: rad in [-pi, pi], corrected and smoothed; NaN outside the mask."""
        phase = self._phase
        phase = phase - np.float32(2 * np.pi) * np.rint(phase / np.float32(2 * np.pi))
        return np.where(self.mask, phase, np.float32(np.nan))

    @cached_property
    def unwrapped_phase(self) -> npt.NDArray[np.float32]:
        """(H, W) float32: rad; NaN outside the mask."""
        return self._read("unwrapped")

    @cached_property
    def fringe_order(self) -> npt.NDArray[np.int32]:
        """(H, W) int32: unwrapped = wrapped + 2 pi order; 0 outside the mask."""
        cycles = (self.unwrapped_phase - self.wrapped_phase) / np.float32(2 * np.pi)
        return np.rint(np.where(self.mask, cycles, 0)).astype(np.int32)

    @cached_property
    def mask(self) -> npt.NDArray[np.bool_]:
        """(H, W) bool: where the other fields hold."""
        return self._read("mask").view(np.bool_)

    @cached_property
    def modulation(self) -> npt.NDArray[np.float32]:
        """(H, W) float32: the fringe's amplitude in grey levels of the input."""
        return self._read("modulation")

    @cached_property
    def region(self) -> npt.NDArray[np.int32]:
        """(H, W) int32: connected surfaces from 1, the largest first; 0: none."""
        return self._read("region")

    @property
    def order_is_known(self) -> npt.NDArray[np.bool_]:
        """(regions + 1,) bool: by region, whether its orders are absolute; False for 0, no region."""
        return np.zeros(1, np.bool_) if self._placed is None else self._placed[0]

    @cached_property
    def absolute(self) -> npt.NDArray[np.bool_]:
        """(H, W) bool: whether the order is known, not only relative to its region.

        A plain pattern tells only where a calibration's depth range leaves a region one order; a coded pattern does
        where a region shows enough of it.
        """
        return self.order_is_known[self.region]

    @cached_property
    def order_error_probability(self) -> npt.NDArray[np.float32]:
        """(H, W) float32: probability, 0..1, that the order is not the absolute one; NaN outside the mask.

        The same all over a region, and 1 where neither a code, a depth range nor the frame before tells.
        """
        if self._placed is None:
            return np.where(self.mask, np.float32(1), np.float32(np.nan))
        return self._placed[1][self.region]

    @cached_property
    def phase_sigma(self) -> npt.NDArray[np.float32]:
        """(H, W) float32: rad, one standard deviation of `wrapped_phase`; NaN outside the mask.

        The camera's noise through the chain, scaled to what neighbouring rows really differ by, which also sees the
        ripple that balance and crosstalk leave; what is the same over a whole cycle and more, as near an edge, is not
        in it.
        """
        return self._host(self._phase_sigma)

    @cached_property
    def constant_sigma(self) -> np.float32:
        """Standard deviation of the constant by which all phases may be wrong, rad; it is not in `phase_sigma`.

        Crosstalk that is not as calibrated, or channels that respond differently, show in the channels' waves: they
        turn the phase by about as much as these differ from what they should be. Only what turns all three colours
        alike leaves no trace. Smoothing adds its bias on surfaces that bend along the stripes. NaN without fringes.
        """
        phase = (self.unwrapped_phase.T if self._vertical else self.unwrapped_phase)[::_BEND_ROWS]
        bias = 0.0
        if self._pairs and phase.shape[1] > 2 * _BEND_PX:
            bend = phase[:, 2 * _BEND_PX :] - 2 * phase[:, _BEND_PX:-_BEND_PX] + phase[:, : -2 * _BEND_PX]
            smooth = np.abs(bend) < 1  # more is a step
            if smooth.any():
                # A window of n px has a variance of (n^2 - 1) / 12, and n = 2 pairs + 1.
                bias = float(bend[smooth].mean()) / _BEND_PX**2 * self._pairs * (self._pairs + 1) / 6
        return np.float32(np.sqrt(_LEAST_CONSTANT**2 + bias**2 + self._constant_sigma**2))

    @cached_property
    def point_sigma(self) -> npt.NDArray[np.float32] | None:
        """(H, W) float32: mm along the pixel's ray, one standard deviation by `phase_sigma`.

        NaN where there is no point; None without a calibration.
        """
        if self._rig is None:
            return None
        rays, projector = self._rig
        known = (self._buffers["unwrapped"], self._phase_sigma, self._buffers["points"])
        return self._host(point_sigma(*known, rays, projector))

    @cached_property
    def points(self) -> npt.NDArray[np.float32] | None:
        """(H, W, 3) float32: mm in the camera's frame; NaN outside the mask; None without a calibration."""
        return self._read("points") if self.calibrated else None

    @cached_property
    def range_image(self) -> npt.NDArray[np.float32]:
        """(H, W) float32: depth in mm with a calibration, else relative, in rad; NaN outside the mask.

        Relative is the unwrapped phase minus that of the reference, or minus the linear ramp that fits it best.
        """
        if self.points is not None:
            return np.ascontiguousarray(self.points[..., 2])
        if self._reference is not None:
            return self.unwrapped_phase - self._reference
        return self.unwrapped_phase - _best_ramp(self.unwrapped_phase, self.mask)

    @cached_property
    def _phase(self) -> npt.NDArray[np.float32]:
        return self._read("phase")

    @cached_property
    def _phase_sigma(self) -> Any:
        """`phase_sigma` on the device, stripes along the rows."""
        known = (self._buffers["unwrapped"], self._buffers["precision"], self._buffers["mask"])
        return estimate_phase_sigma(*known, self._pairs, self.period_px or 1.0)

    def fetch(self, fields: Iterable[str]) -> None:
        """Read from the device what these fields are made of: another thread may then look at them."""
        for name in {part for wanted in fields for part in _MADE_OF[wanted]}:
            getattr(self, name)

    def _read(self, name: str) -> npt.NDArray[Any]:
        return self._host(self._buffers[name])

    def _host(self, buffer: Any) -> npt.NDArray[Any]:
        return runtime.to_host(transpose(buffer) if self._vertical else buffer)

    def _forget(self) -> None:
        """Drop what has been read, because the buffers are written again."""
        for name in list(vars(self)):
            if isinstance(getattr(type(self), name, None), cached_property):
                del self.__dict__[name]


def _best_ramp(phase: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
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
