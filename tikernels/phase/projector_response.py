"""Effect on the phase of a projector whose light is not proportional to the code, where its response is known.

Through a response the sinusoids are no longer sinusoids, and the arctangent's phase deviates from the true one by a
function of the cycle alone: `response_map` computes it, its inverse undoes it. Gamma 2 makes 0.23 rad
of it, three times per cycle (S. Zhang and S.-T. Yau, Generic nonsinusoidal phase error correction for three-dimensional
shape measurement using a digital video projector, Applied Optics 46, 2007, doi:10.1364/AO.46.000036).

A response is measured on plain fields. Lenses, pixels and focus blur the fringe after it: a Gaussian one multiplies
harmonic n by q^(n^2), so that less of the harmonics is left than the response alone would make. `ResponsePrior` knows
what is to be expected for every q; how much it is, and what is left beyond, the frame shows.
"""

import numpy as np
import numpy.typing as npt

from tikernels.phase.channel_template import known_template
from tikernels.phase.equalization import BINS, MeasuredCorrection
from tikernels.phase.phase_vector import channel_delays, channel_waves

# Points of a cycle that light is computed for.
_POINTS = 4096
# Blurs that are tried, as -ln q; at the last one the third harmonic of gamma 2 is a fifth of its own.
_BLURS = np.linspace(0.0, 0.6, 31)
# How far a harmonic of the correction may be from what response and blur make it, rad.
_WIDTH = 0.01
# Variance of the expected spectrum, in its own units: those of BINS samples of rad.
_VARIANCE = (0.5 * BINS * _WIDTH) ** 2


def light_spectrum(
    response: npt.NDArray[np.float64], lag: npt.NDArray[np.float64] | None = None, contrast: float = 1.0
) -> npt.NDArray[np.complex128]:
    """Return the harmonics of what the projector sends through a response, (3, 2049) complex128, from the zeroth on.

    Parameters
    ----------
    response : (3, N)
        Light of N evenly spaced codes of R, G, B.
    lag : (3,), optional
        Lag of the fringe of R, G, B behind its place, rad; see `channel_delays`.
    contrast : float
        The pattern's, modulation over background; where it is brightest, its code is 1.
    """
    codes = (1 + contrast * np.cos(np.linspace(0, 2 * np.pi, _POINTS, endpoint=False))) / (1 + contrast)
    light = np.stack([np.interp(codes, np.linspace(0, 1, len(row)), row) for row in response])
    n = np.arange(_POINTS // 2 + 1)
    return np.asarray(np.fft.rfft(light, axis=1).real / _POINTS * np.exp(1j * n * channel_delays(lag)[:, None]))


def blurred(spectrum: npt.NDArray[np.complex128], blur: float) -> npt.NDArray[np.complex128]:
    """Return a spectrum after a Gaussian blur that leaves exp(-blur) of the first harmonic."""
    return np.asarray(spectrum * np.exp(-blur * np.arange(spectrum.shape[-1]) ** 2))


def response_map(
    spectrum: npt.NDArray[np.complex128], lag: npt.NDArray[np.float64] | None = None
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return phases all around the cycle, and the arctangent's phases under this light of the projector.

    Parameters
    ----------
    spectrum : (3, N) complex128
        See `light_spectrum`.
    lag : (3,), optional
        See `channel_delays`.

    Returns
    -------
    (4097,), (4097,) float64
        rad; both rise by a whole cycle from the first to the last.
    """
    phase = np.linspace(-np.pi, np.pi, _POINTS + 1)
    full = np.zeros((3, _POINTS // 2 + 1), np.complex128)
    full[:, : spectrum.shape[1]] = spectrum / spectrum[:, :1].real  # the colours are balanced
    light = np.roll(np.fft.irfft(full, _POINTS, axis=1) * _POINTS, _POINTS // 2, axis=1)  # from -pi on
    vector = np.linalg.inv(channel_waves(lag))[1:] @ np.concatenate([light, light[:, :1]], axis=1)
    bare = np.unwrap(np.arctan2(vector[1], vector[0]))
    return phase, bare - 2 * np.pi * np.round((bare - phase).mean() / (2 * np.pi))


def response_table(
    spectrum: npt.NDArray[np.complex128], lag: npt.NDArray[np.float64] | None = None, bins: int = BINS
) -> npt.NDArray[np.float32]:
    """Return what to add to a phase, at the edges of evenly spaced bins, to undo this light; see `response_map`.

    Returns
    -------
    (bins + 1,) float32
        rad.
    """
    phase, bare = response_map(spectrum, lag)
    edges = np.linspace(-np.pi, np.pi, bins + 1)
    return np.interp(edges, bare[:-1], (phase - bare)[:-1], period=2 * np.pi).astype(np.float32)


class ResponsePrior:
    """Expected effect of a known response on the phase and on the channels, for every blur.

    Parameters
    ----------
    response : (3, N)
        Light of N evenly spaced codes of R, G, B; of a pattern in which it has been undone, that of a linear one.
    lag : (3,), optional
        See `channel_delays`.
    contrast : float
        The pattern's mean one; see `light_spectrum`.
    """

    def __init__(
        self, response: npt.NDArray[np.float64], lag: npt.NDArray[np.float64] | None, contrast: float = 1.0
    ) -> None:
        self._light = light_spectrum(response, lag, contrast)
        #: (3,) the mean light of R, G and B, as a fraction of full scale.
        self.light = self._light[:, 0].real
        tables = np.stack([response_table(blurred(self._light, blur), lag)[:-1] for blur in _BLURS])
        self._spectra = np.fft.rfft(tables.astype(np.float64), axis=1)

    def fit(self, measured: MeasuredCorrection, period_px: float) -> tuple[float, float]:
        """Find the blur that explains a measured correction best.

        Parameters
        ----------
        measured : MeasuredCorrection
            Of a frame, see `equalization.measure_correction`.
        period_px : float
            Camera px per cycle: blur is known in px.

        Returns
        -------
        blur : float
            exp(-blur) is left of the first harmonic.
        misfit : float
            Misfit of this response, in squares of standard deviations.
        """
        # Lens, pixels and focus together are usually a Gaussian of a pixel, give or take as much in its square.
        usual = 2 * (np.pi / period_px) ** 2
        expected, seen = self._spectra[:, 1:], measured.spectrum[1:]
        deviations = np.abs(expected - seen) ** 2 / (measured.variance[1:] + _VARIANCE)
        misfit = deviations.sum(axis=1) + ((_BLURS - usual) / usual) ** 2
        best = int(misfit.argmin())
        return float(_BLURS[best]), float(misfit[best])

    def corrected(self, measured: MeasuredCorrection, blur: float) -> npt.NDArray[np.complex128]:
        """Return the spectrum of the correction: the expected one, and of the rest what the frame is sure of."""
        expected = self._spectra[int(np.abs(_BLURS - blur).argmin())]
        rest = measured.beyond(expected)
        return np.asarray(expected + _VARIANCE / (_VARIANCE + measured.variance) * rest)

    def template(self, matrix: npt.NDArray[np.floating], blur: float) -> npt.NDArray[np.float32]:
        """Return one cycle of the channels under this matrix; see `known_template`."""
        return known_template(matrix, blurred(self._light, blur))
