"""The code that a pattern may carry: the contrast of each cycle is one symbol of a sequence that never repeats.

Every cycle is as bright as the projector can be where it is brightest, so that less contrast costs as little modulation
as possible: the background is 1 - modulation. Both go in straight lines from the middle of one cycle to the middle of
the next. Their spectra then have a double zero at one a cycle, so the code hardly leaks into the balance of the
channels, which tells the surface's colour; and there is no edge that blur could soften. `docs/coded_pattern.md`
derives symbols and sequence.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

#: Contrast of the three symbols, modulation over background; a plain pattern's is 1.
CONTRASTS = (0.72, 0.86, 1.0)
#: One digit a cycle, from the projector's first row (or column) on. No two stretches of five cycles change alike.
SYMBOLS = (
    "02110212222212202220002020101200122102022110011202100200012120200212102101210002202120122012011220022120"
    "00021022001002222020211201022210"
)
CYCLES = len(SYMBOLS)
# Responses of which the code's levels are known, the weakest one first.
_GAMMAS = (3.0, 2.6, 2.3, 2.0, 1.8, 1.6, 1.4, 1.2, 1.0, 0.8)


def cycle_contrasts() -> npt.NDArray[np.float64]:
    """Return the (CYCLES,) contrast in the middle of each cycle."""
    return np.array(CONTRASTS)[[int(symbol) for symbol in SYMBOLS]]


def modulation_at(cycles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the pattern's modulation at a phase in cycles, as a fraction of full scale."""
    contrasts = cycle_contrasts()
    return np.asarray(np.interp(cycles, np.arange(CYCLES), contrasts / (1 + contrasts)))


@cache
def _levels_by_response() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the (R,) strengths of the code by responses of different gamma, rising, and the (R, CYCLES) levels."""
    within = np.linspace(-0.5, 0.5, 129)  # cycles
    weight = (1 - (2 * within) ** 2) ** 2
    projected = modulation_at(np.arange(CYCLES)[:, None] + within)
    # What of the light's own cycle is background and modulation, for every modulation of the codes.
    modulations = np.linspace(projected.min(), projected.max(), 65)
    wave = np.cos(2 * np.pi * np.arange(64) / 64)
    codes = np.maximum(1 - modulations[:, None] * (1 - wave), 0)
    levels = []
    for gamma in _GAMMAS:
        background, modulation = (codes**gamma).mean(axis=1), 2 * (codes**gamma * wave).mean(axis=1)
        seen = [np.interp(projected, modulations, values) @ weight for values in (modulation, background)]
        levels.append(np.log(seen[0] / seen[1]))
    spans = np.ptp(levels, axis=1)
    return spans / np.ptp(levels[_GAMMAS.index(1.0)]), np.array(levels)


def contrast_levels(strength: float = 1.0) -> npt.NDArray[np.float64]:
    """Return the logarithm of each cycle's contrast, as it is read.

    A cycle's contrast is `measure_contrast_kernel`'s, to which its neighbours' symbols contribute 8 % each. In linear
    light the strength is 1. A response that is not linear makes the differences smaller, and more so between the
    symbols of high contrast: the levels are those of the gamma that leaves this strength.

    Parameters
    ----------
    strength : float
        By how much the levels differ beside those in linear light; 0: there is no code.

    Returns
    -------
    (CYCLES,) float64
        Natural logarithm.
    """
    strengths, levels = _levels_by_response()
    within = min(max(strength, strengths[0]), strengths[-1])
    row = min(int(np.searchsorted(strengths, within, side="right")) - 1, len(strengths) - 2)
    share = (within - strengths[row]) / (strengths[row + 1] - strengths[row])
    return np.asarray((strength / within) * ((1 - share) * levels[row] + share * levels[row + 1]))


def contrast_steps(strength: float = 1.0) -> npt.NDArray[np.float64]:
    """Return by how much `contrast_levels` rises from each cycle to the next, (CYCLES - 1,) float64."""
    return np.diff(contrast_levels(strength))
