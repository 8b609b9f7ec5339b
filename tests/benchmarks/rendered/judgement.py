"""How far a decoded frame is from its truth, surface by surface."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from camera_film import Truth
from ray_samples import NOTHING

from pipeline.decoding.frame import DecodedFrame

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

#: Surfaces of fewer judged pixels are left out.
MIN_SURFACE_PX = 2000
# Pixels count that are brighter than this, of 255, and further than this from the end of the lit area.
_LIT_LEVELS = 20.0
_RIM_PX = 4


@dataclass(frozen=True)
class Verdict:
    """Figures of one surface; phases in rad."""

    surface: str
    pixels: int  # judged ones that have a phase
    coverage: float  # share of the judged pixels that have one
    rms: float  # of all judged pixels, one constant removed
    constant: float  # circular mean of the error
    rms_inside: float  # the same two, of those further than 4 px from other surfaces
    constant_inside: float
    rms_inside_with_constant: float
    harmonics: tuple[float, float, float]  # amplitudes of the error over the true phase, inside
    pull: float  # RMS of the error over its sigma inside, constant removed
    within_two: float  # share of errors inside that are less than two sigma
    depth_rms_mm: float  # that the error inside makes, constant included


def judged(frame_levels: npt.NDArray[np.floating], truth: Truth) -> Mask:
    """Return which pixels are judged, from the levels, 0..255, of the frame (H, W, 3)."""
    return _deeper(truth.lit, _RIM_PX) & (frame_levels.mean(axis=2) > _LIT_LEVELS)


def _deeper(mask: Mask, px: float) -> Mask:
    """Return where a mask is further than a number of pixels from where it is not; the image's edge does not count."""
    return cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) > px


def judge(
    frame: DecodedFrame, levels: npt.NDArray[np.floating], truth: Truth, names: tuple[str, ...], period_px: float
) -> list[Verdict]:
    """Return the figures of the whole frame, as the surface "all", and of every surface that is large enough.

    Parameters
    ----------
    frame : DecodedFrame
        What came of it.
    levels : (H, W, 3) float
        The image in levels of 0..255.
    truth : Truth
        Its truth.
    names : tuple of str
        The surfaces', by number.
    period_px : float
        Projector px a cycle.
    """
    looked_at = judged(levels, truth)
    phase = np.where(truth.surface == NOTHING, 0.0, 2 * np.pi / period_px * truth.projector_row)
    error = np.angle(np.exp(1j * (np.where(frame.mask, frame.wrapped_phase, 0.0) - phase)))
    masks = {name: truth.surface == number for number, name in enumerate(names)}
    inner = {name: _deeper(mask, _RIM_PX) for name, mask in masks.items()}
    everything = [("all", looked_at, looked_at & np.logical_or.reduce(list(inner.values())))]
    everything += [(name, looked_at & masks[name], looked_at & inner[name]) for name in names]
    verdicts = []
    for name, whole, inside in everything if len(names) > 1 else everything[1:]:
        seen, seen_inside = whole & frame.mask, inside & frame.mask
        if min(np.count_nonzero(seen), np.count_nonzero(seen_inside)) < MIN_SURFACE_PX:
            continue
        rms, constant = spread(error[seen])
        rms_inside, constant_inside = spread(error[seen_inside])
        centred = np.angle(np.exp(1j * (error[seen_inside] - constant_inside)))
        with np.errstate(divide="ignore"):  # a sigma of zero is infinitely wrong, not left out
            pull = centred / frame.phase_sigma[seen_inside]
        waves = [2 * abs(np.mean(centred * np.exp(-1j * n * phase[seen_inside]))) for n in (1, 2, 3)]
        verdicts.append(
            Verdict(
                surface=name,
                pixels=int(np.count_nonzero(seen)),
                coverage=float(np.count_nonzero(seen) / np.count_nonzero(whole)),
                rms=rms,
                constant=constant,
                rms_inside=rms_inside,
                constant_inside=constant_inside,
                rms_inside_with_constant=float(np.hypot(rms_inside, constant_inside)),
                harmonics=(waves[0], waves[1], waves[2]),
                pull=float(np.sqrt((pull**2).mean())),
                within_two=float((np.abs(pull) < 2).mean()),
                depth_rms_mm=float(np.sqrt(((error * truth.mm_per_rad)[seen_inside] ** 2).mean())),
            )
        )
    return verdicts


def spread(error: Floats) -> tuple[float, float]:
    """Return the RMS of phase errors with one constant removed, and that constant."""
    constant = float(np.angle(np.exp(1j * error).mean()))
    return float(np.sqrt((np.angle(np.exp(1j * (error - constant))) ** 2).mean())), constant
