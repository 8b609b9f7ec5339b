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


def cycle_contrasts() -> npt.NDArray[np.float64]:
    """Return the (CYCLES,) contrast in the middle of each cycle."""
    return np.array(CONTRASTS)[[int(symbol) for symbol in SYMBOLS]]


def modulation_at(cycles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the pattern's modulation at a phase in cycles, as a fraction of full scale."""
    contrasts = cycle_contrasts()
    return np.asarray(np.interp(cycles, np.arange(CYCLES), contrasts / (1 + contrasts)))


@cache
def contrast_levels() -> npt.NDArray[np.float64]:
    """Return the logarithm of each cycle's contrast, as it is read.

    A cycle's contrast is `measure_contrast_kernel`'s, to which its neighbours' symbols contribute 8 % each. The light
    is assumed to be proportional to the codes; a response that is not makes the differences smaller, all alike.

    Returns
    -------
    (CYCLES,) float64
        Natural logarithm.
    """
    within = np.linspace(-0.5, 0.5, 129)
    weight = (1 - (2 * within) ** 2) ** 2
    mean = modulation_at(np.arange(CYCLES)[:, None] + within) @ weight / weight.sum()
    return np.asarray(np.log(mean / (1 - mean)))


@cache
def contrast_steps() -> npt.NDArray[np.float64]:
    """Return by how much `contrast_levels` rises from each cycle to the next, (CYCLES - 1,) float64."""
    return np.diff(contrast_levels())
