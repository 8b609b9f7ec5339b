"""Find the surfaces of a frame by their colours, and what the colour of each makes of the crosstalk."""

import numpy as np
import numpy.typing as npt

from pipeline.decoding.first_look import FirstLook
from pipeline.decoding.surface_search import FoundSurfaces, KnownLight, NoModelFits, OnlyColor, SurfaceSearch
from pipeline.models import FloatArray
from tikernels.arrays import LevelsImage
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.channel_template import channel_harmonics
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_vector import channel_delays, phase_weights
from tikernels.phase.surface_colors import color_ratios
from tikernels.phase.surface_matrix import BETWEEN, BROAD, LightDoubt, band_weights, predict_matrices
from tikernels.phase.surface_samples import compare_samples

# A frame whose colours are this close to white, as logarithms of ratios, has nothing to undo.
_NEUTRAL = 0.05
# By how much of its row an entry of a surface's matrix may be off: calibrated, and told by the frame; and what leaks at
# the least through real filters, where the frame has told the crosstalk with the smallest leaks that fit.
_LEAK, _UNKNOWN_LEAK, _USUAL_LEAK = 0.004, 0.01, 0.03
# So may a harmonic of the light: where the response is known, but for contrast and blur, and where it is not; and the
# contrast apart from what blur takes: one that is 0.08 off changes the fitted ambient light by a third.
_KNOWN_HARMONIC, _SEEN_HARMONIC = 0.0005, 0.02
_CONTRAST = 0.02


class SurfaceFinder:
    """Finds the surfaces of frames of one rig.

    Parameters
    ----------
    white : (3,), optional
        What the camera's channels see of a white surface under full light, up to a factor; None: the commonest colour
        of a frame is taken for it.
    contrast_doubt : float
        Standard deviation of a pixel's contrast about the frame's, as a fraction, where a code changes it; else 0.
    wavelengths_nm : (3, 3), optional
        Where camera channel i sees primary j; None: not known.
    """

    def __init__(
        self, white: FloatArray | None, contrast_doubt: float, wavelengths_nm: FloatArray | None = None
    ) -> None:
        self._white, self._contrast_doubt = white, contrast_doubt
        self._bands = BETWEEN if wavelengths_nm is None else band_weights(wavelengths_nm)

    def find(
        self,
        image: LevelsImage,
        model: ChannelModel,
        crosstalk: Crosstalk,
        levels: FrameLevels,
        correction: npt.NDArray[np.float32],
        template: npt.NDArray[np.float32],
        *,
        template_known: bool,
        before: FoundSurfaces | OnlyColor | NoModelFits | None = None,
    ) -> FoundSurfaces | OnlyColor | NoModelFits | None:
        """Return the surfaces of a frame; None if all are neutral, or act as the balance alone undoes.

        Parameters
        ----------
        image : (H, W, 3) uint8, uint16 or float32
            Linear light, levels, stripes along the rows.
        model : ChannelModel
            The frame's samples, balanced.
        crosstalk : Crosstalk
            On white, what they were balanced with.
        levels : FrameLevels
            The frame's noise, and what a pixel needs to have a phase.
        correction : (bins + 1,) float32
            rad to add to the arctangent; see `equalization.correction_table`.
        template : (3, terms) float32
            One cycle of the channels on white.
        template_known : bool
            Whether that is known, or only read off this frame.
        before : FoundSurfaces or OnlyColor, optional
            What the frame before in a video had: the search begins with its surfaces; a colour that is still the only
            one is not asked again.
        """
        look = FirstLook(image, model, crosstalk, levels, correction)
        if not look.lit.any():
            return None
        colors = look.common_colors()
        white = np.exp(colors[0]) if self._white is None else self._white
        if np.abs(colors - color_ratios(white)).max() < _NEUTRAL:
            return None
        if isinstance(before, OnlyColor) and len(colors) == 1 and np.abs(colors[0] - before.ratios).max() < _NEUTRAL:
            return before
        known = self._known_light(crosstalk, white, template, template_known=template_known)
        if isinstance(before, FoundSurfaces):
            search = SurfaceSearch(look, known, look.labels(colors[:1]), before.fitted.matrices.sum(axis=2))
            return self._judged(search.follow(before))
        found = None
        if len(colors) > 1 or not self._acts_after(look, known):
            found = SurfaceSearch(look, known, look.labels(colors), np.exp(colors)).run()
        return OnlyColor(colors[0]) if found is None and len(colors) == 1 else self._judged(found)

    def _judged(self, found: FoundSurfaces | NoModelFits | None) -> FoundSurfaces | NoModelFits | None:
        """Return what was found; a crosstalk that the frame itself has told is contradicted by nothing."""
        return None if self._white is None and isinstance(found, NoModelFits) else found

    def _known_light(
        self, crosstalk: Crosstalk, white: FloatArray, template: npt.NDArray[np.float32], *, template_known: bool
    ) -> KnownLight:
        matrix = crosstalk.matrix.astype(np.float64)
        light = np.asarray(np.linalg.solve(matrix, channel_harmonics(template)), np.complex128)
        if not template_known:
            # What the frame tells is the surfaces' as well; all primaries have the same light.
            turns = np.exp(1j * np.arange(1, light.shape[1] + 1) * channel_delays(crosstalk.lag)[:, None])
            light = np.asarray((light / turns).real.mean(axis=0) * turns)
        if self._white is None:
            matrix = np.maximum(matrix, _USUAL_LEAK)
            matrix /= matrix.sum(axis=1, keepdims=True)
        return KnownLight(
            matrix,
            np.asarray(white, np.float64),
            light,
            crosstalk.lag,
            LightDoubt(
                leak=_UNKNOWN_LEAK if self._white is None else _LEAK,
                contrast=_CONTRAST,
                harmonic=_KNOWN_HARMONIC if template_known else _SEEN_HARMONIC,
            ),
            contrast_doubt=self._contrast_doubt,
            bands=self._bands,
        )

    def _acts_after(self, look: FirstLook, known: KnownLight) -> bool:
        """Whether the colour of a frame's only surface acts after the crosstalk rather than between."""
        light = look.some_samples()
        if len(light) == 0:
            return False
        color = light.mean(axis=0)
        ambient = np.minimum(look.ambient * color / color.mean(), 0.5 * color)
        weights = phase_weights(np.asarray(np.linalg.inv(known.matrix), np.float64), known.lag) / color
        # The same places by two matrices.
        seen, white = (color - ambient)[None], known.matrix * known.white[:, None]
        matrices = np.concatenate([predict_matrices(seen, white, bands) for bands in (BROAD, known.bands)])
        light, even, ambient, weights = (
            np.stack([part, part]) for part in (light.T, np.ones(len(light)), ambient, weights)
        )
        samples = look.surface_samples(light, even, even, weights, ambient, np.ones(2), self._contrast_doubt)
        found = compare_samples(samples, matrices, ambient, known.light, samples.phase)
        after, otherwise = np.median(np.abs(found.residual) / np.sqrt(found.variance), axis=2)[:, 0]
        # Where neither explains the light, within about a standard deviation, other surfaces are looked for.
        return bool(after < min(otherwise, 1.0))
