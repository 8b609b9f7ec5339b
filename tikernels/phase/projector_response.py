"""What a projector whose light is not proportional to the code does to the phase, where its response is known.

Through a response the sinusoids are no longer sinusoids, and the arctangent's phase deviates from the true one by a
function of the cycle alone: `response_map` computes it, its inverse undoes it. Gamma 2 makes 0.23 rad
of it, three times a cycle (S. Zhang and S.-T. Yau, Generic nonsinusoidal phase error correction for three-dimensional
shape measurement using a digital video projector, Applied Optics 46, 2007, doi:10.1364/AO.46.000036).
"""

import numpy as np
import numpy.typing as npt

from tikernels.phase.equalization import BINS
from tikernels.phase.phase_vector import channel_delays, channel_waves

_TURNS = 2 * np.pi * np.array([[-1], [0], [1]])


def pattern_light(response: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the (3,) mean light of the sinusoids when their codes go through this response, (3, N)."""
    codes = 0.5 + 0.5 * np.cos(np.linspace(-np.pi, np.pi, 4096, endpoint=False))
    return np.array([np.interp(codes, np.linspace(0, 1, response.shape[1]), row).mean() for row in response])


def response_map(
    response: npt.NDArray[np.float64], lag: npt.NDArray[np.float64] | None = None
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return phases all around the cycle, and what the arctangent makes of them with this response of the projector.

    Parameters
    ----------
    response : (3, N)
        Light of N evenly spaced codes of R, G, B.
    lag : (3,), optional
        How far the fringe of R, G, B lags behind its place, rad; see `channel_delays`.

    Returns
    -------
    (4097,), (4097,) float64
        rad; both rise by a whole cycle from the first to the last.
    """
    phase = np.linspace(-np.pi, np.pi, 4097)
    codes = 0.5 + 0.5 * np.cos(phase[:, None] + channel_delays(lag))
    light = np.stack([np.interp(codes[:, j], np.linspace(0, 1, response.shape[1]), response[j]) for j in range(3)], 1)
    light /= light[:-1].mean(axis=0)  # the colours are balanced
    vector = np.linalg.inv(channel_waves(lag))[1:] @ light.T
    bare = np.unwrap(np.arctan2(vector[1], vector[0]))
    return phase, bare - 2 * np.pi * np.round((bare - phase).mean() / (2 * np.pi))


def response_table(
    response: npt.NDArray[np.float64], lag: npt.NDArray[np.float64] | None = None, bins: int = BINS
) -> npt.NDArray[np.float32]:
    """Return what to add to a phase, at the edges of evenly spaced bins, to undo a known response; see `response_map`.

    Returns
    -------
    (bins + 1,) float32
        rad.
    """
    phase, bare = response_map(response, lag)
    edges = np.linspace(-np.pi, np.pi, bins + 1)
    around = np.interp(edges, (bare[:-1] + _TURNS).ravel(), (phase[:-1] + _TURNS).ravel())
    return np.asarray(around - edges, np.float32)


def prefers_response(
    histogram: npt.NDArray[np.float64 | np.int64],
    response: npt.NDArray[np.float64],
    lag: npt.NDArray[np.float64] | None = None,
) -> bool:
    """Whether the phases look as if the response bent them, rather than as if it had been compensated.

    Surfaces show every phase equally often; with the response the density is the slope of `response_map`'s inverse. The
    likelier of the two wins.
    """
    phase, bare = response_map(response, lag)
    bins = len(histogram)
    centres = -np.pi + (np.arange(bins) + 0.5) * 2 * np.pi / bins
    middles = ((bare[1:] + bare[:-1]) / 2 + _TURNS).ravel()
    slope = np.interp(centres, middles, np.tile(np.diff(phase) / np.diff(bare), 3))
    return bool(histogram @ np.log(np.maximum(slope, 1e-3)) > 0)
