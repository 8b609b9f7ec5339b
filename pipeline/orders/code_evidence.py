"""How probable each offset of a part is, by the contrast that its blocks show of the pattern's code.

At every offset that a part may have, its blocks should show the code's contrasts there, but for a factor whose
logarithm is a plane over the part less a share of ambient light, as where a surface turns away it is darker. Plane and
share are fitted at each offset. A block deviates from the fit by noise and a spread, or shows something else, as at
the edges of a surface does. The spread is not known, and integrated over. `docs/coded_pattern.md` has the derivation.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.contrast_code import CYCLES, GAMMAS, WORD_CELLS, ContrastCode
from pipeline.models import FloatArray
from pipeline.orders.code_blocks import Blocks
from pipeline.orders.posterior import NOTHING_KNOWN, Integers, Posterior
from pipeline.orders.stripe_columns import StripeColumns, column_at
from tikernels.order_evidence.contrast_reading import BLOCK_WIDTH
from tikernels.unwrapping.tables import CELL_HEIGHT

# What a block's contrast deviates by beside the camera's noise (natural logarithm), and the one that is fitted with.
SPREADS = np.array([0.006, 0.012, 0.024, 0.048])
_FITTED = 0.012
# How probably a block shows something else than the code, and how far that then lies off.
_OTHER, _OTHER_SIGMA = 0.15, 0.2
# Blocks side by side deviate alike: each counts as this many. Those of a cycle with one symbol do so all along, by what
# is not known of the response: they count as this many together.
_INDEPENDENT, OF_CYCLE = 0.6, 2.0
# Standard deviations of a part's factor: of its slopes (a px), of ambient light's share, and of its middle, about the
# frame's once that is known.
_SLOPE, _AMBIENT, _GAIN, _ANY_GAIN = 5e-4, 0.25, 0.08, 0.5
# Rounds in which a fit finds out which blocks show something else.
_ROUNDS = 3
# A large part's likeliest offsets are found by some of its blocks, and weighed by many.
_SOME, _LIKELIEST, _MANY = 300, 4, 1200
# Of a part's blocks, those whose orders may lie outside the pattern at either end; and how probably a part shows no
# code.
_STRAYS, _NO_CODE = 0.05, 0.1
# Shifts of half a cell either way that are tried, which share of a cell is too far to be believed, and by how much
# likelier one far off must be than any other, and than no code at all.
_SHIFTS, _MOST_SHIFT, _SURE_SHIFT = 13, 0.25, 20.0
# Where much is tried of the largest parts, so many of their blocks are looked at.
_FEW = 100
# By how much likelier than no code, or another one, a frame's largest parts must be to show it (natural logarithm), or
# less likely not to; and how much that may count for other parts: where the rig has been turned a part of the picture
# may lie elsewhere.
_SHOWN, _MOST_TRUST = 5.0, 12.0
# A factor changes from surface to surface of a part: of parts of more blocks than this, what is left of it in so many
# blocks and rows of patches around each is taken off, at most so much of each block.
_FLATTENED, _AROUND, _MOST_LOCAL = 100, (5, 3), 0.2
# Levels that stand for all of a code's.
_LEVELS = 8
# From so many cycles off its middle on a cycle is cut, and what its neighbours' levels then count, a cycle: half of
# what they do for the contrast itself, which the levels have softened.
_OFF, _OF_NEIGHBOURS = 0.02, 0.6
# Offsets of a part under which responses are compared.
_NAMED = 3
# So many of the largest parts tell what all parts of a frame have in common.
_TELLING = 3


@dataclass(frozen=True)
class Factor:
    """What a part's contrasts have in common beside the code: the logarithm of a factor."""

    middle: FloatArray  # (2,) row and column, px
    brightness: float  # levels
    terms: FloatArray  # (4, ...) at the middle, slopes a row and a column, and by ambient light; one for each offset

    @staticmethod
    def shape(place: FloatArray, brightness: FloatArray, middle: FloatArray, usual: float) -> FloatArray:
        """Return (n, 4): what a factor is made of, at these places."""
        darker = np.clip(usual / brightness - 1, -1, 3)
        return np.column_stack([np.ones(len(place)), place - middle, darker])

    def at(self, place: FloatArray, brightness: FloatArray) -> FloatArray:
        """Return the factor's logarithm (n, ...) at places (n, 2) that are so bright."""
        return self.shape(place, brightness, self.middle, self.brightness) @ self.terms


@dataclass(frozen=True)
class PartEvidence:
    """What a part's blocks say of each of its offsets."""

    first: int  # the smallest offset
    likelihood: FloatArray  # (n,) logarithm, of that offset and those that follow
    even: float  # logarithm, if all blocks show the same level
    other: float  # logarithm, if each block, or cycle, shows a level of its own
    gain: float  # the factor's logarithm in its middle, at the likeliest offset

    @property
    def best(self) -> int:
        """The likeliest offset; 0 where nothing is known."""
        return self.first + int(self.likelihood.argmax()) if len(self.likelihood) else 0

    def no_code(self, trust: float) -> float:
        """Return the logarithm of the likelihood that the part does not show the code.

        By `trust` it is the likelier that the code lies where it is expected than anywhere else (logarithm).
        """
        return float(np.logaddexp(self.even, self.other - trust))

    def posterior(self, prior: FloatArray | float, luck: float, trust: float) -> Posterior:
        """Return how probable each offset is.

        Parameters
        ----------
        prior : (n,) float
            Logarithm of how probable the offsets are otherwise.
        luck : float
            Logarithm by how much likelier than it seems the part shows no code at all.
        trust : float
            As for `no_code`.
        """
        if len(self.likelihood) == 0:
            return NOTHING_KNOWN
        prior = prior - _log_sum(prior + np.zeros(len(self.likelihood)))
        shown = np.log(1 - _NO_CODE) + self.likelihood + prior
        none = np.log(_NO_CODE) + self.no_code(trust) + luck + prior
        together = np.logaddexp(shown, none)
        probability = np.exp(together - together.max())
        return Posterior(self.first, probability / probability.sum())


class CodeReader:
    """Reads the code in the blocks of a frame.

    Parameters
    ----------
    blocks : Blocks
        Of the frame.
    code : ContrastCode
        The pattern's.
    columns : StripeColumns, optional
        Where places look at each order; only a code that changes along the stripe needs them.
    """

    def __init__(self, blocks: Blocks, code: ContrastCode, columns: StripeColumns | None) -> None:
        self.blocks = blocks
        self.cycles = CYCLES if columns is None else min(CYCLES, int(columns.cycles) + 1)
        self.code, self._gamma = code, GAMMAS.index(2.0)
        #: By how many px the code lies further along the stripe than the calibration says.
        self.shift_px = 0.0
        self._gain: float | None = None
        self._evidence: dict[bytes, PartEvidence] = {}
        #: Logarithm by how much likelier the code lies where it is expected than anywhere else.
        self.trust = 0.0
        #: (N, 4) where each block looks along the stripe: terms of a polynomial of its order, px.
        self.columns, width_px = np.zeros((len(blocks.order), 4), np.float32), 0.0
        if code.cell_px is not None and columns is not None:
            self.columns, width_px = columns.terms(blocks.place), columns.block_px
        #: (gammas, cycles, places)
        self.levels = code.levels(width_px)[:, : self.cycles]

    @property
    def levels_now(self) -> FloatArray:
        """(cycles, places): the code's levels under the frame's response."""
        return np.asarray(self.levels[self._gamma])

    def expected(
        self,
        which: Integers,
        orders: Integers,
        shifts_px: FloatArray | float = 0.0,
        gammas: Integers | None = None,
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Return (n, ...) the code's levels where blocks (n,) have orders (n, ...), and whether the code has those.

        As if the code lay so many px further along the stripe, under responses of these numbers.
        """
        inside = (orders >= 0) & (orders < self.cycles)
        orders, response = np.clip(orders, 0, self.cycles - 1), self._gamma if gammas is None else gammas
        along = column_at(self.columns[which], orders) + shifts_px
        inside &= np.isfinite(along)  # some rays meet the pattern nowhere
        places = self.code.place_at(np.nan_to_num(along))
        expected = self.levels[response, orders, places]
        # Of a cycle of which one side is seen, the neighbour on that side shows more.
        off = self.blocks.off[which]
        cut = np.flatnonzero(np.abs(off) > _OFF)
        if len(cut):
            orders, places = orders[cut], places[cut]
            more, less = np.minimum(orders + 1, self.cycles - 1), np.maximum(orders - 1, 0)
            change = self.levels[response, more, places] - self.levels[response, less, places]
            expected[cut] += _OF_NEIGHBOURS * off[cut].reshape(-1, *(1,) * (orders.ndim - 1)) * change
        return expected, inside

    def fit(
        self,
        which: Integers,
        offsets: Integers,
        *,
        shifts_px: FloatArray | float = 0.0,
        gammas: Integers | None = None,
        contrast: FloatArray | None = None,
        no_code: bool = False,
    ) -> tuple[FloatArray, Factor]:
        """Fit the factor of a part with these blocks (n,) at every offset (K,).

        Parameters
        ----------
        which, offsets
            What is looked at.
        shifts_px : (K,) float
            By how many px the code lies further along the stripe; one for each offset.
        gammas : (K,) int, optional
            Numbers of responses, if not the frame's.
        contrast : (n,) float, optional
            The blocks' contrasts, if not as they were seen.
        no_code : bool
            Return as well how likely the blocks are if all have the same level, and if each, or each cycle, has one of
            the code's by itself.

        Returns
        -------
        (K,) float64
            Logarithm of the likelihood.
        Factor
            At each offset.
        """
        blocks = self.blocks
        contrast = blocks.contrast[which] if contrast is None else contrast
        expected, inside = self.expected(which, blocks.order[which][:, None] + offsets, shifts_px, gammas)
        if no_code:
            expected = np.column_stack([expected, np.full(len(which), self.levels[self._gamma].mean())])
            inside = np.column_stack([inside, np.ones(len(which), np.bool_)])
        place, brightness = blocks.place[which], blocks.brightness[which]
        middle, usual = place.mean(axis=0), float(np.median(brightness))
        shape = Factor.shape(place, brightness, middle, usual)
        remains, variance = contrast[:, None] - expected, blocks.variance[which]
        counts = self._counts(which)
        likelihood, terms = fit_levels(remains, inside, shape, variance, counts, self._gain)
        if no_code:
            levels = self.levels[self._gamma, ::3, ::5]
            any_of = np.quantile(levels - levels.mean(), (np.arange(_LEVELS) + 0.5) / _LEVELS)
            departs = remains[:, -1] - shape @ terms[:, -1]
            shown = densities(departs[:, None] - any_of, variance) ** counts[:, None]
            if self.code.cell_px is None:
                sort = np.argsort(blocks.order[which], kind="stable")
                starts = np.flatnonzero(np.diff(blocks.order[which][sort], prepend=np.iinfo(np.int64).min))
                shown = np.multiply.reduceat(shown[:, sort], starts, axis=1)
            with np.errstate(divide="ignore"):
                other = _mean_of(np.log(shown.mean(axis=2)).sum(axis=1))
            likelihood = np.append(likelihood, other)
        return likelihood, Factor(middle, usual, terms)

    def _counts(self, which: Integers) -> FloatArray:
        """Return as how many each of these blocks (n,) of a part counts."""
        if self.code.cell_px is not None:
            return np.full(len(which), _INDEPENDENT)
        # Of a cycle's blocks those without noise count most.
        precision = 1 / (self.blocks.variance[which] + _FITTED**2)
        _, cycle = np.unique(self.blocks.order[which], return_inverse=True)
        return np.minimum(_INDEPENDENT, OF_CYCLE * precision / np.bincount(cycle, precision)[cycle])

    def read(self, which: Integers) -> PartEvidence:
        """Return what the blocks (n,) of a part say of its offsets."""
        key = self.blocks.order[which].tobytes() + self.blocks.place[which].tobytes()
        if key not in self._evidence:
            self._evidence[key] = self._read(which)
        return self._evidence[key]

    def _read(self, which: Integers) -> PartEvidence:
        offsets = self.offsets(which)
        if len(offsets) == 0:
            return PartEvidence(0, np.zeros(0), 0.0, 0.0, 0.0)
        shown, factor = self.fit(_thinned(which, _SOME), offsets, no_code=True)
        likelihood, gains = shown[:-2], factor.terms[0, :-1]
        if len(which) > _FLATTENED:
            likely, many = np.argsort(likelihood)[-_LIKELIEST:], _thinned(np.arange(len(which)), _MANY)
            found, flat = np.empty(len(likely)), []
            for n, k in enumerate(likely):  # each as if what is left of the factor were so by its offset
                flat.append(self.flattened(which, int(offsets[k]), _AROUND)[many])
                found[n : n + 1], factor = self.fit(which[many], offsets[k : k + 1], contrast=flat[n])
                gains[k] = factor.terms[0, 0]
            best = int(found.argmax())
            shown, _ = self.fit(which[many], offsets[likely[best : best + 1]], contrast=flat[best], no_code=True)
            # The others were less likely than any of these.
            likelihood = np.full(len(offsets), found.min())
            likelihood[likely] = found
        even, other = map(float, shown[-2:])
        return PartEvidence(int(offsets[0]), likelihood, even, other, float(gains[likelihood.argmax()]))

    def flattened(self, which: Integers, offset: int, around: tuple[int, int]) -> FloatArray:
        """Return the contrasts (n,) of a part's blocks as if its factor were the same all over.

        What so many blocks and rows of patches around each are off the code at this offset is taken off, too.
        """
        blocks = self.blocks
        _, factor = self.fit(_thinned(which, _SOME), np.array([offset]))
        usual = float(factor.terms[0, 0])
        flat = blocks.contrast[which] - factor.at(blocks.place[which], blocks.brightness[which])[:, 0] + usual
        departs = flat - usual - self.expected(which, blocks.order[which] + offset)[0]
        departs = np.clip(departs, -_MOST_LOCAL, _MOST_LOCAL)
        row, column = (blocks.place[which] / (CELL_HEIGHT, BLOCK_WIDTH)).astype(int).T
        row, column = row - row.min(), column - column.min()
        shape = int(row.max()) + 1, int(column.max()) + 1
        sums = [np.bincount(row * shape[1] + column, weights, np.prod(shape)) for weights in (departs, None)]
        total, count = (cv2.blur(plane.reshape(shape).astype(np.float32), around, borderType=0) for plane in sums)
        return np.asarray(flat - (total / np.maximum(count, 1e-6))[row, column])

    def offsets(self, which: Integers) -> Integers:
        """Return the offsets at which the pattern has the orders of these blocks, but for some strays."""
        if len(which) == 0:
            return np.zeros(0, np.int64)
        low, high = np.quantile(self.blocks.order[which], [_STRAYS, 1 - _STRAYS], method="nearest")
        return np.arange(-low, self.cycles - high)

    def read_all(self, parts: Integers) -> list[PartEvidence]:
        """Return what the blocks of each part (n,) say."""
        sort = np.argsort(self.blocks.root, kind="stable")
        ends = (np.searchsorted(self.blocks.root[sort], parts, side) for side in ("left", "right"))
        return [self.read(sort[first:last]) for first, last in zip(*ends, strict=True)]

    def learn(self) -> bool | None:
        """Take response, usual factor and shift from the frame's largest parts, and say if they show the code.

        None: they are too small to say.
        """
        largest = self._largest()
        if not largest:
            return False
        # The likeliest offsets hardly depend on the response, nor on a small shift.
        gammas, tried = np.repeat(np.arange(len(GAMMAS)), _NAMED), []
        for some in largest:
            few, offsets = _thinned(some, _FEW), self.offsets(some)
            likeliest = np.resize(offsets[np.argsort(self.fit(few, offsets)[0])[-_NAMED:]], _NAMED)
            named = np.tile(likeliest, len(GAMMAS))
            likelihood, factor = self.fit(few, named, gammas=gammas)
            tried.append(np.stack([likelihood, named, factor.terms[0]]).reshape(3, len(GAMMAS), _NAMED))
        self._gamma = int(sum(likelihood.max(axis=1) for likelihood, _, _ in tried).argmax())
        found = [each[1:, self._gamma, each[0, self._gamma].argmax()] for each in tried]
        self._gain = float(np.median([gain for _, gain in found]))
        self.shift_px = self._shift_near(largest, [int(offset) for offset, _ in found])
        self._move(0.0 if self.is_far else self.shift_px)
        more = 0.0
        for some in largest:
            part = self.read(some)
            more += _log_sum(part.likelihood) - np.log(len(part.likelihood)) - part.no_code(0.0)
        self.trust = min(max(more, 0.0), _MOST_TRUST)
        if more <= _SHOWN and not self.is_far:  # nor is it known where it lies
            self._move(-self.shift_px)
            self.shift_px = 0.0
        return None if abs(more) <= _SHOWN else bool(more > 0)

    def _largest(self) -> list[Integers]:
        """Return the blocks of the largest parts."""
        roots, counts = np.unique(self.blocks.root, return_counts=True)
        largest = [np.flatnonzero(self.blocks.root == root) for root in roots[np.argsort(counts)[-_TELLING:]]]
        return [some for some in largest if len(self.offsets(some))]

    def _shift_near(self, largest: list[Integers], offsets: list[int]) -> float:
        """Return by how many px the code lies further along the stripe, at most half a cell, by the largest parts."""
        if self.code.cell_px is None:
            return 0.0
        shifts, total = np.linspace(-0.5, 0.5, _SHIFTS) * self.code.cell_px, np.zeros(_SHIFTS)
        for some, offset in zip(largest, offsets, strict=True):
            total += self.fit(_thinned(some, _SOME), np.full(_SHIFTS, offset), shifts_px=shifts)[0]
        return _peak(shifts, total)

    @property
    def is_far(self) -> bool:
        """Whether the code lies too far off to be read there."""
        return self.code.cell_px is not None and abs(self.shift_px) > _MOST_SHIFT * self.code.cell_px

    def shift_anywhere(self) -> float | None:
        """Return the shift over half a repeat of the code either way, whatever the offsets; None: nothing tells.

        Elsewhere nothing tells the response either: a linear and the usual one are tried.
        """
        if self.code.cell_px is None:
            return None
        shifts = np.arange(-0.5, 0.5, 0.25 / WORD_CELLS) * self.code.repeats_px
        totals = np.zeros((2, len(shifts)))
        for total, self._gamma in zip(totals, (GAMMAS.index(1.0), GAMMAS.index(2.0)), strict=True):
            for some in self._largest():
                offsets, few = self.offsets(some), _thinned(some, _FEW)
                each, further = np.repeat(offsets, len(shifts)), np.tile(shifts, len(offsets))
                likelihood, _ = self.fit(few, each, shifts_px=further, no_code=True)
                by_offset = likelihood[:-2].reshape(len(offsets), -1)
                total += np.logaddexp.reduce(by_offset, axis=0) - np.log(len(offsets)) - np.logaddexp(*likelihood[-2:])
        total = totals[totals.max(axis=1).argmax()]
        off = np.abs(shifts - shifts[total.argmax()])
        elsewhere = total[np.minimum(off, self.code.repeats_px - off) > self.code.cell_px].max()
        return _peak(shifts, total) if total.max() - max(elsewhere, 0.0) > _SURE_SHIFT else None

    def _move(self, shift_px: float) -> None:
        """Read the code so many px further along the stripe, from now on."""
        self.columns[:, 0] += shift_px
        self._evidence.clear()

    def again(self, other: "CodeReader") -> "CodeReader":
        """Return the reader of other blocks of the frame with what was learnt of it."""
        other._gamma, other._gain, other.trust, other.shift_px = self._gamma, self._gain, self.trust, self.shift_px
        other._move(self.shift_px)
        other._evidence = self._evidence
        return other


def fit_levels(
    remains: FloatArray,
    inside: npt.NDArray[np.bool_],
    terms: FloatArray,
    variance: FloatArray,
    counts: FloatArray,
    gain: float | None,
) -> tuple[FloatArray, FloatArray]:
    """Fit a part's factor to what the code leaves of its blocks' contrasts, at each offset.

    Parameters
    ----------
    remains : (n, K) float
        Natural logarithm.
    inside : (n, K) bool
        Whether the code has such a cycle.
    terms : (n, 4) float
        What the factor is made of.
    variance : (n,) float
        Of the contrasts, by noise.
    counts : (n,) float
        As how many each block counts.
    gain : float, optional
        The usual factor in the frame.

    Returns
    -------
    (K,) float64
        Logarithm of the likelihood.
    (4, K) float64
        How much there is of each term.
    """
    usual = np.median(remains, axis=0) if gain is None else gain
    prior = np.diag(np.array([_ANY_GAIN if gain is None else _GAIN, _SLOPE, _SLOPE, _AMBIENT]) ** -2.0)
    departs = remains - usual
    pairs = (terms[:, :, None] * terms[:, None]).reshape(len(terms), 16)
    noise = variance[:, None] + _FITTED**2
    # From the median on: what shows something else must not pull at the start.
    fit: FloatArray = np.zeros((4, remains.shape[1]))
    fit[0] = np.median(departs, axis=0)
    normal: FloatArray = np.broadcast_to(prior, (remains.shape[1], 4, 4))
    for _ in range(_ROUNDS):
        squares = (departs - terms @ fit) ** 2
        far = noise + _OTHER_SIGMA**2
        with np.errstate(over="ignore"):
            odds = _OTHER / (1 - _OTHER) * np.sqrt(noise / far) * np.exp(0.5 * squares * (1 / noise - 1 / far))
        weights = counts[:, None] * inside / noise / (1 + odds)
        normal = (weights.T @ pairs).reshape(-1, 4, 4) + prior
        fit = np.asarray(np.linalg.solve(normal, ((weights * departs).T @ terms)[..., None])[..., 0].T, np.float64)
    far = np.log(_OTHER / np.sqrt(variance + _OTHER_SIGMA**2))[:, None]
    shown = counts @ np.where(inside, np.log(densities(departs - terms @ fit, variance)), far)
    cost = np.einsum("ik,ij,jk->k", fit, prior, fit) + np.linalg.slogdet(normal)[1] - np.linalg.slogdet(prior)[1]
    fit[0] += usual
    return np.asarray(_mean_of(shown) - 0.5 * cost), fit


def densities(departs: FloatArray, variance: FloatArray) -> FloatArray:
    """Return (spreads, n, K) how usual it is, under each spread, that blocks deviate from the code by so much.

    Parameters
    ----------
    departs : (n, K) float
        Natural logarithm.
    variance : (n,) float
        Of the contrasts, by noise.
    """
    squares, far = departs**2, variance[:, None] + _OTHER_SIGMA**2
    near = variance[:, None] + SPREADS[:, None, None] ** 2
    other = _OTHER * np.exp(-0.5 * squares / far) / np.sqrt(far)
    return np.asarray((1 - _OTHER) * np.exp(-0.5 * squares / near) / np.sqrt(near) + other)


def _thinned(which: Integers, most: int) -> Integers:
    """Return at most so many blocks of a part, spread over it."""
    return which[:: -(-len(which) // most)]


def _mean_of(logarithms: FloatArray) -> FloatArray:
    """Return the logarithm of the mean over the first axis."""
    top = logarithms.max(axis=0)
    return np.asarray(top + np.log(np.exp(logarithms - top).mean(axis=0)))


def _peak(places: FloatArray, values: FloatArray) -> float:
    """Return where values are largest, by a parabola through the largest and those beside it."""
    k = min(max(int(values.argmax()), 1), len(values) - 2)
    low, here, high = values[k - 1 : k + 2]
    bend = low - 2 * here + high
    step = 0.0 if bend >= 0 else min(max(0.5 * (low - high) / bend, -1.0), 1.0)
    return float(places[k] + step * (places[1] - places[0]))


def _log_sum(logarithms: FloatArray) -> float:
    top = float(logarithms.max())
    return top + float(np.log(np.exp(logarithms - top).sum()))
