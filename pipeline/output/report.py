"""The quality of a result in numbers: ``report.json``, and the error of a simulated frame's result."""

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.decoding.frame import DecodedFrame
from pipeline.decoding.frame_fields import FrameFields
from pipeline.simulation import SimulatedFrame
from pipeline.text import one_line
from tikernels import runtime
from tikernels.depth.triangulation import triangulate

# Pixels count for measuring that are brighter than this, 8-bit levels; with the rim below, the convention of
# `docs/accuracy.md`.
_LIT_LEVELS = 20.0
# And that lie further than this inside the rim of what is lit: filters see nothing on one side there.
_RIM_PX = 4


def frame_report(frame: DecodedFrame, source: str) -> dict[str, Any]:
    """Return what ``report.json`` holds of one decoded frame."""
    calibration = frame.calibration
    sizes = np.bincount(frame.region.ravel())[1:]
    values = frame.range_image[frame.mask]
    values = values[np.isfinite(values)]
    return {
        "source": one_line(source),
        **frame.attributes,
        "scale_proof": None if calibration is None else calibration.scale_proof,
        "arch": runtime.started(),
        "kernel_language": runtime.kernel_language(),
        "image_px": list(frame.mask.shape[::-1]),
        "camera_period_px": frame.period_px,
        "noise_levels": frame.noise_levels,
        "valid_fraction": float(frame.mask.mean()),
        "regions_px": sizes.tolist(),
        "orders_are_absolute": bool(frame.absolute[frame.mask].all()) if frame.mask.any() else False,
        "range_unit": frame.range_unit,
        "front_known": frame.front_known,
        "range_percentiles_1_50_99": np.percentile(values, (1, 50, 99)).tolist() if len(values) else None,
        "phase_constant_known": frame.constant_known,
        "phase_constant_sigma_rad": float(frame.constant_sigma) if np.isfinite(frame.constant_sigma) else None,
        "stripe_shift_px": frame.stripe_shift_px,
        "warnings": list(frame.warnings),
    }


def depth_in_words(frame: FrameFields, *, front_known: bool) -> str | None:
    """Say between what a frame's depth is only relative, and what would determine it; None: every order is absolute.

    Parameters
    ----------
    frame : FrameFields
        Decoded, or stored with as many of its fields as there are.
    front_known : bool
        Whether it is clear which side of what is seen faces the camera.
    """

    def read(name: str) -> npt.NDArray[Any] | None:
        return getattr(frame, name) if name in frame.fields else None

    mask, absolute, region = read("mask"), read("absolute"), read("region")
    if mask is not None and not mask.any():
        return None
    if not frame.calibrated:
        guess = "; which side is in front is a guess: projector_side in the settings states it"
        return (
            "depth is relative, in rad of phase and not in mm: give a --calibration with the rig's geometry"
            f"{'' if front_known else guess}"
        )
    if mask is None or absolute is None or not (unknown := mask & ~absolute).any():
        return None
    single = region is not None and len(np.unique(region[unknown])) == 1
    which = "the surface" if single else "each surface"
    per_rad = mm_per_rad(frame, unknown)
    cycle = "" if per_rad is None else f", about {2 * np.pi * per_rad:.2g} mm each"
    share = unknown.sum() / mask.sum()
    part = "less than 1%" if share < 0.005 else f"{share:.0%}"
    return (
        f"depth is relative on {part} of the pixels: {which} there may be off by whole "
        f"cycles{cycle}; a pattern with the code or a --depth-range determines it"
    )


def mm_per_rad(frame: FrameFields, where: npt.NDArray[np.bool_]) -> float | None:
    """Return how far a point moves along its ray with a rad of phase, the median; None: unknown.

    Parameters
    ----------
    frame : FrameFields
        Decoded, or stored with as many of its fields as there are.
    where : (H, W) bool
        Of which pixels.
    """
    if not frame.calibrated or not {"phase_sigma", "point_sigma"} <= frame.fields.keys():
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = (np.asarray(frame.point_sigma) / frame.phase_sigma)[where]
    known = ratios[np.isfinite(ratios)]
    return float(np.median(known)) if known.size else None


def measure_against_truth(frame: DecodedFrame, truth: SimulatedFrame) -> dict[str, float | int]:
    """Return how far a result is from the truth it was simulated from.

    Parameters
    ----------
    frame : DecodedFrame
        The result; with a calibration its depth is measured too.
    truth : SimulatedFrame
        The frame and its truth.

    Returns
    -------
    dict
        ``phase_rms_rad`` over the lit pixels (brighter than 20 levels, 4 px inside the lit area), one constant, given
        as ``phase_constant_rad``, removed; ``coverage``, the share of those pixels that have a result;
        ``wrong_orders``, pixels whose order is not their region's commonest; and with a calibration, over the same
        pixels, ``depth_rms_mm``, ``depth_bias_mm`` and ``depth_p999_mm``, RMS, mean and 99.9th percentile of the depth
        error as it is,
        ``absolute``, the share of the lit pixels whose order is said to be absolute, and
        ``depth_rms_order_known_mm``, as if each region's commonest order were its true one.
    """
    brightness = truth.image.mean(axis=2) * (255.0 / truth.white_level)
    square = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)
    inside = cv2.erode(truth.mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    lit = (inside != 0) & (brightness > _LIT_LEVELS)
    valid = lit & frame.mask
    measured: dict[str, float | int] = {"coverage": float(valid.sum() / max(lit.sum(), 1))}
    if not valid.any():
        return measured
    error = np.where(valid, frame.unwrapped_phase - truth.phase, 0.0)
    constant = float(np.angle(np.exp(1j * error[valid]).mean()))
    wrapped = np.angle(np.exp(1j * (error[valid] - constant)))
    measured["phase_rms_rad"] = float(np.sqrt(np.mean(wrapped**2)))
    measured["phase_constant_rad"] = constant
    cycles = np.rint((error - constant) / (2 * np.pi)).astype(int)
    region = np.where(valid, frame.region, 0)
    wrong, commonest = 0, np.full(valid.shape, np.nan)
    for number in np.flatnonzero(np.bincount(region.ravel())[1:]) + 1:
        here = region == number
        values, counts = np.unique(cycles[here], return_counts=True)
        commonest[here] = values[np.argmax(counts)]
        wrong += int(here.sum() - counts.max())
    measured["wrong_orders"] = wrong
    if frame.points is not None:
        geometry = truth.rig.geometry()
        placed = (frame.unwrapped_phase - 2 * np.pi * commonest).astype(np.float32)
        points = runtime.to_host(triangulate(placed, geometry.camera.rays(), geometry.for_triangulation()))
        off, order_known = ((found - truth.points)[valid][:, 2].astype(np.float64) for found in (frame.points, points))
        measured["depth_rms_mm"] = float(np.sqrt(np.nanmean(off**2)))
        measured["depth_bias_mm"] = float(np.nanmean(off))
        measured["depth_p999_mm"] = float(np.nanquantile(np.abs(off), 0.999))
        measured["depth_rms_order_known_mm"] = float(np.sqrt(np.nanmean(order_known**2)))
        measured["absolute"] = float((lit & frame.absolute).sum() / lit.sum())
    return measured
