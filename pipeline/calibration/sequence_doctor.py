"""What only a sequence of frames shows: a beat with the projector's colour cycle, and motion between its fields.

A projector with a colour wheel, or with sequential LEDs, shows red, green and blue one after another. If the exposure
is no whole number of its cycles, each frame catches another share of each colour, which beats from frame to frame. And
what moves is in another place in each colour: the channels' phases differ by the speed times the time between two
fields, which one frame cannot tell from lateral colour; over frames of different speeds the slope is motion, the rest
lateral.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.calibration.captures import Picture
from pipeline.calibration.channel_spectra import PHASES, fit_tiles, smooth_phase
from pipeline.calibration.doctor import Finding
from pipeline.calibration.model import Geometry
from pipeline.models import FloatArray

_MIN_FRAMES, _MIN_TILES = 12, 8
# A peak of a spectrum of noise exceeds its mean by this factor once in a thousand sequences.
_PEAK = 12.0
# Below this part a beat is not worth a word: it bends the phase by less than 3 mrad.
_LEAST_BEAT, _LEAST_STEP_RAD = 0.01, 0.003
_SIGMAS = 5.0


def diagnose_sequence(
    images: Sequence[Picture],
    white_level: float,
    unwrapped_phases: Sequence[npt.NDArray[np.float32]],
    masks: Sequence[npt.NDArray[np.bool_]],
    geometry: Geometry | None = None,
) -> tuple[Finding, ...]:
    """Say what changes from frame to frame that should not.

    Parameters
    ----------
    images : sequence of (H, W, 3)
        At least twelve frames one after another, linear light, levels.
    white_level : float
        Full scale.
    unwrapped_phases : sequence of (H, W) float32
        rad.
    masks : sequence of (H, W) bool
        Where they hold.
    geometry : Geometry, optional
        The rig; with it the depth bias is told in mm.

    Returns
    -------
    tuple of Finding
        Empty: fine, or too few frames to tell.
    """
    if len(images) < _MIN_FRAMES:
        return ()
    lit = [mask & np.isfinite(phase) for mask, phase in zip(masks, unwrapped_phases, strict=True)]
    if min(np.count_nonzero(mask) for mask in lit) < 1000:
        return ()
    means = np.array([image[mask].mean(axis=0) for image, mask in zip(images, lit, strict=True)]) / white_level
    found = [_beat(means)]
    found.append(_motion(images, white_level, unwrapped_phases, lit, geometry))
    return tuple(finding for finding in found if finding is not None)


def _beat(means: FloatArray) -> Finding | None:
    """Find a line in the spectrum of the colours' ratios; brightness and the scene change all colours together."""
    ratios = np.log(np.maximum(means[:, ::2], 1e-6) / np.maximum(means[:, 1:2], 1e-6))
    frames = np.arange(len(ratios))
    drift = np.polynomial.polynomial.polyfit(frames, ratios, 2)
    rest = ratios - np.polynomial.polynomial.polyval(frames, drift).T
    power = (np.abs(np.fft.rfft(rest * np.hanning(len(rest))[:, None], axis=0)) ** 2).sum(axis=1)[2:]
    peak = int(np.argmax(power))
    # A line fills three bins of a Hann window's spectrum.
    others = np.delete(power, np.arange(max(peak - 2, 0), min(peak + 3, len(power))))
    amplitude = float(np.sqrt(2) * rest.std(axis=0).max())
    if len(others) == 0 or power[peak] < _PEAK * np.mean(others) or amplitude < _LEAST_BEAT:
        return None
    rate = (peak + 2) / len(rest)
    return Finding(
        causes=("colour-cycle beat",),
        size=f"the colours beat by {amplitude:.1%}, {rate:.3f} times a frame",
        ripple_rad={1: 0.72 * amplitude},
        confidence=0.95,
        advice="expose for a whole number of the projector's colour cycles, or let the projector trigger the camera",
    )


def _motion(
    images: Sequence[Picture],
    white_level: float,
    unwrapped_phases: Sequence[npt.NDArray[np.float32]],
    lit: Sequence[npt.NDArray[np.bool_]],
    geometry: Geometry | None,
) -> Finding | None:
    """Compare the phase from one colour to the next with the phase from one frame to the next."""
    steps, speeds = [], []
    for k in range(1, len(images) - 1):
        moved = unwrapped_phases[k + 1] - unwrapped_phases[k - 1]
        moved = moved[lit[k + 1] & lit[k - 1]]
        phase, usable, period = smooth_phase(unwrapped_phases[k], lit[k])
        tiles = fit_tiles(images[k].astype(np.float64) / white_level, phase, usable, period)
        if len(tiles.mean) < _MIN_TILES or len(moved) < 1000:
            continue
        turned = tiles.spectrum[..., 0] * np.exp(-1j * PHASES)
        # From red to green as from green to blue; lateral colour that is not so cancels.
        steps.append(float(np.median(np.angle(turned[:, 2] * np.conj(turned[:, 0])))) / 2)
        whole = 2 * np.pi * np.round(np.median(moved) / (2 * np.pi))  # a new start may have another order
        speeds.append(float(np.median(moved) - whole) / 2)
    if len(steps) < _MIN_FRAMES // 2 or np.ptp(speeds) < 0.01:
        return None
    system = np.stack([np.ones(len(speeds)), speeds], axis=1)
    (lateral, share), *_ = np.linalg.lstsq(system, np.array(steps), rcond=None)
    rest = np.array(steps) - system @ (lateral, share)
    error = np.sqrt((rest @ rest) / (len(steps) - 2) * np.linalg.inv(system.T @ system)[1, 1])
    worst = float(share * speeds[int(np.argmax(np.abs(speeds)))])
    if abs(share) < _SIGMAS * error or abs(worst) < _LEAST_STEP_RAD:
        return None
    bias = f"{abs(worst):.3f} rad"
    if geometry is not None:
        bias += f" ({abs(worst) / rad_per_mm(geometry):.2f} mm)"
    return Finding(
        causes=("motion between colour fields",),
        size=f"{share:.3f} frames from one colour to the next: up to {bias} of bias from the first colour's time",
        ripple_rad={2: 0.6 * abs(worst)},
        confidence=float(min(0.99, 1 - np.exp(-abs(share) / max(error, 1e-12) / 5))),
        advice="show all colours at once, or a faster cycle; what is left when nothing moves is lateral colour",
    )


def rad_per_mm(geometry: Geometry) -> float:
    """Return how much the phase changes with depth on the camera's axis, where the two axes meet."""
    depth = geometry.working_distance_mm() or 1000.0
    axis, lens = geometry.phase_axis, geometry.projector

    def coordinate(z: float) -> float:
        place = geometry.rotation @ np.array([0.0, 0.0, z]) + geometry.translation_mm
        return float(lens.matrix[axis, axis] * place[axis] / place[2])

    return abs(coordinate(depth + 0.5) - coordinate(depth - 0.5)) * 2 * np.pi / geometry.pattern.period_px
