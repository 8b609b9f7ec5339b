"""Search a frame for its surfaces, turn by turn.

Each surface's matrix is predicted from its colour and fitted to its pixels, every pixel goes to the surface that
explains it best, surfaces that none needs are dropped, and places that none explains become new ones.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.decoding.first_look import FirstLook, repeated
from pipeline.models import FloatArray
from tikernels.phase.channel_template import known_template
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.phase_vector import phase_weights
from tikernels.phase.surface_colors import color_ratios, color_word, common_colors, nearest_colors
from tikernels.phase.surface_labels import LEAST_PX, Relabelled, relabel, surface_misfits
from tikernels.phase.surface_matrix import (
    BROAD,
    FittedMatrices,
    PredictedMatrices,
    SurfaceSamples,
    fit_matrices,
)
from tikernels.phase.surfaces import NO_SURFACE, Surfaces

_Labels = npt.NDArray[np.uint8]
_Mask = npt.NDArray[np.bool_]
_Complexes = npt.NDArray[np.complex128]

# Pixels of each surface that are asked: at least, and at most; those near its edges, where the other side's light is
# blurred in, only if the inside has fewer than the second.
_LEAST_SAMPLES, _FEW_SAMPLES, _MOST_SAMPLES = 60, 200, 1500
_MARGIN_PX = 17
# Turns at the most; the first of these tell the common light, too; the last make no new surfaces; new ones a turn.
_TURNS, _OF_LIGHT, _LAST, _NEW = 6, 2, 2, 3
# While it goes on, every second pixel is looked at, both ways.
_STEP_PX = 2
# The search ends once fewer pixels than this share change.
_SETTLED = 0.005
# Pixels that no surface explains are looked at anew in the next frame if they are more by this factor.
_MORE = 1.5
# A surface whose pixels are off its model by more than this fraction does not fit them, unless the frame began with it.
_UNFIT = 0.02
# If the largest surface is off by more than this, the search has failed. Demosaicking and JPEG make up to 0.03, where
# phases without surfaces are off up to four times as much; a calibration of another rig makes 0.06 and more.
_CONTRADICTED = 0.04
# Surfaces that are off by more than this, on more than this share of what is lit, are told of: on spots and highlights
# `phase_sigma` is larger, but a fluorescent paint has another constant.
_ODD, _ODD_SHARE = 0.025, 0.02
# A light of which this part is not explained may turn the phase by as much, rad: 1 to 3.5 on paints that fluoresce.
_PHASE_OF_LIGHT = 2.0
# The window in which the light of a new surface is averaged, in cycles.
_COLOR_CYCLES = 1.0
# The width of an edge between two colours, px.
_EDGE_PX = 13
# Samples are means over this many pixels along the stripes: the noise of single pixels biases the fitted matrices.
_SAMPLE_PX = 5
# A matrix makes of a pixel's light what is there but for this fraction.
_MODEL_ERROR = 0.01
# Ambient light is at most this share of a surface's.
_MOST_AMBIENT = 0.5


@dataclass(frozen=True, eq=False)
class KnownLight:
    """What is known of the light before a frame's surfaces are looked for."""

    matrix: FloatArray
    """(3, 3) the crosstalk on white, its rows' sums one."""
    white: FloatArray
    """(3,) what the camera's channels see of white, up to a factor."""
    light: _Complexes
    """(3, harmonics) of the projector's light over its mean, from the first on."""
    lag: FloatArray | None
    """(3,) rad; see `channel_delays`."""
    leak: float
    """Standard deviation of a matrix entry on white, as a fraction of its row."""
    contrast: float
    """Standard deviation of the light's contrast apart from what blur takes, as a fraction."""
    harmonic: float
    """How far a harmonic of the light may be off, besides contrast and blur, as a fraction of the first."""
    contrast_doubt: float
    """Standard deviation of a pixel's contrast by the pattern's code, as a fraction."""
    bands: FloatArray
    """(3, 3, 3) where colours act, as a rule; see `predict_matrices`."""

    def template(self, light: _Complexes) -> npt.NDArray[np.float32]:
        """Return one cycle of a neutral surface's channels."""
        return known_template(self.matrix, np.concatenate([np.ones((3, 1)), light / 2], axis=1))

    def crosstalk(self, matrices: FloatArray, labels: _Labels, ambient: FloatArray) -> Crosstalk:
        """Return the crosstalk with these surfaces, their neutral channels scaled to the same noise."""
        unmixing = np.asarray(np.linalg.inv(self.matrix), np.float64)
        mixing, waves = matrices @ unmixing, phase_weights(unmixing)[:2]
        noise = np.sqrt(((waves @ np.linalg.inv(mixing)) ** 2).sum(axis=(1, 2)) / (waves**2).sum())
        return Crosstalk.of(
            self.matrix, lag=self.lag, surfaces=Surfaces.of(mixing * noise[:, None, None], labels, ambient)
        )


@dataclass(frozen=True, eq=False)
class FoundSurfaces:
    """What a frame says of its surfaces."""

    crosstalk: Crosstalk
    """With the surfaces."""
    template: npt.NDArray[np.float32]
    """(3, terms) one cycle of a neutral surface's channels."""
    fitted: FittedMatrices
    """What they were found to be."""
    mismatch: float
    """How far the channels' fundamentals are from what the crosstalk on white makes of the colour, as a fraction, on
    the surface that is most like white: saturated paints are further off."""
    unexplained: int
    """Pixels that none of them explains."""
    odd: "NoModelFits | None" = None
    """Surfaces that their own matrices do not explain, as fluorescent ones."""

    @property
    def constant_sigma(self) -> float:
        """Standard deviation of the constant of the least certain surface's phase, rad."""
        return float(np.hypot(self.fitted.constant_sigma.max(), 0.0 if self.odd is None else self.odd.phase_rad))


class OnlyColor(NamedTuple):
    """The frame has a single colour, and the balance alone undoes what that makes of the crosstalk."""

    ratios: FloatArray
    """(3,) see `color_ratios`."""


class NoModelFits(NamedTuple):
    """Some of the frame's colours contradict the crosstalk: no matrix explains them."""

    misfit: float
    """What is left over of them, as a fraction of their light."""
    share: float
    """Of the pixels that are lit."""
    color: str
    """In a word, of the largest surface of them."""

    @property
    def phase_rad(self) -> float:
        """By how much that may turn the phase, rad: over the fringe's usual contrast."""
        return _PHASE_OF_LIGHT * self.misfit


class _Means(NamedTuple):
    """Mean light around N pixels."""

    light: FloatArray  # (N, 3) levels
    pixels: FloatArray  # (N,) how many
    contrast: FloatArray  # (N,) by which the mean multiplies the fringe's first harmonic


class SurfaceSearch:
    """The surfaces of a frame as they are known so far.

    Parameters
    ----------
    look : FirstLook
        The frame.
    known : KnownLight
        What is known of the light.
    labels : (H, W) uint8
        The surfaces to begin with.
    colors : (n, 3)
        What the camera sees of them, up to a factor.
    """

    def __init__(self, look: FirstLook, known: KnownLight, labels: _Labels, colors: FloatArray) -> None:
        self._look, self._known = look, known
        self._labels, self._colors = labels, colors
        self._ambient: FloatArray | None = None  # (n, 3) levels
        self._light = known.light
        self._bands = [known.bands, BROAD]  # where colours act; those that are still possible
        # Which surfaces need not fit: those that the frame began with, and those that have not been fitted yet.
        self._first = self._spared = np.ones(len(colors), bool)
        # Places where no new surface is looked for: pixels of an edge see two of them, and no matrix explains that;
        # and those where a new surface has been dropped. A first surface that is dropped may be a mixture of others, so
        # its place stays open.
        self._tried = _near_edges(labels, _EDGE_PX)
        self._random = np.random.default_rng(0)

    def run(self, first_turn: int = 0) -> FoundSurfaces | NoModelFits | None:
        """Look for the surfaces; None: there is but one, which acts as the balance alone undoes."""
        turn, settled = first_turn, False
        while True:
            ends = settled or turn == _TURNS - 1
            fitted = self._fit(turn, ends=ends)
            if fitted is None:
                return None
            turn += 1
            if ends:
                last = self._relabel(fitted, 1)
                return self._found(self._keep(last, fitted), last.unexplained)
            before = self._labels
            new = self._relabel(fitted, _STEP_PX)
            self._keep(new, fitted)
            settled = turn > _OF_LIGHT and bool(np.mean(before != new.labels) < _SETTLED)
            if _OF_LIGHT <= turn <= _TURNS - _LAST:
                settled &= not self._add(new.unexplained & ~self._tried)

    def follow(self, before: FoundSurfaces) -> FoundSurfaces | NoModelFits | None:
        """Look for the surfaces of the frame before, and for new ones if more is left unexplained than there."""
        new = self._relabel(before.fitted, 1, afresh=True)
        fitted = self._keep(new, before.fitted)
        self._tried |= _near_edges(self._labels, _EDGE_PX)
        unexplained = new.unexplained & ~self._tried
        if np.count_nonzero(unexplained) > _MORE * before.unexplained + LEAST_PX and self._add(unexplained):
            return self.run(_OF_LIGHT)
        return self._found(fitted, new.unexplained)

    def _found(self, fitted: FittedMatrices, unexplained: _Mask) -> FoundSurfaces | NoModelFits:
        """Return the surfaces, unless the largest is far from fitting, as with a calibration that is not this rig's."""
        sizes = np.bincount(self._labels.ravel(), minlength=NO_SURFACE)[: len(fitted.matrices)]
        shares, largest = sizes / max(sizes.sum(), 1), sizes.argmax()
        ratios = color_ratios(self._colors) - color_ratios(self._known.white)
        if fitted.misfit[largest] > _CONTRADICTED:
            color = color_word(ratios[largest])
            return NoModelFits(float(fitted.misfit[largest]), float(shares[largest]), color)
        strange = (fitted.misfit > _ODD) & (sizes > 0)
        color = color_word(ratios[np.where(strange, sizes, 0).argmax()])
        odd = NoModelFits(float(fitted.misfit[strange].max(initial=0)), float(shares[strange].sum()), color)
        whitest = np.abs(ratios).max(axis=1).argmin()
        return FoundSurfaces(
            self._known.crosstalk(fitted.matrices, self._labels, fitted.ambient),
            self._known.template(fitted.light),
            fitted,
            float(fitted.mismatch[whitest]),
            int(np.count_nonzero(unexplained & ~self._tried)),
            odd if odd.share > _ODD_SHARE else None,
        )

    def _fit(self, turn: int, *, ends: bool) -> FittedMatrices | None:
        """Fit the surfaces' matrices; None if the frame's only surface acts as the balance alone undoes.

        Noise tells surfaces apart best; in the end it is the model that is wrong by more.
        """
        look, known = self._look, self._known
        numbers, samples = self._samples()
        if not numbers:
            return None
        self._renumber(numbers)
        if ends:
            samples = [replace(s, variance=s.variance + (_MODEL_ERROR * s.light) ** 2) for s in samples]
        level = np.array([surface.light.mean(axis=0) for surface in samples])
        colors, white = self._colors, known.matrix * known.white[:, None]
        expected = np.minimum(look.ambient * 3 * colors / colors.sum(axis=1, keepdims=True), _MOST_AMBIENT * level)
        if self._ambient is None:
            self._ambient = expected
            colors = np.maximum(level - expected, 1e-6)
        tell_light = turn < _OF_LIGHT
        results = [
            fit_matrices(
                samples,
                PredictedMatrices.of(colors, white, bands),
                expected,
                self._ambient,
                known.light if tell_light else self._light,
                known.leak,
                known.contrast,
                known.harmonic,
                fit_light=tell_light,
            )
            for bands in self._bands
        ]
        best = int(np.argmin([result.cost for result in results]))
        if len(samples) == 1 and self._bands[best] is BROAD:
            return None
        self._bands = [self._bands[best]]
        return results[best]

    def _samples(self) -> tuple[list[int], list[SurfaceSamples]]:
        """Return pixels of every surface that has enough of them, and its number."""
        look, known = self._look, self._known
        rows, columns = look.sample_places()
        labels, inside = self._labels[rows, columns], ~_near_edges(self._labels, _MARGIN_PX)[rows, columns]
        clear = look.image[rows, columns].max(axis=-1) < look.levels.clipped
        weights = phase_weights(np.asarray(np.linalg.inv(known.matrix), np.float64), known.lag)
        numbers, samples = [], []
        for surface, color in enumerate(self._colors):
            own = clear & (labels == surface)
            places = np.flatnonzero(own & inside)
            if len(places) < _FEW_SAMPLES:
                places = np.flatnonzero(own)
            if len(places) < _LEAST_SAMPLES:
                continue
            if len(places) > _MOST_SAMPLES:
                places = self._random.permutation(places)[:_MOST_SAMPLES]
            ambient = np.zeros(3) if self._ambient is None else self._ambient[surface]
            own_weights, doubt = weights / color, known.contrast_doubt
            where = (rows[places // labels.shape[1], 0], columns.ravel()[places])
            means = self._averaged(surface, *where, own_weights, ambient)
            around = look.around.ravel()[places]
            contrast = means.contrast * look.contrast_around.ravel()[places]
            numbers.append(surface)
            own_samples = look.surface_samples(means.light, around, own_weights, ambient, doubt, contrast)
            samples.append(replace(own_samples, variance=own_samples.variance / means.pixels[:, None]))
        return numbers, samples

    def _averaged(
        self,
        surface: int,
        rows: npt.NDArray[np.intp],
        columns: npt.NDArray[np.intp],
        weights: FloatArray,
        ambient: FloatArray,
    ) -> "_Means":
        """Return the means around some of a surface's pixels, over neighbours along the image's rows.

        Only pixels of the same surface that are not clipped count. Where stripes are tilted against the rows, the mean
        lowers the fringe's contrast.
        """
        reach = _SAMPLE_PX - 1
        near = columns[:, None] + np.arange(-reach, reach + 1)
        near = np.clip(near, 0, self._labels.shape[1] - 1)
        light = self._look.image[rows[:, None], near].astype(np.float64)
        own = (self._labels[rows[:, None], near] == surface) & (light.max(axis=-1) < self._look.levels.clipped)
        vector = ((light - ambient) @ weights[:2].T) @ np.array([1, 1j])
        slope = np.angle((vector[:, 1:] * vector[:, :-1].conj() * (own[:, 1:] & own[:, :-1])).sum(axis=1))
        half = slice(reach - _SAMPLE_PX // 2, reach + _SAMPLE_PX // 2 + 1)
        light, own = light[:, half], own[:, half]
        count = own.sum(axis=1)
        # A phase that is linear over n pixels has the variance slope^2 (n^2 - 1) / 12.
        contrast = np.exp(-(slope**2) * (count**2 - 1) / 24)
        return _Means(np.einsum("nkc,nk->nc", light, own) / count[:, None], count.astype(np.float64), contrast)

    def _relabel(self, fitted: FittedMatrices, step: int, *, afresh: bool = False) -> Relabelled:
        """Give every pixel to the surface that explains it best, looking at one of `step` both ways."""
        look, known = self._look, self._known
        crosstalk = known.crosstalk(fitted.matrices, self._labels, fitted.ambient)
        model = (crosstalk, look.levels, look.correction, known.template(fitted.light))
        fringe, period_px = look.fringe(known.contrast_doubt), look.gains.period_px
        misfits = surface_misfits(look.device_image, *model, fringe, period_px, step)
        fits = (fitted.misfit < _UNFIT) | self._spared
        known_so_far = (self._labels[::step, ::step], fits, self._first)
        new = relabel(misfits, *known_so_far, period_px, step, afresh=afresh)
        if step == 1:
            return new
        shape = self._labels.shape
        labels = np.where(self._labels == NO_SURFACE, NO_SURFACE, repeated(new.labels, step, shape))
        return Relabelled(labels, new.kept, repeated(new.unexplained, step, shape))

    def _keep(self, new: Relabelled, fitted: FittedMatrices) -> FittedMatrices:
        """Go on with what has proved to be a surface, and return that."""
        in_vain = [k for k in np.flatnonzero(~self._first) if k not in new.kept]
        self._tried = self._tried | np.isin(self._labels, in_vain)
        kept = fitted.only(new.kept)
        self._labels, self._light, self._ambient = new.labels, kept.light, kept.ambient
        self._colors = kept.matrices.sum(axis=2)
        self._first = self._spared = self._first[new.kept]
        return kept

    def _add(self, unexplained: _Mask) -> bool:
        """Make new surfaces of pixels that none explains; return whether there are any."""
        if np.count_nonzero(unexplained) < LEAST_PX or self._ambient is None:
            return False
        image, count = self._look.image, len(self._colors)
        sigma = _COLOR_CYCLES * self._look.gains.period_px
        seen = np.where(unexplained[..., None], image, 0).astype(np.float32)
        share = cv2.GaussianBlur(unexplained.astype(np.float32), (0, 0), sigma)[..., None]
        ratios = color_ratios((cv2.GaussianBlur(seen, (0, 0), sigma) / np.maximum(share, 1e-6))[unexplained])
        centers = common_colors(ratios[::4], np.ones(len(ratios[::4])), LEAST_PX / 4)[:_NEW]
        nearest = nearest_colors(ratios, centers)
        places = [_largest_part(unexplained, nearest == k) for k in range(len(centers))]
        places = [place for place in places if np.count_nonzero(place) >= LEAST_PX]
        if not places:
            return False
        light = np.array([image[place].mean(axis=0) for place in places])
        ambient = np.minimum(np.median(self._ambient, axis=0), _MOST_AMBIENT * light)
        self._labels = self._labels.copy()
        for number, place in enumerate(places, count):
            self._labels[place] = number
        self._colors = np.concatenate([self._colors, np.maximum(light - ambient, 1e-6)])
        self._ambient = np.concatenate([self._ambient, ambient])
        self._spared = np.concatenate([self._spared, np.ones(len(places), bool)])
        self._first = np.concatenate([self._first, np.zeros(len(places), bool)])
        return True

    def _renumber(self, numbers: list[int]) -> None:
        """Drop the surfaces that have no pixels to speak of."""
        if len(numbers) == len(self._colors):
            return
        table = np.zeros(NO_SURFACE + 1, np.uint8)
        table[numbers], table[NO_SURFACE] = np.arange(len(numbers)), NO_SURFACE
        self._labels = table[self._labels]
        self._colors = self._colors[numbers]
        self._spared, self._first = self._spared[numbers], self._first[numbers]
        if self._ambient is not None:
            self._ambient = self._ambient[numbers]


def _largest_part(mask: _Mask, chosen: _Mask) -> _Mask:
    """Return what hangs together of the chosen ones of a mask's pixels, the largest such part: it is of one surface.

    All of them, if none is large enough for a surface.
    """
    all_of_them = np.zeros(mask.shape, np.uint8)
    all_of_them[mask] = chosen
    _, parts, sizes, _ = cv2.connectedComponentsWithStats(all_of_them, connectivity=4)
    areas = sizes[1:, cv2.CC_STAT_AREA]
    if len(areas) == 0 or areas.max() < LEAST_PX:
        return np.asarray(all_of_them > 0)
    return np.asarray(parts == 1 + areas.argmax())


def _near_edges(labels: _Labels, width_px: int) -> _Mask:
    """Return which pixels have others around, in a square, that show another surface."""
    square = np.ones((width_px, width_px), np.uint8)
    return np.asarray(cv2.dilate(labels, square) != cv2.erode(labels, square))
