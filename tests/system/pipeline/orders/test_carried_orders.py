"""Orders that are carried from frame to frame."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings, DecodeWarning
from pipeline.decoding.frame import RegionOrders
from pipeline.errors import SettingsError
from pipeline.orders.carried_orders import CarriedOrders, choose_motion, count_votes, split_by_votes
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels.errors import ShapeError
from tikernels.order_evidence.order_votes import LACKING, REST, RESTS_A_CYCLE
from tikernels.unwrapping import PatchGraph

pytestmark = pytest.mark.usefixtures("cpu")

SIZE = (320, 240)


def votes_of(*rows: tuple[int, int, int, int, int], sound: int = 1) -> np.ndarray:
    """Rows of how many, patch, cycles, rest, region before."""
    return np.concatenate([np.tile(np.array([*row[1:], sound], np.int32), (row[0], 1)) for row in rows])


def test_the_majority_of_a_region_decides():
    roots = np.array([0, 0, 2], np.int32)
    votes = votes_of((40, 0, 2, 3, 1), (30, 1, 2, -3, 1), (20, 1, 5, 0, 2), (50, 2, 0, 1, 3))
    carried = count_votes(votes, roots)
    assert carried.same_scene
    np.testing.assert_array_equal(carried.roots, [0, 2])
    np.testing.assert_array_equal(carried.offsets, [2, 0])
    np.testing.assert_array_equal(carried.before, [1, 3])
    assert (carried.error_probability < 0.02).all()


def test_what_nothing_carries_follows_what_it_goes_on_with():
    """The third part goes on with the first, the fourth with the third, of which nothing is known by itself."""
    parts = np.array([0, 0, 2, 3, 4], np.int32)
    carried = count_votes(votes_of((40, 0, 2, 3, 1), (50, 3, -1, 1, 3)), parts)
    found = carried.with_neighbours(parts, np.array([3, 3, 0, 0, 2], np.int32))
    np.testing.assert_array_equal(found.roots, [0, 2, 3])
    np.testing.assert_array_equal(found.offsets, [2, 2, -1])
    np.testing.assert_array_equal(found.before, [1, 1, 3])
    assert found.error_probability[1] == 1
    np.testing.assert_array_equal(found.error_probability[[0, 2]], carried.error_probability)
    alone = np.arange(5, dtype=np.int32)
    np.testing.assert_array_equal(carried.with_neighbours(parts, alone).roots, carried.roots)


@pytest.mark.parametrize(
    "rows",
    [
        [(5, 0, 1, 0, 1)],  # too few
        [(30, 0, 1, 0, 1), (28, 0, 2, 0, 1)],  # no majority to speak of
        [(50, 0, 1, 29, 1)],  # 0.45 cycles away: the next order is nearly as near
        [(30, 0, 1, 0, 1), (25, 0, 1, 29, 1)],  # so it is for nearly half of the region
        [(10, 0, 1, rest, 1) for rest in range(-20, 21, 4)],  # it changes by anything: another surface
    ],
)
def test_a_doubtful_vote_carries_nothing(rows):
    carried = count_votes(votes_of(*rows), np.zeros(1, np.int32))
    assert len(carried.roots) == 0


def test_the_change_of_a_region_is_a_plane():
    """Votes whose phase has risen by 0.2 cycles, and by more to the right; and some that agree on nothing."""
    random = np.random.default_rng(4)
    places = random.integers(0, 200, (2, 600))
    expected = np.full(600, 0.125)
    change = 0.2 + 0.001 * (places[1] - 100)
    rest = np.rint(RESTS_A_CYCLE * (expected - change)).astype(np.int32)
    rest[400:] = random.integers(-20, 21, 200)
    votes = np.stack([np.repeat([0, 1], [400, 200]), np.full(600, 3), rest, np.ones(600), np.ones(600)], axis=1)
    votes = votes.astype(np.int32)
    roots = np.arange(2, dtype=np.int32)
    none = np.zeros(2, np.int64)
    carried = CarriedOrders(True, np.arange(2), none + 3, none, np.zeros(2), np.zeros((2, 3)))
    found = carried.with_change(votes, roots, expected, places).change
    np.testing.assert_allclose(found[0] / (2 * np.pi), [0.1, 0.001, 0], atol=2e-3)
    np.testing.assert_array_equal(found[1], 0)


@pytest.mark.parametrize(
    ("expected", "rest", "offset", "doubtful"),
    [
        (0.45, 0.02, 3, False),  # it goes on as it did
        (0.33, 0.30, 3, False),  # it stops
        (0.34, -0.34, 2, True),  # it turns round, or goes on twice as fast: turning is the smaller change
    ],
)
def test_what_moves_goes_on_or_stops(expected, rest, offset, doubtful):
    votes = votes_of((300, 0, 3, round(RESTS_A_CYCLE * rest), 1))
    carried = count_votes(votes, np.zeros(1, np.int32), np.full(300, expected))
    assert carried.offsets[0] == offset
    assert (carried.error_probability[0] > 0.1) == doubtful


def test_what_did_not_go_on_as_expected_is_taken_at_rest():
    """Two regions that were expected to rise by 0.3 cycles: one does, and the other falls by as much."""
    roots = np.arange(2, dtype=np.int32)
    expected = np.full(80, 0.3)
    rest = round(RESTS_A_CYCLE * 0.4)
    votes = np.concatenate([votes_of((40, 0, 3, 0, 1)), votes_of((40, 1, 4, -rest, 1))])
    chosen, taken_with = choose_motion(votes, roots, expected)
    np.testing.assert_array_equal(chosen[:40], votes[:40])
    np.testing.assert_array_equal(taken_with, np.repeat([0.3, 0.0], 40))
    assert (chosen[40:, LACKING] == 3).all() and np.ptp(chosen[40:, REST]) == 0
    assert chosen[40, REST] / RESTS_A_CYCLE == pytest.approx(0.3, abs=0.02)
    carried = count_votes(chosen, roots, taken_with, expected)
    np.testing.assert_array_equal(carried.offsets, [3, 3])
    assert carried.error_probability[0] < 0.01 < carried.error_probability[1] < 0.5


def test_a_frame_without_patches_has_no_votes():
    """As one that is too dark, after another that is not."""
    votes, roots, expected = np.zeros((0, 5), np.int32), np.zeros(0, np.int32), np.zeros(0)
    chosen, taken_with = choose_motion(votes, roots, expected)
    np.testing.assert_array_equal(taken_with, expected)
    assert not count_votes(chosen, roots, taken_with, expected).same_scene


def test_only_sound_votes_count_where_there_are_enough():
    """Beside a moving edge pixels vote for what was there before, however many of them there are."""
    votes = np.concatenate([votes_of((20, 0, 3, 0, 1)), votes_of((90, 0, 2, 0, 2), sound=0)])
    carried = count_votes(votes, np.zeros(1, np.int32))
    assert (carried.offsets[0], carried.before[0]) == (3, 1)
    assert carried.error_probability[0] < 0.05
    carried = count_votes(votes[20:], np.zeros(1, np.int32))
    assert carried.offsets[0] == 2
    assert carried.error_probability[0] > 0.1  # too much for an order to stay absolute


@pytest.mark.parametrize(("rest", "least", "most"), [(0, 0, 1e-6), (10, 1e-6, 1e-4), (21, 1e-3, 1e-2)])
def test_the_faster_a_surface_the_larger_the_doubt(rest, least, most):
    """Up to a third of a cycle a frame: the next order is then twice as far, and not much less likely."""
    carried = count_votes(votes_of((500, 0, 1, rest, 1)), np.zeros(1, np.int32))
    assert least <= carried.error_probability[0] <= most


def test_a_cut_is_noticed():
    rows = [(10, patch, int(k), 0, 1) for patch in range(4) for k in range(5)]
    assert not count_votes(votes_of(*rows), np.arange(4, dtype=np.int32)).same_scene
    assert not count_votes(np.zeros((0, 5), np.int32), np.zeros(1, np.int32)).same_scene


def test_surfaces_that_lay_apart_are_split(cpu):
    """Four patches in a row, joined to one region; the frame before saw the last two a cycle behind."""
    graph = PatchGraph(
        root=np.zeros(4, np.int32),
        offset=np.zeros(4, np.int32),
        pixels=np.full(4, 128, np.int32),
        first=np.arange(4, dtype=np.int32),
        ends=np.array([[0, 1, 2], [1, 2, 3]]),
        votes=np.array([16, 16, 16], np.int32),
    )
    split = votes_of(*((8, patch, patch // 2, 0, 1) for patch in range(4)))
    np.testing.assert_array_equal(split_by_votes(split, graph, np.zeros(3, bool)), [0, 0, 2, 2])
    coming_into_view = votes_of(*((8, patch, patch // 2, 0, 1) for patch in range(4)), sound=0)
    np.testing.assert_array_equal(split_by_votes(coming_into_view, graph, np.zeros(3, bool)), graph.root)
    alike = votes_of(*((8, patch, 0, 0, 1 + patch // 2) for patch in range(4)))
    np.testing.assert_array_equal(split_by_votes(alike, graph, np.zeros(3, bool)), graph.root)
    np.testing.assert_array_equal(split_by_votes(alike, graph, np.array([False, True, False])), [0, 0, 2, 2])
    whole = votes_of(*((8, patch, 0, 0, 1) for patch in range(4)))
    np.testing.assert_array_equal(split_by_votes(whole, graph, np.zeros(3, bool)), graph.root)


def moved(rig, scene: str, frame: int, **settings):
    """Return one frame of objects that swing and turn."""
    angle = 2 * np.pi * frame / 40
    return simulate_frame(
        rig,
        SimulationSettings(
            scene=scene,
            object_motion_mm=(30 * np.sin(angle), 5 * np.sin(2 * angle), -40 * np.sin(angle) ** 2),
            object_turn_deg=20 * np.sin(angle),
            seed=frame,
            **settings,
        ),
    )


@pytest.mark.parametrize("scene", ["ball", "objects"])
def test_moving_objects_keep_their_orders(arch, scene):
    rig = simulated_rig(SIZE, period_px=1.5 * 768 / 44)
    decoder = Decoder(DecodeSettings(), rig, arch=arch)
    frame = offset = surface = None
    for number in range(8):
        truth = moved(rig, scene, number, gamma=1.0)
        frame = decoder.decode(truth.image, previous=frame)
        seen = frame.mask & truth.mask
        now = np.where(seen, np.rint((frame.unwrapped_phase - truth.phase) / (2 * np.pi)), 0)
        if offset is not None:
            same = seen & surface[0] & (np.abs(truth.points[..., 2] - surface[1]) < 8)
            # What a region of 20 px could be is slivers along a step, where pixels see two surfaces.
            assert np.mean(now[same] != offset[same]) < 0.003
        offset, surface = now, (seen, truth.points[..., 2])
    assert not frame.absolute.any()  # nothing has told the absolute order


def test_what_gathers_speed_is_followed_at_two_thirds_of_a_cycle(arch):
    """A ball comes nearer, from rest on by a tenth of a cycle a frame more each time."""
    rig = simulated_rig(SIZE)
    near, far = (simulate_frame(rig, SimulationSettings(scene="ball", object_motion_mm=(0, 0, z))) for z in (-1, 0))
    moves = near.mask & far.mask & (np.abs(near.phase - far.phase) > 1e-3)
    mm_per_cycle = 2 * np.pi / np.median(np.abs(near.phase - far.phase)[moves])
    decoder, frame, place, offsets = Decoder(DecodeSettings(), rig, arch=arch), None, 60.0, []
    for number in range(11):
        place -= min(number / 10, 2 / 3) * mm_per_cycle
        truth = simulate_frame(rig, SimulationSettings(scene="ball", object_motion_mm=(0, 0, place), seed=number))
        frame = decoder.decode(truth.image, previous=frame)
        on_ball = frame.mask & truth.mask & (truth.points[..., 2] < near.points[near.mask, 2].max() - 50)
        off = np.rint((frame.unwrapped_phase - truth.phase)[on_ball] / (2 * np.pi))
        offsets.append(np.median(off))
        assert np.mean(off == offsets[0]) > 0.99


def test_absolute_orders_are_carried_where_the_code_is_not_seen(arch):
    """The second frame shows the plain pattern: without the first its orders would be relative."""
    coded = simulated_rig((640, 480), code="contrast")
    plain = simulated_rig((640, 480))
    first = Decoder(DecodeSettings(), coded, arch=arch).decode(moved(coded, "ball", 0).image)
    assert first.absolute[first.mask].mean() > 0.99
    truth = moved(plain, "ball", 1)
    decoder = Decoder(DecodeSettings(), plain, arch=arch)
    alone = decoder.decode(truth.image)
    assert not alone.absolute.any()
    assert (alone.order_error_probability[alone.mask] == 1).all()
    frame = decoder.decode(truth.image, previous=first)
    known = frame.absolute & truth.mask
    assert known.sum() > 0.95 * frame.mask.sum()
    # Slivers of the ball's rim join the wall over a step of a whole cycle, which the plain pattern does not show.
    assert np.mean(np.abs(frame.unwrapped_phase - truth.phase)[known] > np.pi) < 4e-3
    assert frame.order_error_probability[known].max() < 0.1


@pytest.mark.parametrize("scenes", ["objects bust", "bust plane", "plane objects", "waves ball", "ball waves"])
def test_a_cut_starts_afresh(scenes):
    """What the frame before saw is elsewhere: nothing that was known of it may be left."""
    rig = simulated_rig(SIZE, period_px=1.5 * 768 / 44)
    decoder = Decoder(DecodeSettings(), rig, arch="cpu")
    before, after = scenes.split()
    previous = decoder.decode(simulate_frame(rig, SimulationSettings(scene=before)).image)
    regions = len(previous.orders_known)
    sure = RegionOrders(np.ones(regions, bool), np.zeros(regions, np.float32), np.zeros((regions, 3), np.float32))
    previous = replace(previous, _measured=replace(previous._measured, orders=sure))
    image = simulate_frame(rig, SimulationSettings(scene=after, gamma=1.0)).image
    with pytest.warns(DecodeWarning, match="nothing of the frame before is seen again"):
        frame = decoder.decode(image, previous=previous)
    alone = decoder.decode(image)
    assert not alone.warnings
    assert [doubt.key for doubt in frame.warnings] == ["other scene"]
    assert frame.mask.any()
    assert not frame.absolute.any()
    assert (frame.order_error_probability[frame.mask] == 1).all()
    both = frame.mask & alone.mask
    assert np.abs(frame.unwrapped_phase - alone.unwrapped_phase)[both].max() < 1  # rad: the response is averaged


def test_another_period_before_is_a_cut():
    rigs = [simulated_rig(SIZE, period_px=factor * 768 / 44) for factor in (1.5, 2.0)]
    decoders = [Decoder(DecodeSettings(), rig, arch="cpu") for rig in rigs]
    images = [simulate_frame(rig, SimulationSettings(scene="ball")).image for rig in rigs]
    with pytest.warns(DecodeWarning, match="nothing of the frame before is seen again"):
        decoders[1].decode(images[1], previous=decoders[0].decode(images[0]))


def test_after_a_frame_without_fringes_orders_start_afresh():
    rig = simulated_rig(SIZE, period_px=1.5 * 768 / 44)
    decoder = Decoder(DecodeSettings(), rig, arch="cpu")
    image = simulate_frame(rig, SimulationSettings(scene="ball")).image
    with pytest.warns(DecodeWarning, match="no fringe"):
        dark = decoder.decode(np.full_like(image, 9))
    with pytest.warns(DecodeWarning, match="start afresh"):
        frame = decoder.decode(image, previous=dark)
    alone = decoder.decode(image)
    assert np.abs(frame.unwrapped_phase - alone.unwrapped_phase)[frame.mask & alone.mask].max() < 1  # rad


def test_previous_must_fit():
    rig = simulated_rig(SIZE)
    decoder = Decoder(DecodeSettings(), arch="cpu")
    before = decoder.decode(simulate_frame(rig).image)
    with pytest.raises(ShapeError, match="frame is 160x120 but the one before is 320x240"):
        decoder.decode(simulate_frame(simulated_rig((160, 120), period_px=768 / 22)).image, previous=before)
    upright = simulated_rig(SIZE, stripes="vertical")
    other = Decoder(DecodeSettings(stripes="vertical"), arch="cpu")
    with pytest.raises(SettingsError, match="stripes are vertical"):
        other.decode(simulate_frame(upright).image, previous=before)
    seen = other.decode(simulate_frame(upright).image)
    with pytest.raises(ShapeError, match="frame is 160x120 but the one before is 320x240"):
        small = simulated_rig((160, 120), period_px=768 / 22, stripes="vertical")
        other.decode(simulate_frame(small).image, previous=seen)


def test_the_frame_before_may_give_its_arrays():
    """`out=previous` comes to the same as fresh arrays, whatever the response has been averaged over."""
    rig = simulated_rig(SIZE, period_px=1.5 * 768 / 44)
    images = [moved(rig, "ball", number).image for number in range(4)]
    results = []
    for again in (False, True):
        decoder, frame = Decoder(DecodeSettings(), rig, arch="cpu"), None
        for image in images:
            frame = decoder.decode(image, previous=frame, out=frame if again else None)
        results.append(frame)
    np.testing.assert_array_equal(results[0].unwrapped_phase, results[1].unwrapped_phase)
    np.testing.assert_array_equal(results[0].region, results[1].region)
