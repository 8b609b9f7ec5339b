"""A user's own unwrapper: what it returns comes through, up to a constant a region, and is checked."""

import numpy as np
import pytest
import reference
from support.missing import import_but_fail_in_ci
from support.wrapped_surfaces import holes, join, orders, surface, written

import tikernels
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels.phase.wrapped_phase import NO_PHASE, STEP_PHASE
from tikernels.unwrapping.given_regions import GivenRegions


class ScikitImage:
    """scikit-image's unwrapper, plugged in: connected parts of the mask are regions."""

    def unwrap(self, phase, quality):
        """See `UserUnwrapper.unwrap`."""
        from skimage.measure import label
        from skimage.restoration import unwrap_phase

        mask = ~np.isnan(phase)
        # A NaN below the mask makes scikit-image hang.
        masked = np.ma.masked_array(np.nan_to_num(phase).astype(np.float64), ~mask)
        return np.ma.filled(unwrap_phase(masked, rng=0), np.nan), label(mask, connectivity=1)


class Told:
    """An unwrapper that says what it is told to."""

    def __init__(self, unwrapped, region):
        self.answer = unwrapped, region
        self.seen = []

    def unwrap(self, phase, quality):
        """Note what was asked."""
        self.seen.append((phase, quality))
        return self.answer


def marked(phase, mask):
    return np.where(mask, phase, np.float32(NO_PHASE)).astype(np.float32)


def differing(unwrapped, region, answer, regions) -> int:
    """Count the pixels whose order is not the answer's up to a constant a region, and check the regions."""
    pairs = np.unique(np.stack([region, regions])[:, region > 0], axis=1)
    assert pairs.shape[1] == len(np.unique(pairs[0])) == len(np.unique(pairs[1]))
    found = region > 0
    cycles = np.rint(np.where(found, unwrapped - np.nan_to_num(answer), 0) / (2 * np.pi)).astype(int)
    return int(reference.wrong_orders(cycles, region).sum())


@pytest.mark.parametrize("scene", ["plane", "waves"])
def test_scikit_image_on_a_simulated_surface(arch, scene):
    """Against the truth, with 0.1 rad of noise: every order inside a surface, nearly all of the picture."""
    import_but_fail_in_ci("skimage")
    frame = simulate_frame(simulated_rig((320, 240)), SimulationSettings(scene=scene))
    noise = 0.1 * np.random.default_rng(1).standard_normal(frame.phase.shape)
    phase = marked(reference.wrapped(np.where(frame.mask, frame.phase, 0) + noise), frame.mask)
    patches, rates = join(phase, given=GivenRegions(ScikitImage()))
    unwrapped, mask, region = written(patches, phase, rates)
    assert np.count_nonzero(mask) > 0.98 * np.count_nonzero(frame.mask)
    cycles = np.rint(np.where(mask, unwrapped - frame.phase, 0) / (2 * np.pi)).astype(int)
    assert reference.wrong_orders(cycles, region).sum() == 0


@pytest.mark.parametrize("shape", [(97, 131), (33, 50), (150, 9)])
@pytest.mark.parametrize("seed", [1, 2])
def test_what_is_told_comes_through(arch, shape, seed):
    """Regions with gaps between them, and a surface's orders with a constant in each: all but small regions."""
    rng = np.random.default_rng(seed)
    true = reference.ramp(*shape, 12.0, tilt=0.03)
    y, x = np.mgrid[: shape[0], : shape[1]]
    mask = holes(shape, rng) & (y % 40 != 0) & (x % 37 != 0)
    phase = reference.wrapped(true)
    regions = 7 * (1 + y // 40 + 5 * (x // 37)) * mask  # numbers with gaps, too
    answer = np.where(mask, true + 2 * np.pi * 11 * regions, np.nan)
    told = Told(answer, regions)
    patches, rates = join(marked(phase, mask), given=GivenRegions(told))
    unwrapped, _, region = written(patches, marked(phase, mask), rates)
    np.testing.assert_array_equal(np.isnan(told.seen[0][0]), ~mask)
    assert len(told.seen) == 1
    large = mask & (np.bincount(regions.ravel())[regions] >= 128)
    np.testing.assert_array_equal(region > 0, large)
    assert differing(unwrapped, region, answer, regions) == 0
    assert orders(unwrapped, phase).size


def test_pixels_that_do_not_touch_stay_one_region(arch):
    """Two halves of a plane with a gap between them, told to be one region seven cycles apart."""
    true = reference.ramp(64, 96)
    true[:, 50:] += 7 * 2 * np.pi
    mask = np.ones(true.shape, bool)
    mask[:, 44:50] = False
    phase = reference.wrapped(true)
    patches, rates = join(marked(phase, mask), given=GivenRegions(Told(true, mask.astype(np.int64))))
    unwrapped, _, region = written(patches, marked(phase, mask), rates)
    np.testing.assert_array_equal(region, mask.astype(int))
    assert np.ptp((unwrapped - true)[mask]) < 1e-3  # rad, float32 of 80
    graph = patches.graph()
    apart = np.abs(np.diff(graph.first[graph.ends] % 96, axis=0)) > 8
    assert apart.sum() == 1 and graph.votes[apart[0]] == 1


def test_orders_that_spread_beyond_a_label(arch):
    """Orders that rise by nine cycles a pixel fill several patches a cell, which are joined again."""
    order = 9 * np.arange(48)[:, None] + np.zeros((1, 40), int)
    phase = np.random.default_rng(4).uniform(-3, 3, order.shape).astype(np.float32)
    answer = phase + 2 * np.pi * order
    patches, _ = join(phase, given=GivenRegions(Told(answer, np.ones(order.shape, int))))
    graph = patches.graph()
    assert patches.count > 2 * patches.cells and len(np.unique(graph.root)) == 1
    y, x = np.divmod(graph.first, 40)
    whole = np.array(patches.labels if isinstance(patches.labels, np.ndarray) else patches.labels.to_numpy())
    own = (whole & 63) - 32
    found = own[y, x] + graph.offset
    assert np.ptp(found - order[y, x]) == 0


def test_votes_are_pixel_pairs(arch):
    """Two whole cells side by side touch in sixteen pairs, two above each other in eight."""
    true = reference.ramp(32, 16)
    patches, _ = join(reference.wrapped(true), given=GivenRegions(Told(true, np.ones(true.shape, int))))
    graph = patches.graph()
    found = {(int(a), int(b)): int(votes) for (a, b), votes in zip(graph.ends.T, graph.votes, strict=True)}
    assert found == {(0, 1): 16, (2, 3): 16, (0, 2): 8, (1, 3): 8}


def test_pixels_between_surfaces_stay_out(arch):
    """They are shown as missing, and what is told of them, or of the masked, does not count."""
    true = surface(64, 80)
    phase = reference.wrapped(true)
    phase[20, 30], phase[40, 50] = STEP_PHASE, NO_PHASE
    told = Told(true, np.ones(true.shape, int))
    patches, rates = join(phase, given=GivenRegions(told))
    assert np.isnan(told.seen[0][0][[20, 40], [30, 50]]).all()
    _, _, region = written(patches, phase, rates)
    assert region[20, 30] == region[40, 50] == 0
    assert region[19, 30] == 0 and region[39, 50] == 1  # beside a step its neighbours are left out


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda u, r: (u[1:], r), r"unwrapped phase has shape \(31, 24\), expected \(32, 24\)"),
        (lambda u, r: (u, r[None]), r"region has shape \(1, 32, 24\), expected"),
        (lambda u, r: (u, r.astype(float)), "region is float64, expected integers"),
        (lambda u, r: (u, r - 2), "region holds -1, expected numbers from 0"),
        (lambda u, r: (u * np.where(np.arange(24) == 3, np.nan, 1), r), "NaN or beyond 131072 cycles at 32 pixels"),
        (lambda u, r: (u + 1e9, r), "NaN or beyond 131072 cycles at 768 pixels"),
        (lambda u, r: u, "returned a ndarray: return the unwrapped phase and the region"),
        (lambda u, r: None, "returned a NoneType"),
    ],
)
def test_a_wrong_answer_is_refused(arch, change, message):
    phase = np.zeros((32, 24), np.float32)

    class Wrong:
        def unwrap(self, phase, quality):
            return change(phase.astype(np.float64), np.ones(phase.shape, int))

    with pytest.raises(tikernels.ShapeError, match=message) as error:
        join(phase, given=GivenRegions(Wrong()))
    assert "\n" not in str(error.value)


def test_nothing_valid(arch):
    phase = np.full((32, 24), NO_PHASE, np.float32)
    patches, rates = join(phase, given=GivenRegions(Told(np.full((32, 24), np.nan), np.ones((32, 24), int))))
    assert patches.count == 0 and np.isnan(written(patches, phase, rates)[0]).all()
