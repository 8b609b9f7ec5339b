"""Boruvka's rounds against Kruskal's sequential way, on random graphs."""

import numpy as np
import pytest

from tikernels import runtime
from tikernels.unwrapping.region_merging import close_gaps_kernel, merge_patches_kernel, settle_patches_kernel
from tikernels.unwrapping.tables import GOLDEN, Contact, Counter, Match, Patch


def graph(seed: int, patches: int = 60, contacts: int = 200, wrong: float = 0.3):
    """Return ends, shifts, of which some contradict the true offsets, and votes, among which there are ties."""
    rng = np.random.default_rng(seed)
    offset = rng.integers(-9, 10, patches)
    ends = np.stack([rng.integers(0, patches, contacts), rng.integers(0, patches, contacts)])
    shift = offset[ends[1]] - offset[ends[0]] + rng.integers(-2, 3, contacts) * (rng.random(contacts) < wrong)
    return ends, shift, rng.integers(1, 40, contacts), offset


def merged(ends, shift, votes, patches, serial=True, gaps=True):
    """Return root and offset of every patch."""
    count = ends.shape[1]
    contacts = np.zeros((len(Contact), count), np.int32)
    contacts[Contact.FROM], contacts[Contact.TO] = ends
    contacts[Contact.SHIFT], contacts[Contact.VOTES] = shift, votes
    contacts[Contact.NAME] = (np.arange(count, dtype=np.int64) * GOLDEN).astype(np.int32)
    table = np.zeros((len(Patch), patches), np.int32)
    table[Patch.PARENT] = table[Patch.HEAD] = np.arange(patches)
    matches, counters = np.zeros((len(Match), 1024), np.int32), np.zeros(len(Counter), np.int32)
    buffers = [runtime.to_device(array) for array in (table, contacts, matches, counters)]
    for _ in range(20):
        merge_patches_kernel(serial, count, *buffers)
        if runtime.to_host(buffers[3])[Counter.MERGED] == 0:
            break
        if gaps:
            close_gaps_kernel(count, buffers[1], buffers[3])
            count = int(runtime.to_host(buffers[3])[Counter.CONTACTS])
    settle_patches_kernel(serial, patches, buffers[0])
    table = runtime.to_host(buffers[0])
    return table[Patch.ROOT], table[Patch.OFFSET]


def same_regions(found, expected) -> bool:
    """Whether two divisions of patches, with offsets in their regions, are the same up to a constant each."""
    (root, offset), (root2, offset2) = found, expected
    pairs = np.unique(np.stack([root, root2, offset - offset2]), axis=1)
    return pairs.shape[1] == len(np.unique(root)) == len(np.unique(root2))


def boruvka_with_sums(ends, shift, votes, patches):
    """Return root and offset: in each round contacts between the same regions that agree are one, votes summed."""
    root, offset = np.arange(patches), np.zeros(patches, np.int64)
    names = (np.arange(len(votes), dtype=np.int64) * GOLDEN).astype(np.int32)
    while True:
        claims: dict[tuple[int, int, int], list[int]] = {}
        for (a, b), turn, vote, name in zip(ends.T, shift, votes, names, strict=True):
            turned = turn + offset[a] - offset[b]
            low, high, turned = (root[a], root[b], turned) if root[a] < root[b] else (root[b], root[a], -turned)
            if low != high:
                claim = claims.setdefault((int(low), int(high), int(turned)), [0, 2**31])
                claim[0] += int(vote)
                claim[1] = min(claim[1], int(name))
        if not claims:
            return root, offset
        best: dict[int, tuple[int, int, tuple[int, int, int]]] = {}
        for key, (total, name) in claims.items():
            for region in key[:2]:
                best[region] = min(best.get(region, (0, 2**31, key)), (-total, name, key))
        parent = {}
        for region, (_, _, (a, b, turn)) in best.items():
            if best[a][2] == best[b][2] and region == a:
                continue  # of two that chose the same the smaller stays a root
            parent[region] = (a, turn) if region == b else (b, -turn)
        for patch in range(patches):
            while root[patch] in parent:
                upper, turn = parent[root[patch]]
                root[patch], offset[patch] = upper, offset[patch] + turn


@pytest.mark.parametrize("serial, gaps", [(True, True), (False, True), (False, False)])
@pytest.mark.parametrize("seed", range(4))
def test_sums_as_the_twin(arch, seed, serial, gaps):
    """Several contacts between the same regions that agree outvote a better one that does not."""
    ends, shift, votes, _ = graph(seed, patches=40, contacts=400)
    expected = boruvka_with_sums(ends, shift, votes, 40)
    assert same_regions(merged(ends, shift, votes, 40, serial, gaps), expected)


def test_true_claims_give_the_true_offsets(arch):
    ends, shift, votes, offset = graph(7, contacts=90, wrong=0.0)
    root, found = merged(ends, shift, votes, 60)
    for region in np.unique(root):
        assert np.ptp((found - offset)[root == region]) == 0


def test_two_that_agree_outvote_a_third(arch):
    ends, shift = np.array([[0, 0, 0], [1, 1, 1]]), np.array([5, 3, 3])
    root, offset = merged(ends, shift, np.array([10, 7, 6]), 2)
    assert root[0] == root[1] and offset[1] - offset[0] == 3
