"""Keep the orders of the frame before, region by region: an object keeps its depth while it moves."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray
from tikernels.order_evidence.order_votes import BEFORE, LACKING, PATCH, REST, RESTS_A_CYCLE, SOUND
from tikernels.order_evidence.part_joining import CANDIDATES, join_parts
from tikernels.unwrapping.patches import PatchGraph

# A region keeps its order if one offset has at least this many votes and this share of them: with fewer, most of it is
# newly seen.
_MIN_VOTES, _MIN_SHARE = 6, 0.6
# Beyond this change of phase from frame to frame, in cycles, the next order is nearly as close: such a vote is void.
_MAX_CHANGE = 0.35
# A surface's phase usually changes by this many cycles per frame, or by as many more than is expected; what is larger
# by as many again is e-fold rarer.
_USUAL_CHANGE = 0.06
# A continuing region moves coherently: changes, in fractions of a cycle, that are uniformly distributed have coherence
# 0, over a half cycle 0.64.
_MIN_COHERENCE = 0.5
# Where the votes' coherence is less on average, 0 where regions do not continue, the frame shows another scene: objects
# that turn by 3 degrees a frame reach 0.9, two scenes that happen to look alike in places 0.7.
_SAME_SCENE = 0.75
# A lead of this many votes halves the probability that the order is wrong: neighbouring pixels err together.
_HALVING_LEAD = 4.0
# How probably votes are for another surface that was there before, where only edges vote.
_EDGE_DOUBT = 0.5
# The change of a region's phase is a plane, whose slopes are known beforehand as by twenty votes 15 px from its middle
# that see none. If fewer votes than this, or a smaller share of them, lie within this of it (rad), none is expected.
_PLANE_PRIOR = np.diag([1e-6, 20 * 15.0**2, 20 * 15.0**2])
_MIN_MOVING, _MIN_ALIKE, _SAME_CHANGE = 100, 0.95, 0.6
# A region is split where the second most voted offset has this many votes. Each part must prefer its own offset by
# this many votes, and by this share of the part's votes.
_MIN_SPLIT_VOTES, _MIN_MARGIN, _MIN_MARGIN_SHARE = 12, 4.0, 0.4
#: An order that was absolute stays so where it is wrong with a smaller probability than this.
MAX_CARRIED_ERROR = 1e-2


@dataclass(frozen=True)
class CarriedOrders:
    """Whole cycles that regions lack to agree with the frame before."""

    same_scene: bool  # False: a cut, or too much motion to carry anything on
    roots: npt.NDArray[np.int64]  # (n,) of the regions whose orders are carried on
    offsets: npt.NDArray[np.int64]  # (n,) to be added to their orders
    before: npt.NDArray[np.int64]  # (n,) the region of the frame before that they come from
    error_probability: npt.NDArray[np.float64]  # (n,) that they do not continue from there with these orders
    change: FloatArray  # (n, 3) rad, change of their phase since, and its slopes, rad per px; see `vote_orders`

    def with_change(
        self,
        votes: npt.NDArray[np.int32],
        roots: npt.NDArray[np.int32],
        expected: FloatArray,
        places: npt.NDArray[np.int64],
    ) -> Self:
        """Measure by how much the phase of each region has changed since the frame before.

        Parameters
        ----------
        votes : (N, 5) int32
            `vote_orders`'s.
        roots : (P,) int32
            The patch that represents the region of each patch.
        expected : (N,) float
            The change that they were taken with, cycles.
        places : (2, N) int
            Their rows and columns.
        """
        number = np.full(len(roots), -1)
        number[self.roots] = np.arange(len(self.roots))
        region = number[roots[votes[:, PATCH]]]
        agrees = np.flatnonzero((region >= 0) & (votes[:, SOUND] == 1))
        agrees = agrees[votes[agrees, LACKING] == self.offsets[region[agrees]]]
        change = np.zeros((len(self.roots), 3))
        for k in np.flatnonzero(np.bincount(region[agrees]) >= _MIN_MOVING):
            voters = agrees[region[agrees] == k]
            here = np.stack([np.ones(len(voters)), places[1][voters], places[0][voters]])
            gained = 2 * np.pi * (expected[voters] - votes[voters, REST] / RESTS_A_CYCLE)
            near = np.abs(gained - _fitted_plane(here, gained) @ here) < _SAME_CHANGE
            if near.sum() >= max(_MIN_MOVING, _MIN_ALIKE * len(voters)):
                change[k] = _fitted_plane(here[:, near], gained[near])
        return replace(self, change=change)

    def with_neighbours(self, parts: npt.NDArray[np.int32], beside: npt.NDArray[np.int32]) -> Self:
        """Let parts that nothing carries keep their orders relative to the part that they continue most; unsure.

        A part may be newly seen, or have moved too far to vote.

        Parameters
        ----------
        parts : (P,) int32
            The patch that represents each patch's part.
        beside : (P,) int32
            See `Patches.beside`.
        """
        alone = np.setdiff1d(parts, self.roots)
        partner = parts[beside[alone]]
        carried = np.isin(partner, self.roots)
        alone, places = alone[carried], np.searchsorted(self.roots, partner[carried])
        order = np.argsort(np.concatenate([self.roots, alone]), kind="stable")
        return replace(
            self,
            roots=np.concatenate([self.roots, alone])[order],
            offsets=np.concatenate([self.offsets, self.offsets[places]])[order],
            before=np.concatenate([self.before, self.before[places]])[order],
            error_probability=np.concatenate([self.error_probability, np.ones(len(alone))])[order],
            change=np.concatenate([self.change, self.change[places]])[order],
        )


def _fitted_plane(here: FloatArray, values: FloatArray) -> FloatArray:
    """Return (3,): constant and slopes of the plane that fits values (n,) at places (3, n), the first 1, best."""
    return np.asarray(np.linalg.solve(here @ here.T + _PLANE_PRIOR, here @ values))


def choose_motion(
    votes: npt.NDArray[np.int32], roots: npt.NDArray[np.int32], expected: FloatArray
) -> tuple[npt.NDArray[np.int32], FloatArray]:
    """Let the votes of regions that have not continued as expected be those of regions that were at rest.

    Parameters
    ----------
    votes : (N, 5) int32
        `vote_orders`'s.
    roots : (P,) int32
        The patch that represents the region of each patch.
    expected : (N,) float
        The change that they were taken with, cycles.

    Returns
    -------
    votes : (N, 5) int32
        Of regions of which fewer votes are void if no change is expected, taken without.
    taken_with : (N,) float
        The change that each is taken with now, cycles.
    """
    root = roots[votes[:, PATCH]]
    lacking = votes[:, LACKING] + votes[:, REST] / RESTS_A_CYCLE - expected
    cycles = np.rint(lacking)
    rest = np.rint(RESTS_A_CYCLE * (lacking - cycles))
    void, void_at_rest = (
        np.bincount(root, np.abs(left) >= RESTS_A_CYCLE * _MAX_CHANGE, len(roots)) for left in (votes[:, REST], rest)
    )
    at_rest = (void_at_rest < void)[root]
    chosen = votes.copy(order="K")
    chosen[at_rest, LACKING], chosen[at_rest, REST] = cycles[at_rest], rest[at_rest]
    return chosen, np.where(at_rest, 0.0, expected)


def count_votes(
    votes: npt.NDArray[np.int32],
    roots: npt.NDArray[np.int32],
    taken_with: FloatArray | None = None,
    expected: FloatArray | None = None,
) -> CarriedOrders:
    """Count `vote_orders`'s votes: the sound ones, and the others of regions that have too few.

    Parameters
    ----------
    votes : (N, 5) int32
        Patch, cycles, rest, region before, soundness.
    roots : (P,) int32
        The patch that represents the region of each patch.
    taken_with, expected : (N,) float, optional
        The change that the votes are taken with, and the one that was expected, cycles; None: none.
    """
    taken_with = np.zeros(len(votes)) if taken_with is None else taken_with
    change = taken_with - votes[:, REST] / RESTS_A_CYCLE  # votes lack what the phase has gained
    surprise = change - (taken_with if expected is None else expected)
    root = roots[votes[:, PATCH]].astype(np.int64)
    sound = np.bincount(root, votes[:, SOUND], len(roots)) >= _MIN_VOTES
    counting = (votes[:, SOUND] == 1) | ~sound[root]
    clear = np.abs(votes[:, REST]) < RESTS_A_CYCLE * _MAX_CHANGE
    void = np.bincount(root[counting & ~clear], minlength=len(roots))
    coherence = _coherence(root[counting], votes[counting, REST], len(roots))
    everyone = int(counting.sum())
    counting &= clear
    votes, root, change, surprise = _rows(votes, counting), root[counting], change[counting], surprise[counting]
    if len(votes) == 0:
        none = np.zeros(0, np.int64)
        return CarriedOrders(False, none, none, none, none.astype(float), np.zeros((0, 3)))
    # A ballot is a region and an offset; those who cast it may come from several regions of the frame before.
    low, before_span = int(votes[:, LACKING].min()), int(votes[:, BEFORE].max()) + 1
    cycles_span = int(votes[:, LACKING].max()) - low + 1
    keys = (root * cycles_span + votes[:, LACKING] - low) * before_span + votes[:, BEFORE]
    origins, member, voters = np.unique(keys, return_inverse=True, return_counts=True)
    sums = [np.bincount(member, values) for values in (np.abs(surprise), surprise, change)]
    ballots, starts = np.unique(origins // before_span, return_index=True)
    counts, far, surprise, change = (np.add.reduceat(values, starts) for values in (voters, *sums))
    commonest = np.lexsort((-voters, origins // before_span))[starts]
    # The two ballots with the most votes of every region; ties go to the smaller offset.
    ranking = np.lexsort((ballots, -counts, ballots // cycles_span))
    regions, starts, several = np.unique(ballots[ranking] // cycles_span, return_index=True, return_counts=True)
    best, total = ranking[starts], np.add.reduceat(counts[ranking], starts) + void[regions]
    second = np.where(several > 1, counts[ranking[np.minimum(starts + 1, len(ranking) - 1)]], 0)
    lead = counts[best] - np.maximum(second, void[regions])
    far, surprise, change = (values[best] / counts[best] for values in (far, surprise, change))
    kept = (counts[best] >= _MIN_VOTES) & (counts[best] >= _MIN_SHARE * total) & (coherence[regions] >= _MIN_COHERENCE)
    if (coherence[regions] * total)[kept].sum() < _SAME_SCENE * everyone:
        return count_votes(votes[:0], roots)
    # A moving surface continues moving, or it stops: by either, one of the next orders may be the likelier one.
    likelihood = np.stack(
        [
            np.exp(-away / _USUAL_CHANGE) + np.exp(-np.abs(change + turn) / _USUAL_CHANGE)
            for turn, away in ((-1, np.abs(surprise - 1)), (0, far), (1, np.abs(surprise + 1)))
        ]
    )
    turn = likelihood.argmax(axis=0) - 1
    first, second = np.sort(likelihood, axis=0)[:0:-1]
    doubt = 0.5 ** (lead / _HALVING_LEAD) + second / first
    doubt = np.where(sound[regions], np.minimum(doubt, 1), _EDGE_DOUBT)
    best = best[kept]
    offsets = ballots[best] % cycles_span + low + turn[kept]
    before = origins[commonest[best]] % before_span
    return CarriedOrders(True, regions[kept], offsets, before, doubt[kept], np.zeros((len(offsets), 3)))


def _rows(votes: npt.NDArray[np.int32], chosen: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """Return some of the votes, column by column in memory as they are."""
    return votes.T.compress(chosen, axis=1).T


def _coherence(root: npt.NDArray[np.int64], rest: npt.NDArray[np.int32], count: int) -> npt.NDArray[np.float64]:
    """(count,) float: coherence of a region's phase changes, 1 where they are equal, 0 without votes."""
    least = int(rest.min(initial=0))
    turn = 2 * np.pi / RESTS_A_CYCLE * np.arange(least, int(rest.max(initial=0)) + 1)
    sums = [np.bincount(root, component[rest - least], count) for component in (np.cos(turn), np.sin(turn))]
    return np.asarray(np.hypot(*sums) / np.maximum(np.bincount(root, minlength=count), 1))


def split_by_votes(
    votes: npt.NDArray[np.int32], graph: PatchGraph, known_before: npt.NDArray[np.bool_]
) -> npt.NDArray[np.int32]:
    """Split regions that have joined surfaces which the frame before saw whole cycles apart.

    A step of whole cycles leaves no trace in one frame's phase; the frame before knows what lies on either side. Only
    sound votes count: what comes into view next to a moving edge votes for what was there before. A surface whose order
    was known and one whose was not stay apart, too: what looks like a joint between them may be such a step.

    Parameters
    ----------
    votes : (N, 5) int32
        `vote_orders`'s.
    graph : PatchGraph
        The frame's patches.
    known_before : (regions + 1,) bool
        True where the orders of the regions before were absolute.

    Returns
    -------
    (P,) int32
        The patch that represents the part of each patch.
    """
    votes = _rows(votes, votes[:, SOUND] == 1)
    if len(votes) == 0:
        return graph.root
    # The offsets in use, known ones and others, the commonest first: hardly any frame has more than a few.
    offsets, place, counts = np.unique(
        2 * votes[:, LACKING] + known_before[votes[:, BEFORE]], return_inverse=True, return_counts=True
    )
    rank = np.empty(len(offsets), np.int64)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(offsets))
    candidate = rank[place]
    used = candidate < CANDIDATES
    patch, candidate = votes[used, PATCH], candidate[used]
    regions = np.bincount(
        graph.root[patch].astype(np.int64) * CANDIDATES + candidate, minlength=len(graph.root) * CANDIDATES
    )
    second = np.partition(regions.reshape(-1, CANDIDATES), -2, axis=1)[:, -2]
    split = second >= _MIN_SPLIT_VOTES
    if not split.any():
        return graph.root
    # Fewer votes against an offset are better: a part's deviation from an offset is minus the number of its votes.
    evidence = np.zeros((len(graph.root), CANDIDATES + 1), np.float32)
    np.subtract.at(evidence, (patch, candidate), 1)
    evidence[:, CANDIDATES] = -evidence[:, :CANDIDATES].sum(axis=1)
    inside = split[graph.root[graph.ends[0]]]
    ends, weight = graph.ends[:, inside], graph.votes[inside]
    best = np.where(evidence[:, CANDIDATES] > 0, np.argmin(evidence[:, :CANDIDATES], axis=1), -1)
    # Contacts between patches that vote alike come first: then the parts are complete before they are tested for
    # joining.
    differ = (best[ends[0]] != best[ends[1]]) & (np.minimum(best[ends[0]], best[ends[1]]) >= 0)
    ranking = np.lexsort((np.arange(len(weight)), -weight, differ))
    everywhere = np.tile(np.array([0, 1], np.int32), (len(graph.root), 1))
    if len(ranking):
        pairs = np.ascontiguousarray(ends[:, ranking], np.int32)
        parents = join_parts(pairs, 0, _MIN_MARGIN, _MIN_MARGIN_SHARE, everywhere, evidence)
        return np.where(split[graph.root], parents, graph.root).astype(np.int32)
    return graph.root
