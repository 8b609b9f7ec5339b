"""A channel's level under the projector's white, from one cycle of it under the fringe.

A fringe is brightest where the pattern's code is one, which is the projector's white. With the crosstalk undone, one
cycle of primary j is p_j = 1 + its harmonics, and its peak P_j is by how much white is brighter than the mean over a
cycle; M P is what the channels of a neutral surface show of white, M the crosstalk with rows that sum to one.
A contrast code keeps the peak of every cycle where it is (`pipeline/pattern.py`).
"""

import numpy as np
import numpy.typing as npt

from tikernels.phase.channel_template import HARMONICS, channel_harmonics
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import BINS
from tikernels.phase.phase_vector import channel_delays


def primary_cycles(template: npt.NDArray[np.float32], crosstalk: Crosstalk) -> npt.NDArray[np.float64]:
    """Return one cycle of each primary, each in its own phase: (3, phases), their means 1, from phase 0 on.

    Parameters
    ----------
    template : (3, terms) float32
        One cycle of the channels of a neutral surface; see `channel_template.py`.
    crosstalk : Crosstalk
        Crosstalk from the primaries to them.
    """
    n = np.arange(1, HARMONICS + 1)
    harmonics = crosstalk.inverse.astype(np.float64) @ channel_harmonics(template)
    harmonics *= np.exp(-1j * n * channel_delays(crosstalk.lag)[:, None])
    psi = 2 * np.pi * np.arange(BINS) / BINS  # four harmonics change by less than 0.001 from one to the next
    return np.asarray(1 + (harmonics @ np.exp(1j * np.outer(n, psi))).real)


def white_level(template: npt.NDArray[np.float32], crosstalk: Crosstalk) -> npt.NDArray[np.float32]:
    """Return what the channels of a neutral surface show of the projector's white, (3,) float32.

    Parameters
    ----------
    template : (3, terms) float32
        One cycle of those channels.
    crosstalk : Crosstalk
        Crosstalk from the primaries to them.

    Returns
    -------
    (3,) float32
        Over their means in a cycle: 1 or more, 2 for a linear response.
    """
    peaks = primary_cycles(template, crosstalk).max(axis=1)
    return np.asarray(crosstalk.matrix.astype(np.float64) @ peaks, np.float32)
