"""Take the regions of somebody else's unwrapper, which only returns an unwrapped phase and where it is connected.

Its orders, round((unwrapped - phase) / 2 pi), are cut into patches cell by cell: one for each of its regions in a cell,
or several where their orders spread over more than a label's bits hold. Neighbouring patches of one region have a
contact, with the number of pixel pairs as its votes; between regions there is none. The pixels of one region that do
not touch get a contact, too, so that they stay one region. All of it is the host's work.
"""

from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels.arrays import F32
from tikernels.errors import ShapeError
from tikernels.phase.wrapped_phase import LEAST_NO_PHASE, LEAST_STEP_PHASE
from tikernels.unwrapping.drafts import Drafts
from tikernels.unwrapping.tables import (
    BETWEEN,
    CELL_HEIGHT,
    CELL_WIDTH,
    CONTACT_BITS,
    GOLDEN,
    NOTHING,
    ORDER_BITS,
    ORDER_ZERO,
    Cell,
    Contact,
    Patch,
    cells_of,
)

Integers = npt.NDArray[np.int64]

# Beyond this order float32 no longer holds a phase to 0.1 rad.
_MAX_ORDER = 2**17
# Spans of 64 orders in a cell, of either sign, have numbers of this many bits.
_SPAN_BITS = 16


class UserUnwrapper(Protocol):
    """Interface of a user's own unwrapper.

    Examples
    --------
    >>> class ByRows:
    ...     def unwrap(self, phase, quality):
    ...         return np.unwrap(phase, axis=0), np.isfinite(phase).astype(int)
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(arch="cpu", unwrapper=ByRows()).decode(sheet.image)
    >>> f"{np.ptp(frame.unwrapped_phase[20:100, 80]) / (2 * np.pi):.1f} cycles in 80 px"
    '6.6 cycles in 80 px'
    """

    def unwrap(
        self, phase: npt.NDArray[np.float32], quality: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.floating], npt.NDArray[np.integer]]:
        """Unwrap one frame.

        Parameters
        ----------
        phase : (H, W) float32
            rad in [-pi, pi], stripes along the rows; NaN outside the mask.
        quality : (H, W) float32
            Larger is better; the modulation.

        Returns
        -------
        unwrapped : (H, W) float
            rad; the phase plus whole cycles, to half a cycle. Each region's constant is free.
        region : (H, W) int
            A number above 0 for the pixels whose orders belong together; 0: none. What it says outside the mask does
            not count.
        """


class _Patches(NamedTuple):
    """A frame's patches, in the order of their cells."""

    of_pixel: Integers  # (H, W) number; -1: none
    cell: Integers  # (P,)
    zero: Integers  # (P,) the order that its orders count from
    first: Integers  # (P,) its first pixel
    pixels: Integers  # (P,)


class _Contacts(NamedTuple):
    """Contacts in the order of their cells, each in that of the patch where it begins."""

    ends: Integers  # (2, C) patches
    votes: Integers  # (C,)
    name: Integers  # (C,) unique


class GivenRegions:
    """Patches from a user's unwrapper.

    As everywhere, regions of fewer than 128 px, pixels next to steps and cells whose borders contradict their
    neighbours' are left out of what is written, and the user's constant of each region is not kept. So regions should
    end where the surface does: where the phase goes on from one into another, the cells between them are left out.

    Parameters
    ----------
    unwrapper : UserUnwrapper
        An object with a method `unwrap(phase, quality) -> (unwrapped, region)`.

    Raises
    ------
    ShapeError
        When a frame is unwrapped: its answer has another shape, holds NaN inside a region, or regions that are no
        integers from 0.
    """

    def __init__(self, unwrapper: UserUnwrapper) -> None:
        self._unwrapper = unwrapper

    def grow(self, phase: F32, quality: F32, drafts: Drafts) -> None:
        """Call the user's unwrapper, and cut its regions into patches.

        Parameters
        ----------
        phase : (H, W) float32
            rad in [-pi, pi]; NO_PHASE outside the mask, STEP_PHASE between two surfaces.
        quality : (H, W) float32
            Larger is better; the modulation.
        drafts : Drafts
            Buffers of patches and contacts.
        """
        marked, seen = runtime.to_host(phase), runtime.to_host(quality)  # synchronises
        valid = marked < LEAST_NO_PHASE
        answer = self._unwrapper.unwrap(np.where(valid, marked, np.float32(np.nan)), seen.copy())
        order, region = _checked(answer, marked, valid)
        patches = _cut(order, region)
        contacts = _touching(region, patches)
        _make_room(drafts, patches, contacts)
        between = np.where(marked > LEAST_STEP_PHASE, BETWEEN, NOTHING)
        _write(drafts, order, patches, contacts, between)


def _checked(
    answer: Any, phase: npt.NDArray[np.float32], valid: npt.NDArray[np.bool_]
) -> tuple[Integers, npt.NDArray[np.integer]]:
    """Return the order and the region of every pixel, 0 where there is none."""
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise ShapeError(f"the unwrapper returned a {type(answer).__name__}: return the unwrapped phase and the region")
    unwrapped, region = (np.ma.filled(array, 0) for array in answer)
    for name, array in (("unwrapped phase", unwrapped), ("region", region)):
        if array.shape != phase.shape:
            raise ShapeError(f"the unwrapper's {name} has shape {array.shape}, expected {phase.shape}")
    if not np.issubdtype(region.dtype, np.integer):
        raise ShapeError(f"the unwrapper's region is {region.dtype}, expected integers: 0 for none, then from 1")
    if region.min() < 0:
        raise ShapeError(f"the unwrapper's region holds {region.min()}, expected numbers from 0, for none")
    region = np.where(valid, region, 0)
    inside = region > 0
    cycles = (np.where(inside, unwrapped, 0) - np.where(inside, phase, 0)) / (2 * np.pi)
    bad = np.count_nonzero(~(np.abs(cycles) < _MAX_ORDER))
    if bad:
        raise ShapeError(
            f"the unwrapper's phase is NaN or beyond {_MAX_ORDER} cycles at {bad} pixels of its regions: set their "
            "region to 0"
        )
    return np.rint(cycles).astype(np.int64), region


def _cut(order: Integers, region: npt.NDArray[np.integer]) -> _Patches:
    """Make a patch of the pixels of one region in one cell, unless their orders spread too far for a label."""
    y, x = np.nonzero(region)
    cell, own = (y // CELL_HEIGHT) * cells_of(*order.shape)[1] + x // CELL_WIDTH, order[y, x]
    regions, rank = np.unique(region[y, x], return_inverse=True)
    _, first, group = np.unique(cell * max(len(regions), 1) + rank, return_index=True, return_inverse=True)
    # Orders count from that of the region's first pixel in the cell; what lies beyond a label's bits
    # makes another patch.
    zero = own[first][group]
    span = (own - zero + ORDER_ZERO) >> ORDER_BITS
    key = (group << _SPAN_BITS) + span + (1 << (_SPAN_BITS - 1))
    _, first, patch, pixels = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    of_pixel = np.full(order.shape, -1, np.int64)
    of_pixel[y, x] = patch
    return _Patches(
        of_pixel, cell[first], (zero + (span << ORDER_BITS))[first], y[first] * order.shape[1] + x[first], pixels
    )


def _touching(region: npt.NDArray[np.integer], patches: _Patches) -> _Contacts:
    """Return the contacts between patches of one region: where pixels touch, and where a region's pieces do not."""
    height, width = region.shape
    number = np.arange(region.size).reshape(region.shape)
    pairs, names = [], []
    for side in range(2):
        here, there = np.s_[: height - side, : width - 1 + side], np.s_[side:, 1 - side :]
        a, b = patches.of_pixel[here], patches.of_pixel[there]
        touch = (a != b) & (region[here] == region[there]) & (region[here] > 0)
        pairs.append(np.stack([np.minimum(a, b)[touch], np.maximum(a, b)[touch]]))
        names.append(3 * number[here][touch] + 1 + side)
    low, high = np.concatenate(pairs, axis=1)
    _, first, votes = np.unique(low * len(patches.cell) + high, return_index=True, return_counts=True)
    ends, name = np.stack([low, high])[:, first], np.concatenate(names)[first]
    # The pieces of a region that do not touch are joined one to the next, by their first patches.
    heads = np.unique(_connected(len(patches.cell), ends))
    owner = region.ravel()[patches.first[heads]]
    sort = np.argsort(owner, kind="stable")
    heads, owner = heads[sort], owner[sort]
    apart = np.flatnonzero(owner[1:] == owner[:-1])
    links = np.stack([heads[apart], heads[apart + 1]])
    ends = np.concatenate([ends, links], axis=1)
    votes = np.concatenate([votes, np.ones(len(apart), np.int64)])
    name = np.concatenate([name, 3 * patches.first[links[0]]])
    sort = np.argsort(patches.cell[ends[0]], kind="stable")
    return _Contacts(ends[:, sort], votes[sort], name[sort])


def _connected(count: int, pairs: Integers) -> Integers:
    """Return the smallest patch that each patch is connected with."""
    smallest = np.arange(count)
    while True:
        a, b = smallest[pairs]
        if (a == b).all():
            return smallest
        np.minimum.at(smallest, np.maximum(a, b), np.minimum(a, b))
        while (smallest[smallest] != smallest).any():
            smallest = smallest[smallest]


def _make_room(drafts: Drafts, patches: _Patches, contacts: _Contacts) -> None:
    crowded = int(np.bincount(patches.cell, minlength=1).max())
    contact_count = int(np.bincount(patches.cell[contacts.ends[0]], minlength=1).max())
    crowded = max(crowded, -(-contact_count >> CONTACT_BITS))
    if crowded > 1 << drafts.bits:
        drafts.make_room((crowded - 1).bit_length())


def _write(
    drafts: Drafts,
    order: Integers,
    patches: _Patches,
    contacts: _Contacts,
    between: npt.NDArray[np.integer],
) -> None:
    """Write patches and contacts to the places of their cells."""

    def places(cell: Integers, bits: int) -> tuple[Integers, npt.NDArray[np.int32]]:
        count = np.bincount(cell, minlength=drafts.cells)
        within = np.arange(len(cell)) - (np.cumsum(count) - count)[cell]
        return (cell << bits) + within, count.astype(np.int32)

    draft, patch_count = places(patches.cell, drafts.bits)
    place, contact_count = places(patches.cell[contacts.ends[0]], drafts.bits + CONTACT_BITS)
    inside = patches.of_pixel >= 0
    own = patches.of_pixel[inside]
    labels = between.astype(np.int32)
    labels[inside] = (draft[own] << ORDER_BITS) + ORDER_ZERO + order[inside] - patches.zero[own]
    table = np.zeros(drafts.patches.shape, np.int32)
    table[Patch.PIXELS, draft] = patches.pixels
    table[Patch.FIRST, draft] = patches.first
    noted = np.zeros(drafts.contacts.shape, np.int32)
    start, end = contacts.ends
    noted[Contact.FROM, place], noted[Contact.TO, place] = draft[start], draft[end]
    # OFFSET[end] = OFFSET[start] + shift, for orders that count from each patch's own zero.
    noted[Contact.SHIFT, place] = patches.zero[end] - patches.zero[start]
    noted[Contact.VOTES, place] = contacts.votes
    noted[Contact.NAME, place] = (contacts.name * GOLDEN).astype(np.int32)
    cells = np.zeros(drafts.cell_table.shape, np.int32)
    cells[Cell.PATCHES, :-1], cells[Cell.CONTACTS, :-1] = patch_count, contact_count
    np.bitwise_or.at(cells[Cell.STEPS], _cells_of_pixels(between == BETWEEN), 1)
    for buffer, host in (
        (drafts.labels, labels),
        (drafts.patches, table),
        (drafts.contacts, noted),
        (drafts.cell_table, cells),
    ):
        runtime.write(host, buffer)


def _cells_of_pixels(marked: npt.NDArray[np.bool_]) -> Integers:
    """Return the cell of every marked pixel."""
    y, x = np.nonzero(marked)
    return (y // CELL_HEIGHT) * cells_of(*marked.shape)[1] + x // CELL_WIDTH
