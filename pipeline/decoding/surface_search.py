"""Find the surfaces of a frame by their colours, and the effect of each colour on the crosstalk.

Each surface's matrix is predicted from its colour and fitted to its pixels, every pixel goes to the surface that
explains it best, surfaces that none needs are dropped, and places that none explains become new ones. In a video the
search begins with the surfaces of the frame before, and what is fitted is the mean of both.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.decoding.first_look import FirstLook
from pipeline.models import FloatArray
from tikernels.phase.channel_template import known_template
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.phase_vector import TINY, phase_weights
from tikernels.phase.surface_colors import MOST_COLORS, color_ratios, color_word, common_colors, nearest_colors
from tikernels.phase.surface_labels import LEAST_PX, Relabelled, cells_of_pixels, choose_surfaces, relabel
from tikernels.phase.surface_matrix import (
    BROAD,
    PROOF,
    FittedMatrices,
    LightDoubt,
    PredictedMatrices,
    fit_matrices,
    predict_matrices,
)
from tikernels.phase.surface_misfits import (
    MODEL_ERROR,
    MOST_MISFIT,
    NeutralLight,
    average_light,
    measure_scatter,
    surface_residuals,
)
from tikernels.phase.surface_samples import compare_samples
from tikernels.phase.surfaces import NO_SURFACE, Surfaces

_Labels = npt.NDArray[np.uint8]
_Mask = npt.NDArray[np.bool_]
_Complexes = npt.NDArray[np.complex128]

# Places of all surfaces that are used, in the first pass and in all others; and of one, which has at least the fourth.
# Those near its edges, where the other side's light is blurred in, are used only if the inside has fewer.
_FIRST_SAMPLES, _SAMPLES, _MOST_SAMPLES, _LEAST_SAMPLES = 1000, 4000, 1500, 20
# They are spread evenly: the golden section, whose multiples come nowhere near each other.
_GOLDEN = 0.6180339887498949
# A frame whose colours are this close to white, as logarithms of ratios, has nothing to undo.
_NEUTRAL = 0.05
# How often the common light is fitted, too, and new surfaces are made, at most.
_TURNS = 2
# Under a code surfaces whose colours differ by less (natural logarithm) are one paint: its contrasts look like another
# one's a little, as far as the light is not known.
_ALIKE = 0.1
# If the largest surface is off by more than this, the search has failed. Demosaicking and JPEG make up to 0.03, where
# phases without surfaces are off up to four times as much; a calibration of another rig makes 0.05 and more.
_CONTRADICTED = 0.04
# Surfaces that are off by more than this, on more than this share of the lit pixels, are warned about: on spots and
# highlights `phase_sigma` is larger, but a fluorescent paint has another constant.
_ODD, _ODD_SHARE = 0.025, 0.02
# A light of which this part is not explained may turn the phase by as much, rad: 1 to 3.5 on paints that fluoresce.
_PHASE_OF_LIGHT = 2.0
# The window in which the light of a new surface is averaged, in cycles.
_COLOR_CYCLES = 1.0
# The width of an edge between two colours, px.
_EDGE_PX = 9
# Ambient light is at most this share of a surface's.
_MOST_AMBIENT = 0.5


@dataclass(frozen=True, eq=False)
class SurfacePrior:
    """The light as known before the search for a frame's surfaces."""

    matrix: FloatArray
    """(3, 3) the crosstalk on white, its rows' sums one."""
    white: FloatArray | None
    """(3,) response of the camera's channels to white, up to a factor; None: the commonest colour of a frame."""
    light: _Complexes
    """(3, harmonics) of the projector's light over its mean, from the first on."""
    lag: FloatArray | None
    """(3,) rad; see `channel_delays`."""
    doubt: LightDoubt
    """Standard deviations of what is known."""
    contrast_doubt: float
    """Standard deviation of a pixel's contrast by the pattern's code, as a fraction."""
    bands: FloatArray
    """(3, 3, 3) where colours usually act; see `predict_matrices`."""

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
    """Surfaces as estimated from a frame."""

    crosstalk: Crosstalk
    """With the surfaces."""
    template: npt.NDArray[np.float32]
    """(3, terms) one cycle of a neutral surface's channels."""
    fitted: FittedMatrices
    """The surfaces found."""
    bands: FloatArray
    """(3, 3, 3) where their colours act; see `predict_matrices`."""
    mismatch: float
    """Relative deviation of the channels' fundamentals from the prediction by the colour and the crosstalk on white, on
    the surface that is most like white: saturated paints are further off."""


class OnlyColor(NamedTuple):
    """The frame has a single colour, and the balance alone undoes its effect on the crosstalk."""

    ratios: FloatArray
    """(3,) see `color_ratios`."""


class NoModelFits(NamedTuple):
    """Some of the frame's colours contradict the crosstalk: no matrix explains them."""

    misfit: float
    """Their residuals, as a fraction of their light."""
    share: float
    """Of the pixels that are lit."""
    color: str
    """In a word, of the largest surface of them."""

    @property
    def phase_rad(self) -> float:
        """By how much that may turn the phase, rad: over the fringe's usual contrast."""
        return _PHASE_OF_LIGHT * self.misfit


#: What is found of a frame's surfaces, None if the balance alone undoes what they do; and of those that do not fit.
Found = tuple[FoundSurfaces | OnlyColor | None, NoModelFits | None]


def find_surfaces(look: FirstLook, known: SurfacePrior, before: FoundSurfaces | OnlyColor | None = None) -> Found:
    """Find the surfaces of a frame by their colours, and the effect of each colour on the crosstalk.

    Parameters
    ----------
    look : FirstLook
        The frame.
    known : SurfacePrior
        The light as known so far.
    before : FoundSurfaces or OnlyColor, optional
        Those of the previous frame of a video: the search begins with its surfaces; a colour that is still the only one
        is not examined again.
    """
    if not look.lit.any():
        return None, None
    colors = look.common_colors()
    white = np.exp(colors[0]) if known.white is None else known.white
    if np.abs(colors - color_ratios(white)).max() < _NEUTRAL:
        return None, None
    if isinstance(before, OnlyColor) and len(colors) == 1 and np.abs(colors[0] - before.ratios).max() < _NEUTRAL:
        return before, None
    after = before if isinstance(before, FoundSurfaces) else None
    if len(colors) == 1 and after is None and _acts_after(look, known, white):
        return OnlyColor(colors[0]), None
    found, odd = SurfaceSearch(look, known, white, colors, after).run()
    if found is None and odd is None and len(colors) == 1:
        return OnlyColor(colors[0]), None
    # A crosstalk that was estimated from the frame itself cannot contradict it.
    return found, None if found is None and known.white is None else odd


def _acts_after(look: FirstLook, known: SurfacePrior, white: FloatArray) -> bool:
    """Return whether the colour of a frame's only surface acts after the crosstalk rather than between."""
    light = look.some_samples()
    if len(light) == 0:
        return False
    color = light.mean(axis=0)
    ambient = np.minimum(look.ambient * color / color.mean(), 0.5 * color)
    weights = phase_weights(np.asarray(np.linalg.inv(known.matrix), np.float64), known.lag) / color
    # The same places by two matrices.
    seen, on_white = (color - ambient)[None], known.matrix * white[:, None]
    matrices = np.concatenate([predict_matrices(seen, on_white, bands) for bands in (BROAD, known.bands)])
    light, even, ambient, weights = (
        np.stack([part, part]) for part in (light.T, np.ones(len(light)), ambient, weights)
    )
    samples = look.surface_samples(light, even, even, weights, ambient, np.ones(2), known.contrast_doubt)
    found = compare_samples(samples, matrices, ambient, known.light)
    after, otherwise = np.median(np.abs(found.residual) / np.sqrt(found.variance), axis=2)[:, 0]
    # Where neither explains the light, within about a standard deviation, other surfaces are searched for.
    return bool(after < min(otherwise, 1.0))


class SurfaceSearch:
    """The surfaces of a frame as they are known so far.

    Parameters
    ----------
    look : FirstLook
        The frame.
    known : SurfacePrior
        The light as known so far.
    white : (3,)
        Response of the camera's channels to white, up to a factor.
    colors : (n, 3)
        Ratios that many of the frame's nodes have; see `color_ratios`.
    before : FoundSurfaces, optional
        Those of the frame before in a video, with which the search begins; None: with one of each colour.
    """

    def __init__(
        self,
        look: FirstLook,
        known: SurfacePrior,
        white: FloatArray,
        colors: FloatArray,
        before: FoundSurfaces | None = None,
    ) -> None:
        self._look, self._known, self._lattice = look, known, look.lattice
        self._white, self._before = white, before
        self._ambient: FloatArray | None = None  # (n, 3) levels
        self._fitted: FittedMatrices | None = None  # of the first of these surfaces
        self._scatter = 0.0  # see `measure_scatter`; by the surfaces that the search begins with
        if before is None:
            self._labels, self._colors = look.labels(colors), np.exp(colors)
            self._bands = [known.bands, BROAD]  # where colours act; those that are still possible
        else:
            self._labels, self._colors = look.labels(colors[:1]), before.fitted.matrices.sum(axis=2)
            self._bands = [before.bands]
        # Which surfaces the frame began with.
        self._first = np.ones(len(self._colors), bool)
        # Places where no new surface is searched for: those at an edge see two of them, and no matrix explains that;
        # and those where a new surface has been dropped. A first surface that is dropped may be a mixture of others, so
        # its place stays open.
        self._tried = self._near_edges(_EDGE_PX)

    def run(self) -> tuple[FoundSurfaces | None, NoModelFits | None]:
        """Search for the surfaces; None: there is only one, whose effect the balance alone undoes, or none fits."""
        before = self._before
        for _ in range(_TURNS if before is None else 1):
            fitted = self._fit() if before is None else before.fitted
            if fitted is None or self._balanced(fitted):
                return None, self._contradiction(fitted)
            new = self._relabel(fitted, self._neutral(fitted), afresh=before is not None)
            self._keep(new, fitted)
            if before is not None:
                self._tried |= self._near_edges(_EDGE_PX)
            added = self._add(new.unexplained & ~self._tried)
            if not added:
                break
        fitted = self._fit(ends=True)
        if fitted is None or self._balanced(fitted):
            return None, self._contradiction(fitted)
        if before is not None and self._fitted is not None:
            fitted = fitted.after(self._fitted)
        neutral = self._neutral(fitted)
        if added or len(fitted.matrices) != len(new.kept):
            new = self._relabel(fitted, neutral)
            fitted, neutral = self._keep(new, fitted), neutral.only(new.kept)
        return self._found(new, fitted, neutral)

    def _found(
        self, new: Relabelled, fitted: FittedMatrices, neutral: NeutralLight
    ) -> tuple[FoundSurfaces | None, NoModelFits | None]:
        """Return the surfaces, unless the largest is far from fitting, as with a calibration that is not this rig's."""
        contradiction = self._contradiction(fitted)
        if contradiction is not None:
            return None, contradiction
        odd = self._left_over(fitted, fitted.misfit > _ODD)
        whitest = np.abs(self._ratios).max(axis=1).argmin()
        found = FoundSurfaces(
            self._known.crosstalk(fitted.matrices, self._of_pixels(new, neutral), fitted.ambient),
            self._known.template(fitted.light),
            fitted,
            self._bands[0],
            float(fitted.mismatch[whitest]),
        )
        return found, odd if odd.share > _ODD_SHARE else None

    def _balanced(self, fitted: FittedMatrices) -> bool:
        """Return whether the balance alone undoes the effect of the frame's only surface."""
        return len(fitted.matrices) == 1 and self._bands[0] is BROAD

    def _contradiction(self, fitted: FittedMatrices | None) -> NoModelFits | None:
        """Return what is left over of the largest surface if that is far from fitting."""
        if fitted is None:
            return None
        odd = self._left_over(fitted, np.arange(len(fitted.misfit)) == self._sizes(fitted).argmax())
        return odd if odd.misfit > _CONTRADICTED else None

    def _left_over(self, fitted: FittedMatrices, surfaces: _Mask) -> NoModelFits:
        """Return what the matrices of some surfaces leave over."""
        sizes = self._sizes(fitted)
        share = np.where(surfaces, sizes, 0) / max(sizes.sum(), 1)
        misfit = float(fitted.misfit[share > 0].max(initial=0))
        return NoModelFits(misfit, float(share.sum()), color_word(self._ratios[share.argmax()]))

    def _sizes(self, fitted: FittedMatrices) -> npt.NDArray[np.intp]:
        """Return how many places show each surface."""
        return np.bincount(self._labels.ravel(), minlength=NO_SURFACE)[: len(fitted.matrices)]

    @property
    def _ratios(self) -> FloatArray:
        """(n, 3) how far each surface's colour is from white, as logarithms of ratios."""
        return color_ratios(self._colors) - color_ratios(self._white)

    def _of_pixels(self, new: Relabelled, neutral: NeutralLight) -> _Labels:
        """Return which surface each pixel shows, (H, W): that of the places around, or where these differ its own."""
        look, lattice, (height, width) = self._look, self._lattice, self._look.unlit.shape
        rows, columns = lattice.rows, lattice.columns
        shown = np.where(new.labels == NO_SURFACE, 0, new.labels + 1).astype(np.uint8)
        near = cv2.dilate(shown, lattice.square(2 * columns))
        nearest = np.maximum(np.where(shown == 0, near, shown), 1) - 1
        labels = nearest.repeat(rows, axis=0)[:height].repeat(columns, axis=1)[:, :width]
        labels = labels | -look.unlit.view(np.uint8)  # all bits set, NO_SURFACE: np.where takes 50 times as long
        if len(new.kept) > 1:
            cells = cells_of_pixels(lattice, new.labels, (height, width))
            nodes = (look.contrast, look.unlit, look.levels)
            seen = average_light(look.device_image, look.gains, look.crosstalk, *nodes, 1, 1, 0, cells)
            doubt = self._known.contrast_doubt
            choose_surfaces(*seen, cells, neutral, look.levels, doubt, self._scatter, lattice, new.around, labels)
        return labels

    def _fit(self, *, ends: bool = False) -> FittedMatrices | None:
        """Fit the surfaces' matrices; None if there is no surface.

        Noise alone distinguishes surfaces best; in the end the model's error, which is larger, is included.
        """
        look, known, chosen = self._look, self._known, self._chosen()
        if not chosen:
            return None
        self._renumber(list(chosen))
        before = self._fitted
        budget = _FIRST_SAMPLES if before is None else _SAMPLES
        spread = np.arange(min(budget // len(chosen), _MOST_SAMPLES)) * _GOLDEN % 1
        places = np.stack([own[(spread * len(own)).astype(np.intp)] for own in chosen.values()])
        light = self._lattice.light.reshape(-1, 3)[places].swapaxes(1, 2)
        level = light.mean(axis=2, dtype=np.float64)
        colors, white = self._colors, known.matrix * self._white[:, None]
        expected = np.minimum(look.ambient * colors / colors.mean(axis=1, keepdims=True), _MOST_AMBIENT * level)
        if self._ambient is None:
            self._ambient = expected
            colors = np.maximum(level - expected, TINY)
        predictions = [PredictedMatrices.of(colors, white, bands) for bands in self._bands]
        matrices = predictions[0].matrices
        if before is not None:
            matrices = np.concatenate([before.matrices, matrices[len(before.matrices) :]])
        unmixing = phase_weights(np.asarray(np.linalg.inv(matrices), np.float64), known.lag)
        share = np.minimum(1, [len(own) / len(spread) for own in chosen.values()])
        around, contrast = look.around.ravel()[places], self._lattice.contrast.ravel()[places]
        samples = look.surface_samples(light, around, contrast, unmixing, self._ambient, share, known.contrast_doubt)
        if ends:
            samples = replace(samples, variance=samples.variance + (MODEL_ERROR * light) ** 2)
        given = (expected, self._ambient, known.light, known.doubt)
        results = [fit_matrices(samples, by, *given, before, fit_light=not ends) for by in predictions]
        if before is None:  # only a second step shows which prediction fits: ambient light hides it from the first
            both = zip(predictions, results, strict=True)
            results = [fit_matrices(samples, by, *given, first, fit_light=True) for by, first in both]
        # Light that scatters looks a little like colours that act after the crosstalk, which are not usual; a frame's
        # only colour may be that of a lamp.
        costs = np.array([result.cost for result in results])
        costs[1:] += PROOF * (len(chosen) > 1)
        best = int(costs.argmin())
        self._bands = [self._bands[best]]
        return results[best]

    def _chosen(self) -> dict[int, npt.NDArray[np.intp]]:
        """Return places of every surface that has enough of them, by its number."""
        clear, inside = self._lattice.says.ravel(), ~self._near_edges(2 * _EDGE_PX).ravel()
        labels, chosen = self._labels.ravel(), {}
        for surface in range(len(self._colors)):
            own = clear & (labels == surface)
            places = np.flatnonzero(own & inside)
            if len(places) < _LEAST_SAMPLES:
                places = np.flatnonzero(own)
            if len(places) >= _LEAST_SAMPLES:
                chosen[surface] = places
        return chosen

    def _neutral(self, fitted: FittedMatrices) -> NeutralLight:
        return NeutralLight.of(fitted.matrices, fitted.ambient, fitted.light, self._known.lag)

    def _relabel(self, fitted: FittedMatrices, neutral: NeutralLight, *, afresh: bool = False) -> Relabelled:
        """Give every place to the surface that explains it best."""
        lattice, levels, doubt = self._lattice, self._look.levels, self._known.contrast_doubt
        residuals = surface_residuals(lattice, neutral, levels, doubt)
        self._scatter = self._scatter or measure_scatter(lattice, residuals, ~self._near_edges(_EDGE_PX))
        misfits = np.where(lattice.says, np.minimum((residuals / self._scatter) ** 2, MOST_MISFIT), np.float32(-1))
        alike = self._alike(fitted) if doubt else np.zeros(len(misfits), bool)
        return relabel(lattice, misfits, self._labels, self._first, alike, afresh=afresh)

    def _alike(self, fitted: FittedMatrices) -> _Mask:
        """Return which surfaces have nearly the colour of a larger one."""
        ratios = color_ratios(fitted.matrices.sum(axis=2))
        sizes = self._sizes(fitted)
        apart = np.abs(ratios[:, None] - ratios).max(axis=2)
        return np.asarray(((apart < _ALIKE) & (sizes > sizes[:, None])).any(axis=1))

    def _keep(self, new: Relabelled, fitted: FittedMatrices) -> FittedMatrices:
        """Continue with a candidate that has proved to be a surface, and return it."""
        in_vain = [k for k in np.flatnonzero(~self._first) if k not in new.kept]
        self._tried = self._tried | np.isin(self._labels, in_vain)
        self._fitted = kept = fitted.only(new.kept)
        self._labels, self._ambient = new.labels, kept.ambient
        self._colors = kept.matrices.sum(axis=2)
        self._first = self._first[new.kept]
        return kept

    def _add(self, unexplained: _Mask) -> bool:
        """Make new surfaces of places that none explains, and return whether there are any."""
        lattice, count = self._lattice, len(self._colors)
        least = LEAST_PX / lattice.pixels
        if np.count_nonzero(unexplained) < least or self._ambient is None:
            return False
        sigma = _COLOR_CYCLES * lattice.period_px
        share = lattice.blurred(unexplained, sigma)[..., None]
        seen = lattice.blurred(np.where(unexplained[..., None], lattice.light, 0), sigma)
        ratios = color_ratios((seen / np.maximum(share, TINY))[unexplained])
        centers = common_colors(ratios, np.ones(len(ratios)), least)[: max(0, MOST_COLORS - count)]
        nearest = nearest_colors(ratios, centers)
        places = [_largest_part(unexplained, nearest == k, least) for k in range(len(centers))]
        places = [place for place in places if np.count_nonzero(place) >= least]
        if not places:
            return False
        light = np.array([lattice.light[place].mean(axis=0) for place in places], np.float64)
        ambient = np.minimum(np.median(self._ambient, axis=0), _MOST_AMBIENT * light)
        self._labels = self._labels.copy()
        for number, place in enumerate(places, count):
            self._labels[place] = number
        self._colors = np.concatenate([self._colors, np.maximum(light - ambient, TINY)])
        self._ambient = np.concatenate([self._ambient, ambient])
        self._first = np.concatenate([self._first, np.zeros(len(places), bool)])
        return True

    def _renumber(self, numbers: list[int]) -> None:
        """Keep the surfaces with these numbers only."""
        if len(numbers) == len(self._colors):
            return
        table = np.zeros(NO_SURFACE + 1, np.uint8)
        table[numbers], table[NO_SURFACE] = np.arange(len(numbers)), NO_SURFACE
        self._labels = table[self._labels]
        self._colors = self._colors[numbers]
        self._first = self._first[numbers]
        if self._ambient is not None:
            self._ambient = self._ambient[numbers]
        if self._fitted is not None:
            self._fitted = self._fitted.only([k for k in numbers if k < len(self._fitted.matrices)])

    def _near_edges(self, width_px: int) -> _Mask:
        """Return which places have others around, in a square, that show another surface."""
        square = self._lattice.square(width_px)
        return np.asarray(cv2.dilate(self._labels, square) != cv2.erode(self._labels, square))


def _largest_part(mask: _Mask, chosen: _Mask, least: float) -> _Mask:
    """Return the largest connected part of the chosen ones of a mask's places: it is of one surface.

    All of them, if none is large enough for a surface.
    """
    all_of_them = np.zeros(mask.shape, np.uint8)
    all_of_them[mask] = chosen
    _, parts, sizes, _ = cv2.connectedComponentsWithStats(all_of_them, connectivity=4)
    areas = sizes[1:, cv2.CC_STAT_AREA]
    if len(areas) == 0 or areas.max() < least:
        return np.asarray(all_of_them > 0)
    return np.asarray(parts == 1 + areas.argmax())
