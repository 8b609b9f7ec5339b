"""Probabilities of the offsets of a part, by the contrast that its blocks show of the pattern's code.

At every offset that a part may have, its blocks should show the code's contrasts there, but for a factor whose
logarithm is a plane over the part less a share of ambient light, as where a surface turns away it is darker. Plane and
share are fitted at each offset. A block deviates from the fit by noise and a spread, or shows something else, as at
the edges of a surface does. The spread is not known, and integrated over. `docs/coded_pattern.md` has the derivation.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.contrast_code import CYCLES, GAMMAS, WORD_CELLS, ContrastCode
from pipeline.models import FloatArray
from pipeline.orders.code_blocks import Blocks
from pipeline.orders.posterior import NOTHING_KNOWN, Integers, Posterior
from pipeline.orders.stripe_columns import StripeColumns, column_at
from pipeline.robust import robust_sigma
from tikernels import runtime
from tikernels.order_evidence.contrast_reading import BLOCK_WIDTH
from tikernels.order_evidence.factor_fit import EVEN, FITTED, LEVELS, ROWS, Fitted, Row, fit_factors, flatten
from tikernels.unwrapping.tables import CELL_HEIGHT

# The blocks of a cycle with one symbol deviate alike, by what is not known of the response: they count as this many
# together, those without noise most.
OF_CYCLE = 2.0
# Standard deviations of a part's factor: of its slopes (per px), of ambient light's share, and of its middle, about the
# frame's once that is known.
_SLOPE, _AMBIENT, _GAIN, _ANY_GAIN = 5e-4, 0.25, 0.08, 0.5
# A large part's likeliest offsets are found by some of its blocks, and weighed by many; those of which the logarithm of
# the likelihood is less by this are no contenders.
_SOME, _LIKELIEST, _MANY, _CONTENDS = 300, 4, 1200, 30.0
# Of a part's blocks, those whose orders may lie outside the pattern at either end; and how probably a part shows no
# code.
_STRAYS, _NO_CODE = 0.05, 0.1
# Of a part's blocks, those at either end whose brightness is not most of the part's.
_UNUSUAL = 0.1
# Shifts of half a cell either way that are tried, which share of a cell is too far to be believed, and by how much
# likelier one far off must be than any other, and than no code at all.
_SHIFTS, _MOST_SHIFT, _SURE_SHIFT = 13, 0.25, 33.0
# Where all offsets are tried at many shifts, so many of a part's blocks are used.
_FEWEST = 25
# By how much likelier than no code, or another one, a frame's largest parts must be to show it (natural logarithm), or
# its largest one not to; and how much that may count for other parts: where the rig has been turned a part of the
# picture may lie elsewhere. It is plain to see where it is likelier by so much a block.
_SHOWN, _MOST_TRUST, _PLAIN = 6.0, 12.0, 0.25
# A factor changes from surface to surface of a part: of parts of more blocks than this, what is left of it in so many
# blocks and rows of patches around each is subtracted, averaged over blocks of the same class of brightness and the
# adjacent classes, so many to a factor of two.
_FLATTENED, _AROUND, _CLASSES = 100, (5, 3), 2
# From so many cycles off its middle on a cycle is cut, and what its neighbours' levels then count, a cycle: half of
# what they do for the contrast itself, which the levels have softened.
_OFF, _OF_NEIGHBOURS = 0.02, 0.6
# Offsets of a part under which responses, or shifts, are compared.
_NAMED = 3
# So many of the largest parts determine what all parts of a frame have in common.
_LARGEST = 3
# By how many standard deviations a block may be off where it is compared with its neighbours.
_MOST_APART = 3.0
# Outside every code.
_NO_ORDER = -1e6


@dataclass(frozen=True)
class Factor:
    """The factor that a part's contrasts share in addition to the code, as its logarithm."""

    middle: FloatArray  # (2,) row and column, px
    brightness: float  # levels
    terms: FloatArray  # (4, ...) at the middle, slopes per row and per column, and by ambient light; usual ones are 1

    @staticmethod
    def shape(place: FloatArray, brightness: FloatArray, middle: FloatArray, usual: float) -> FloatArray:
        """Return (n, 4): the terms of a factor at these places."""
        darker = _AMBIENT * np.clip(usual / brightness - 1, -1, 3)
        return np.column_stack([np.ones(len(place)), _SLOPE * (place - middle), darker])

    def at(self, place: FloatArray, brightness: FloatArray) -> FloatArray:
        """Return the factor's logarithm (n, ...) at places (n, 2) that are so bright."""
        return self.shape(place, brightness, self.middle, self.brightness) @ self.terms


@dataclass(frozen=True)
class PartEvidence:
    """Evidence of a part's blocks for each of its offsets."""

    first: int  # the smallest offset
    likelihood: FloatArray  # (n,) logarithm, of that offset and those that follow
    even: float  # logarithm, if all blocks show the same level
    other: float  # logarithm, if each block, or cycle, shows a level of its own
    terms: FloatArray  # (4, n) of the factor at each offset

    @property
    def best(self) -> int:
        """The likeliest offset; 0 where none is known."""
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


_UNREAD = PartEvidence(0, np.zeros(0), 0.0, 0.0, np.zeros((4, 0)))


@dataclass(eq=False)
class PartBlocks:
    """A part's blocks, as fits read them."""

    values: npt.NDArray[np.float32]  # (ROWS, n) see `Row`
    cells: npt.NDArray[np.int32]  # (3, n) row of patches, column of blocks, and class of brightness, from 0
    offsets: Integers  # at which the pattern has their orders
    middle: FloatArray  # (2,) row and column, px
    brightness: float  # usual, levels
    evidence: PartEvidence | None = None


class CodeReader:
    """Reads the code in the blocks of a frame.

    Parameters
    ----------
    blocks : Blocks
        Of the frame.
    code : ContrastCode
        The pattern's.
    columns : StripeColumns, optional
        Projector columns of places at each order; only a code that changes along the stripe needs them.
    """

    def __init__(self, blocks: Blocks, code: ContrastCode, columns: StripeColumns | None) -> None:
        self.blocks = blocks
        self.cycles = CYCLES if columns is None else min(CYCLES, int(columns.cycles) + 1)
        self.code = code
        #: Shift of the code along the stripe from its calibrated place, px.
        self.shift_px = self._moved_px = 0.0
        self._gain: float | None = None
        self._parts: dict[bytes, PartBlocks] = {}
        #: Logarithm by how much likelier the code lies where it is expected than anywhere else.
        self.trust = 0.0
        #: True if the frame shows the code there so clearly that it need not be searched for elsewhere.
        self.is_plain = False
        #: (N, 4) where each block looks along the stripe: terms of a polynomial of its order, px.
        self.columns, width_px = np.zeros((len(blocks.order), 4), np.float32), 0.0
        if code.cell_px is not None and columns is not None:
            self.columns, width_px = columns.terms(blocks.place), columns.block_px
        #: (gammas, cycles, places)
        self.levels = code.levels(width_px, self.cycles)
        self._gamma = GAMMAS.index(2.0)
        #: As how many each block counts under a code of cells.
        self._each_counts = 1.0
        self._any_of: dict[int, npt.NDArray[np.float32]] = {}  # by response; see `fit_factors`

    @property
    def levels_now(self) -> npt.NDArray[np.float32]:
        """(cycles, places): the code's levels under the frame's response."""
        return np.asarray(self.levels[self._gamma])

    def has(self, which: Integers, orders: Integers) -> npt.NDArray[np.bool_]:
        """Return (n,) whether the code has these orders where blocks (n,) look: some rays meet the pattern nowhere."""
        return np.asarray((orders >= 0) & (orders < self.cycles) & np.isfinite(self.columns[which, 0]))

    def expected(self, which: Integers, orders: Integers) -> FloatArray:
        """Return (n,) the code's levels where blocks (n,) have orders (n,), as far as the code has those."""
        orders = np.clip(orders, 0, self.cycles - 1)
        places, levels = np.zeros(len(which), np.int64), self.levels_now
        if self.code.cell_px is not None:
            places = self.code.place_at(np.nan_to_num(column_at(self.columns[which], orders)))
        expected, off = levels[orders, places].astype(np.float64), _of_neighbours(self.blocks.off[which])
        cut = np.flatnonzero(off)
        before, after = np.maximum(orders[cut] - 1, 0), np.minimum(orders[cut] + 1, self.cycles - 1)
        expected[cut] += off[cut] * (levels[after, places[cut]] - levels[before, places[cut]])
        return expected

    def _part(self, which: Integers) -> PartBlocks:
        """Return a part with these blocks (n,)."""
        key = self.blocks.order[which].tobytes() + self.blocks.contrast[which].tobytes()
        if key not in self._parts:
            self._parts[key] = self._new_part(which)
        return self._parts[key]

    def _new_part(self, which: Integers) -> PartBlocks:
        blocks, columns = self.blocks, self.columns.take(which, axis=0)
        place, brightness = blocks.place.take(which, axis=0), blocks.brightness[which]
        middle, usual = np.full(len(which), 1 / len(which)) @ place, float(np.median(brightness))
        values = np.empty((ROWS, len(which)), np.float32)
        values[Row.LEVEL], values[Row.VARIANCE] = blocks.contrast[which], blocks.variance[which]
        values[Row.DOWN : Row.DARKER + 1] = Factor.shape(place, brightness, middle, usual).T[1:]
        values[Row.OFF] = _of_neighbours(blocks.off[which])
        values[Row.ORDER] = np.where(np.isfinite(columns[:, 0]), blocks.order[which], _NO_ORDER)
        values[Row.COLUMN :] = np.nan_to_num(columns).T / np.float32(self.code.repeats_px)
        along_grid = np.column_stack([place / (CELL_HEIGHT, BLOCK_WIDTH), _CLASSES * np.log2(brightness)])
        cells = np.floor(along_grid).T.astype(np.int32, order="C")
        return PartBlocks(values, cells - cells.min(axis=1, keepdims=True), self.offsets(which), middle, usual)

    def fit(self, which: Integers, offset: int) -> tuple[Factor, FloatArray]:
        """Fit the factor of a part with these blocks (n,) at an offset, and return what is left of them (n,)."""
        part = self._part(which)
        *_, terms, departs = self._fit(part.values, np.array([offset]))
        return Factor(part.middle, part.brightness, terms[:, 0]), runtime.to_host(departs)[0].astype(np.float64)

    def _fit(
        self,
        values: npt.NDArray[np.float32],
        offsets: Integers,
        responses: Integers | None = None,
        shifts_px: FloatArray | float = 0.0,
        level: npt.NDArray[np.float32] | None = None,
    ) -> Fitted:
        """Fit the factor of a part's blocks (ROWS, n) at offsets (K,).

        As if the code lay so many px (K,) further along the stripe, and under responses of these numbers (K,), if not
        the frame's; and as if the blocks' contrasts were these levels (K, n), if not as they were seen.
        """
        values[Row.COUNTS] = self._counts(values)
        if self._gamma not in self._any_of:
            levels = np.sort(self.levels_now[::3, ::5], axis=None)
            some = np.interp((np.arange(LEVELS) + 0.5) / LEVELS, np.linspace(0, 1, len(levels)), levels - levels.mean())
            self._any_of[self._gamma] = np.append(self.levels_now.mean(), some).astype(np.float32)
        return fit_factors(
            values,
            self.levels,
            self._any_of[self._gamma],
            offsets,
            self._gamma if responses is None else responses,
            shifts_px / self.code.repeats_px,
            (self._gain, _ANY_GAIN if self._gain is None else _GAIN),
            by_cycle=self.code.cell_px is None,
            level=level,
        )

    def _counts(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return as how many each of a part's blocks (ROWS, n) counts."""
        if self.code.cell_px is not None:
            return np.full(values.shape[1], self._each_counts, np.float32)
        precision = 1 / (values[Row.VARIANCE] + FITTED**2)
        cycle = (values[Row.ORDER] - values[Row.ORDER].min()).astype(np.int64)
        return np.asarray(np.minimum(1.0, OF_CYCLE * precision / np.bincount(cycle, precision)[cycle]))

    def read(self, which: Integers) -> PartEvidence:
        """Return the evidence of the blocks (n,) of a part for its offsets."""
        if len(which) == 0:
            return _UNREAD
        part = self._part(which)
        if part.evidence is None:
            part.evidence = self._read(part)
        return part.evidence

    def _read(self, part: PartBlocks) -> PartEvidence:
        offsets = part.offsets
        if len(offsets) == 0:
            return _UNREAD
        shown = _thinned(part.values, _SOME)
        if part.values.shape[1] > _FLATTENED:
            likelihood, _, terms, _ = self._fit(shown, offsets)
            near = np.flatnonzero(likelihood > likelihood.max() - _CONTENDS)
            likely, shown = near[np.argsort(likelihood[near])[-_LIKELIEST:]], _thinned(part.values, _MANY)
            # Each as if what is left of the factor were so by its offset.
            flat = self._flat(part, offsets[likely], terms[:, likely], _AROUND, _step(part.values, _MANY))
            found = self._fit(shown, offsets[likely], level=flat).likelihood
            shown[Row.LEVEL] = flat[found.argmax()]
            # Other contenders were less likely than any of these, and the rest is as far behind as it was.
            likelihood += found.max() - likelihood.max()
            likelihood[near], likelihood[likely] = found.min(), found
            without = self._fit_with_even(shown, offsets[:0])
        else:
            without = self._fit_with_even(shown, offsets)
            likelihood, terms = without.likelihood[:-1], without.terms[:, :-1]
        even, other = float(without.likelihood[-1]), float(without.other[-1])
        return PartEvidence(int(offsets[0]), likelihood, even, other, terms)

    def _fit_with_even(self, values: npt.NDArray[np.float32], offsets: Integers) -> Fitted:
        """Fit the factor of a part's blocks (ROWS, n) at offsets (K,), and last as if they did not show the code."""
        if self.code.cell_px is None:
            values = np.take(values, np.argsort(values[Row.ORDER], kind="stable"), axis=1)
        return self._fit(values, np.append(offsets, 0), np.append(np.full(len(offsets), self._gamma), EVEN))

    def flattened(self, which: Integers, offsets: Integers | int, around: tuple[int, int]) -> FloatArray:
        """Return the contrasts (n,) of a part's blocks, at these offsets (n,), as if its factor were the same all over.

        The mean deviation from the code of the blocks about as bright that lie in so many blocks and rows of patches
        around each is taken off, too. The share of ambient light is that of blocks as bright as most of the part:
        fitted to a wall's shading, it would be wrong for dark paint in front.
        """
        part, none = self._part(which), np.zeros(1, np.int64)
        values = part.values.copy()
        values[Row.ORDER] += offsets
        terms = self._fit(_thinned(values, _SOME), none).terms
        usual = np.quantile(values[Row.DARKER], (_UNUSUAL, 1 - _UNUSUAL))
        values[Row.DARKER] = np.clip(values[Row.DARKER], *usual)
        return np.asarray(self._flat(replace(part, values=values), none, terms, around, 1)[0], np.float64)

    def _flat(
        self, part: PartBlocks, offsets: Integers, terms: FloatArray, around: tuple[int, int], step: int
    ) -> npt.NDArray[np.float32]:
        """Return the same at offsets (K,) with these terms (4, K) of the factor: (K, m), of so many blocks one."""
        reach = around[1] // 2, around[0] // 2
        return flatten(part.values, part.cells, offsets, terms, self.levels, self._gamma, reach, step)

    def offsets(self, which: Integers) -> Integers:
        """Return the offsets at which the pattern has the orders of these blocks, but for some strays."""
        if len(which) == 0:
            return np.zeros(0, np.int64)
        ends = [round(share * (len(which) - 1)) for share in (_STRAYS, 1 - _STRAYS)]
        low, high = np.partition(self.blocks.order[which], ends)[ends]
        return np.arange(-low, self.cycles - high)

    def blocks_of(self, parts: Integers) -> list[Integers]:
        """Return the blocks of each part (n,)."""
        sort = np.argsort(self.blocks.root, kind="stable")
        ends = (np.searchsorted(self.blocks.root[sort], parts, side) for side in ("left", "right"))
        return [sort[first:last] for first, last in zip(*ends, strict=True)]

    def read_all(self, parts: Integers) -> list[PartEvidence]:
        """Return the evidence of the blocks of each part (n,)."""
        return [self.read(own) for own in self.blocks_of(parts)]

    def learn(self) -> bool | None:
        """Take response, usual factor and shift from the frame's largest parts, and return whether it shows the code.

        None: unknown.
        """
        largest = self._largest()
        if not largest:
            return False
        # The likeliest offsets hardly depend on the response, nor on a small shift.
        gammas, tried, parts = np.repeat(np.arange(len(GAMMAS)), _NAMED), [], [self._part(some) for some in largest]
        for part in parts:
            few = _thinned(part.values, _SOME)
            likelihood = self._fit(few, part.offsets).likelihood
            likeliest = np.resize(part.offsets[np.argsort(likelihood)[-_NAMED:]], _NAMED)
            named = np.tile(likeliest, len(GAMMAS))
            likelihood, _, terms, _ = self._fit(few, named, responses=gammas)
            tried.append(np.stack([likelihood, named, terms[0]]).reshape(3, len(GAMMAS), _NAMED))
        self._gamma = int(sum(likelihood.max(axis=1) for likelihood, _, _ in tried).argmax())
        found = [each[1:, self._gamma, each[0, self._gamma].argmax()] for each in tried]
        self._gain = float(np.median([gain for _, gain in found]))
        self.shift_px = self._shift_near(parts, [int(offset) for offset, _ in found])
        self._move(0.0 if self.is_far else self.shift_px)
        if not self.is_far:
            self._each_counts = self._independence(largest, [int(offset) for offset, _ in found])
        each = [_log_mean(read.likelihood) - read.no_code(0.0) for read in map(self.read, largest)]
        more = float(_of_parts(np.array(each)).sum())
        self.is_plain = more > _PLAIN * sum(min(len(some), _MANY) for some in largest)
        self.trust = min(max(more, 0.0), _MOST_TRUST)
        if more > _SHOWN:
            return True
        if not self.is_far:  # nor is it known where it lies
            self._move(-self.shift_px)
            self.shift_px = 0.0
        return False if each[-1] < -_SHOWN else None

    def _largest(self) -> list[Integers]:
        """Return the blocks of the largest parts."""
        roots, counts = np.unique(self.blocks.root, return_counts=True)
        largest = self.blocks_of(roots[np.argsort(counts)[-_LARGEST:]])
        return [some for some in largest if len(self.offsets(some))]

    def _shift_near(self, parts: list[PartBlocks], offsets: list[int]) -> float:
        """Return by how many px the code lies further along the stripe, at most half a cell, by the largest parts."""
        if self.code.cell_px is None:
            return 0.0
        shifts, total = np.linspace(-0.5, 0.5, _SHIFTS) * self.code.cell_px, np.zeros(_SHIFTS)
        for part, offset in zip(parts, offsets, strict=True):
            total += self._fit(_thinned(part.values, _SOME), np.full(_SHIFTS, offset), shifts_px=shifts).likelihood
        return _peak(shifts, total)

    def _independence(self, parts: list[Integers], offsets: list[int]) -> float:
        """Return as how many each block counts: as fewer, the more alike those side by side deviate from the code.

        Paint and compression make them do so. It is taken from the largest parts, at these offsets.
        """
        if self.code.cell_px is None:
            return 1.0
        alike, alone = 0.0, FITTED**2
        for which, offset in zip(parts, offsets, strict=True):
            part, here, orders = self._part(which), np.array([offset]), self.blocks.order[which]
            terms = self._fit(_thinned(part.values, _SOME), here).terms
            departs = self._flat(part, here, terms, _AROUND, 1)[0] - self.expected(which, orders + offset)
            departs -= np.median(departs)
            most = _MOST_APART * robust_sigma(departs)
            departs = np.clip(departs, -most, most)
            column = part.cells[1]
            sort = np.lexsort((column, orders))
            beside = (np.diff(orders[sort]) == 0) & (np.diff(column[sort]) == 1)
            one, other = departs[sort[:-1][beside]], departs[sort[1:][beside]]
            alike += float(one @ other)
            alone += float(one @ one + other @ other) / 2
        return 1 / (1 + 2 * max(alike / alone, 0.0))

    @property
    def is_far(self) -> bool:
        """True if the code is too far off to be read there."""
        return self.code.cell_px is not None and abs(self.shift_px) > _MOST_SHIFT * self.code.cell_px

    def shift_anywhere(self) -> float | None:
        """Return the shift over half a repeat of the code either way, whatever the offsets; None: unknown.

        Elsewhere the response is unknown, too: a linear and the usual one are tried; and each block counts.
        """
        if self.code.cell_px is None:
            return None
        shifts, own = np.arange(-0.5, 0.5, 0.25 / WORD_CELLS) * self.code.repeats_px, self._gamma
        totals, counts, self._each_counts = np.zeros((2, len(shifts))), self._each_counts, 1.0
        for some in self._largest():
            few, offsets = _thinned(self._part(some).values, _SOME), self.offsets(some)
            # The likeliest offsets hardly depend on the response.
            each, further = np.repeat(offsets, len(shifts)), np.tile(shifts, len(offsets))
            likelihood = self._fit(_thinned(few, _FEWEST), each, shifts_px=further).likelihood
            named = offsets[np.argsort(likelihood.reshape(len(offsets), -1), axis=0)[-_NAMED:]]
            for total, self._gamma in zip(totals, (GAMMAS.index(1.0), GAMMAS.index(2.0)), strict=True):
                likelihood = self._fit(few, named.ravel(), shifts_px=np.tile(shifts, len(named))).likelihood
                by_shift = np.logaddexp.reduce(likelihood.reshape(named.shape), axis=0)
                even, other, *_ = self._fit_with_even(few, offsets[:0])
                total += _of_parts(by_shift - np.log(len(offsets)) - np.logaddexp(even, other))
            self._gamma = own
        total, self._each_counts = totals[totals.max(axis=1).argmax()], counts
        off = np.abs(shifts - shifts[total.argmax()])
        elsewhere = total[np.minimum(off, self.code.repeats_px - off) > self.code.cell_px].max()
        if total.max() - max(elsewhere, 0.0) <= _SURE_SHIFT:
            return None
        return self._moved_px + _peak(shifts, total)

    def _move(self, shift_px: float) -> None:
        """Read the code so many px further along the stripe, from now on."""
        self.columns[:, 0] += shift_px
        self._moved_px += shift_px
        for part in self._parts.values():
            part.values[Row.COLUMN] += shift_px / self.code.repeats_px
            part.evidence = None

    def again(self, other: "CodeReader") -> "CodeReader":
        """Return the reader of other blocks of the frame with what was learnt of it."""
        other._gamma, other._gain, other._each_counts = self._gamma, self._gain, self._each_counts
        other.trust, other.shift_px = self.trust, self.shift_px
        other._move(self.shift_px)
        other._parts = self._parts
        return other


def _of_neighbours(off: FloatArray) -> FloatArray:
    """Return which share of its neighbours' difference a cycle shows of which one side is seen."""
    return np.where(np.abs(off) > _OFF, _OF_NEIGHBOURS * off, 0.0)


def _step(values: npt.NDArray[np.float32], most: int) -> int:
    """Return of how many of a part's blocks (ROWS, n) one is taken so that there are at most so many."""
    columns: int = values.shape[1]
    return -(-columns // most)


def _thinned(values: npt.NDArray[np.float32], most: int) -> npt.NDArray[np.float32]:
    """Return at most so many of a part's blocks (ROWS, n), spread over it."""
    return values[:, :: _step(values, most)].copy()


def _peak(places: FloatArray, values: FloatArray) -> float:
    """Return where values are largest, by a parabola through the largest and its neighbours."""
    k = min(max(int(values.argmax()), 1), len(values) - 2)
    low, here, high = values[k - 1 : k + 2]
    bend = low - 2 * here + high
    step = 0.0 if bend >= 0 else min(max(0.5 * (low - high) / bend, -1.0), 1.0)
    return float(places[k] + step * (places[1] - places[0]))


def _log_sum(logarithms: FloatArray) -> float:
    top = float(logarithms.max())
    return top + float(np.log(np.exp(logarithms - top).sum()))


def _log_mean(logarithms: FloatArray) -> float:
    return _log_sum(logarithms) - float(np.log(len(logarithms)))


def _of_parts(more: FloatArray) -> FloatArray:
    """Return by how much likelier a frame shows the code from how much likelier its parts do: some parts do not."""
    return np.asarray(np.logaddexp(np.log(1 - _NO_CODE) + more, np.log(_NO_CODE)))
