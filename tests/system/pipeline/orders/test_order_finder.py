"""What is said later overrules what was said before, and what nothing tells stays open."""

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.decoding.frame import FrameMemory, RegionOrders
from pipeline.errors import CalibrationError
from pipeline.orders.carried_orders import CarriedOrders
from pipeline.orders.order_finder import OrderFinder, Placement, with_frame_before
from pipeline.orders.posterior import AbsoluteOrders, Posterior
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

REGIONS = SimpleNamespace(roots=np.array([4, 9, 2]))  # regions 1, 2 and 3


def memory(known, errors):
    orders = RegionOrders(
        np.array([False, *known]),
        np.array([np.nan, *errors], np.float32),
        np.zeros((1 + len(known), 3), np.float32),
    )
    return FrameMemory("horizontal", None, orders, None, None)


def patches(offsets):
    """Patches whose parts have been given these offsets."""
    return SimpleNamespace(orders=lambda parts: np.array([offsets[int(part)] for part in parts], np.int32))


def placement(**found):
    return Placement(
        **{"roots": None, "orders": None, "carried": None, "coded": False, "left_out": None, "warning": None, **found}
    )


def carried(**values):
    still = np.zeros((len(values["roots"]), 3))
    return CarriedOrders(same_scene=True, change=still, **{name: np.array(value) for name, value in values.items()})


def test_nothing_told_is_nothing_known():
    orders = placement().region_orders(patches({}), REGIONS, None)
    assert orders.known.tolist() == [False] * 4
    np.testing.assert_array_equal(orders.error_probability, [np.nan, 1, 1, 1])


def test_orders_that_are_carried_on_err_as_before_and_on_the_way():
    found = carried(roots=[2, 4], offsets=[1, 0], before=[2, 1], error_probability=[0.5, 0.001])
    before = memory([True, True], [0.002, 1e-6])
    told = placement(orders=with_frame_before(None, found, before.orders), carried=found)
    orders = told.region_orders(patches({2: 1, 4: 0}), REGIONS, before)
    # Region 1 (root 4) goes on from region 1 and region 3 (root 2) from region 2; region 2 is new.
    np.testing.assert_allclose(orders.error_probability[1:], [1 - 0.998 * 0.999, 1, 1 - (1 - 1e-6) * 0.5], rtol=1e-5)
    assert orders.known.tolist() == [False, True, False, False]


def test_what_was_not_known_before_is_not_known_now():
    found = carried(roots=[4], offsets=[0], before=[1], error_probability=[1e-9])
    for error in (0.02, 1.0):
        before = memory([False], [error])
        told = placement(orders=with_frame_before(None, found, before.orders), carried=found)
        orders = told.region_orders(patches({4: 0}), REGIONS, before)
        assert not orders.known.any()
        assert orders.error_probability[1] == pytest.approx(error)


def test_the_code_speaks_for_itself():
    sure, open_ = Posterior(7, np.array([1 - 1e-6, 1e-6])), Posterior(3, np.array([0.6, 0.4]))
    absolute = AbsoluteOrders(np.array([2, 4, 9]), (open_, sure, Posterior(0, np.zeros(0))))
    orders = placement(orders=absolute, coded=True).region_orders(patches({2: 3, 4: 7, 9: 0}), REGIONS, None)
    assert orders.known.tolist() == [False, True, False, False]
    np.testing.assert_allclose(orders.error_probability[1:], [1e-6, 1, 0.4], rtol=1e-5)
    # An offset that is not the likeliest is as wrong as the posterior says.
    orders = placement(orders=absolute, coded=True).region_orders(patches({2: 4, 4: 8, 9: 0}), REGIONS, None)
    np.testing.assert_allclose(orders.error_probability[1:], [1 - 1e-6, 1, 0.6], rtol=1e-5)
    assert not orders.known.any()


def test_the_frame_before_and_the_code_are_weighed():
    """Parts whose code is in doubt: between the carried order and another; against it; and not carried at all.

    The last one's code is sure of another order than the frame before.
    """
    doubt, other = Posterior(3, np.array([0.6, 0.4])), Posterior(3, np.array([0.02, 0.98]))
    sure = Posterior(3, np.array([1e-9, 1 - 1e-9]))
    absolute = AbsoluteOrders(np.array([2, 4, 6, 9]), (other, doubt, sure, doubt))
    found = carried(roots=[2, 4, 6], offsets=[3, 3, 3], before=[1, 1, 1], error_probability=[1e-4] * 3)
    before = memory([True], [1e-4])
    told = placement(orders=with_frame_before(absolute, found, before.orders), carried=found, coded=True)
    roots, offsets = told.offsets()
    assert dict(zip(roots.tolist(), offsets.tolist(), strict=True)) == {2: 3, 4: 3, 6: 4, 9: 3}
    regions = SimpleNamespace(roots=np.array([2, 4, 6, 9]))
    orders = told.region_orders(patches({2: 3, 4: 3, 6: 4, 9: 3}), regions, before)
    assert orders.known.tolist() == [False, False, True, True, False]
    # 0.98 against 0.02 for what is wrong once in a thousand; no surer than the frame before; 1e-9 against 1e-3; alone.
    np.testing.assert_allclose(orders.error_probability[1:], [0.0468, 1e-3, 1e-6, 0.4], rtol=0.01)


@pytest.mark.parametrize("coded", [True, False])
def test_the_later_evidence_overrules_the_earlier(coded):
    sure, doubt = Posterior(7, np.array([1 - 1e-6, 1e-6])), Posterior(3, np.array([0.6, 0.4]))
    absolute = AbsoluteOrders(np.array([2, 4, 6, 9]), (doubt, doubt, sure, Posterior(0, np.zeros(0))))
    before = carried(roots=[4, 6], offsets=[5, 1], before=[1, 1], error_probability=[1e-4, 1e-4])
    orders = with_frame_before(absolute, before, memory([True], [1e-6]).orders)
    roots, offsets = placement(orders=orders, carried=before, coded=coded).offsets()
    found = dict(zip(roots.tolist(), offsets.tolist(), strict=True))  # the last one stays, as in an assignment
    assert found == ({2: 3} if coded else {}) | {4: 5, 6: 7}
    assert [len(part) for part in placement().offsets()] == [0, 0]


def test_axes_in_parallel_need_a_range():
    rig = simulated_rig((64, 48))
    parallel = rig.model_copy(update={"rotation": np.eye(3), "translation_mm": np.array([0.0, 180.0, 0.0])})
    with pytest.raises(CalibrationError, match="give depth_range_mm"):
        OrderFinder(None, parallel.geometry(), None)
    OrderFinder(None, parallel.geometry(), (800.0, 1000.0))


@pytest.mark.parametrize("depth_range_mm, absolute", [((880.0, 920.0), True), ((300.0, 3000.0), False)])
def test_a_narrow_range_tells_the_order(cpu, depth_range_mm, absolute):
    rig = simulated_rig((128, 96), period_px=2 * 768 / 44)
    settings = SimulationSettings(scene="waves")
    image = simulate_frame(rig, settings).image
    known = {"crosstalk_matrix": settings.crosstalk_matrix, "depth_range_mm": depth_range_mm}
    frame = Decoder(DecodeSettings(), rig.model_copy(update=known), arch="cpu").decode(image)
    assert frame.absolute[frame.mask].all() == absolute
