"""Wrapped phases of known surfaces, and what becomes of them on the way to regions."""

import numpy as np
import numpy.typing as npt
import reference

from tikernels import runtime
from tikernels.phase.phase_change import MEAN_QUALITY, RATE_ACROSS, RATE_ALONG, measure_rates
from tikernels.unwrapping.given_regions import GivenRegions
from tikernels.unwrapping.patches import Patches
from tikernels.unwrapping.tables import CELL_HEIGHT, CELL_WIDTH, ORDER_BITS, ORDER_MASK, ORDER_ZERO
from tikernels.unwrapping.unwrapper import RegionUnwrapper

Floats = npt.NDArray[np.float64]
Phase = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]


def surface(height: int = 97, width: int = 131) -> Floats:
    """Return the phase (rad) of a bump on a plane that a step of 2.2 rad cuts in two."""
    y, x = np.mgrid[:height, :width]
    bump = 3 * np.exp(-((y - 50) ** 2 + (x - 60) ** 2) / 800)
    return np.asarray(reference.ramp(height, width, 12.0, tilt=0.03) + bump + 2.2 * (x > 90))


def holes(shape: tuple[int, int], rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    """Return a mask with a round hole and single pixels missing."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.asarray((rng.random(shape) > 0.02) & ((y - 30) ** 2 + (x - 40) ** 2 > 150))


def orders(unwrapped: Phase, wrapped: Phase) -> Integers:
    """Return whole cycles, 0 where the phase is not unwrapped; the rest must be none of them."""
    cycles = np.nan_to_num((unwrapped.astype(np.float64) - wrapped) / (2 * np.pi))
    assert np.abs(cycles - np.rint(cycles)).max() < 1e-5
    return np.rint(cycles).astype(int)


def flat_rates(along: float = 0.0, across: float = 0.0, mean_quality: float = 1.0) -> Phase:
    """Return what `measure_rates` would find on a surface with these changes, rad a pixel."""
    rates = np.zeros((1, 5), np.float32)
    rates[0, RATE_ALONG], rates[0, RATE_ACROSS], rates[0, MEAN_QUALITY] = along, across, mean_quality
    return rates


def join(phase: Phase, quality: Phase | None = None, given: GivenRegions | None = None) -> tuple[Patches, Phase]:
    """Return the patches of a wrapped phase, joined to regions, and the phase's rates."""
    quality = np.ones(phase.shape, np.float32) if quality is None else quality
    rates = measure_rates(phase, quality)
    return RegionUnwrapper(*phase.shape, given).join(phase, quality, rates), rates


def written(patches: Patches, phase: Phase, rates: Phase) -> tuple[Phase, npt.NDArray[np.uint8], npt.NDArray[np.int32]]:
    """Return the unwrapped phase, the mask and the region that patches make."""
    outputs = tuple(runtime.empty(phase.shape, dtype) for dtype in (np.float32, np.uint8, np.int32))
    patches.write(phase, np.ones(phase.shape, np.float32), rates, *outputs)
    unwrapped, mask, region = (np.array(runtime.to_host(output)) for output in outputs)
    return unwrapped, mask, region


def cell_of(shape: tuple[int, int]) -> Integers:
    """Return the cell of every pixel."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.asarray((y // CELL_HEIGHT) * -(-shape[1] // CELL_WIDTH) + x // CELL_WIDTH)


def drafts_and_orders(labels: npt.NDArray[np.int32]) -> tuple[Integers, Integers]:
    """Return the draft of every pixel's patch, -1 where there is none, and its order in the patch."""
    patched = labels >= 0
    drafts = np.where(patched, labels >> ORDER_BITS, -1).astype(np.int64)
    return drafts, np.where(patched, (labels & ORDER_MASK) - ORDER_ZERO, 0).astype(np.int64)
