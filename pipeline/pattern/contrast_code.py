"""The code that a pattern may carry: the modulation of each cycle is one symbol of a sequence that never repeats.

The modulation goes in a straight line from the middle of one cycle to the middle of the next. Its spectrum then has a
double zero at one a cycle, so the code hardly leaks into the mean of a channel, from which the balance takes the
surface's colour; and there is no edge that blur could soften. `docs/coded_pattern.md` derives symbols and sequence.
"""

from functools import cache

import numpy as np
import numpy.typing as npt

#: Modulation of the three symbols, as a fraction of full scale around a mean of 0.5; a plain pattern's is 0.5.
MODULATIONS = (0.36, 0.43, 0.5)
#: One digit a cycle, from the projector's first row (or column) on. No two stretches of five cycles change alike.
SYMBOLS = (
    "02110212222212202220002020101200122102022110011202100200012120200212102101210002202120122012011220022120"
    "00021022001002222020211201022210"
)
CYCLES = len(SYMBOLS)


def cycle_modulations() -> npt.NDArray[np.float64]:
    """Return the (CYCLES,) modulation in the middle of each cycle, as a fraction of full scale."""
    return np.array(MODULATIONS)[[int(symbol) for symbol in SYMBOLS]]


def modulation_at(cycles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the pattern's modulation at a phase in cycles, as a fraction of full scale."""
    return np.asarray(np.interp(cycles, np.arange(CYCLES), cycle_modulations()))


@cache
def contrast_steps() -> npt.NDArray[np.float64]:
    """Return by how much the logarithm of the contrast rises from each cycle to the next.

    A cycle's contrast is `measure_contrast_kernel`'s, to which its neighbours' symbols contribute 8 % each. The light
    is assumed to be proportional to the codes; a response that is not makes the steps smaller, all alike.

    Returns
    -------
    (CYCLES - 1,) float64
        Natural logarithm.
    """
    within = np.linspace(-0.5, 0.5, 129)
    weight = (1 - (2 * within) ** 2) ** 2
    mean = modulation_at(np.arange(CYCLES)[:, None] + within) @ weight / weight.sum()
    return np.diff(np.log(mean))
