"""What a depth range leaves possible of a region's orders."""

import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.orders.posterior import NOTHING_KNOWN, OrderRange, PartRange, Posterior
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

pytestmark = pytest.mark.usefixtures("cpu")


def test_an_error_far_below_rounding_is_kept():
    posterior = Posterior(-3, np.array([1e-30, 1.0, 0.0]))
    assert posterior.best == -2
    assert posterior.error(-2) == pytest.approx(1e-30)
    assert posterior.error(-3) == 1.0
    assert posterior.error(7) == posterior.error(-9) == 1.0
    assert NOTHING_KNOWN.error(0) == 1.0


def test_the_frame_before_is_no_independent_witness():
    """Where both agree they are as sure as the surer one; where they differ the odds are what decides."""
    unsure = Posterior(0, np.array([0.02, 0.95, 0.03]))
    assert unsure.after(1, 1e-3).error(1) == pytest.approx(1e-3)
    assert unsure.after(1, 0.2).error(1) == pytest.approx(0.05)
    against = unsure.after(2, 0.1)
    assert against.error(2) == pytest.approx(1 - 0.03 * 0.9 / (0.03 * 0.9 + 0.97 * 0.05), rel=1e-6)
    assert NOTHING_KNOWN.after(5, 0.3).best == 5 and NOTHING_KNOWN.after(5, 0.3).error(5) == pytest.approx(0.3)
    # What the pattern does not hold cannot have been.
    assert unsure.after(40, 1e-3) is unsure


@pytest.mark.parametrize(("width", "least", "most"), [(0.3, 0.0, 1e-3), (1.0, 1e-3, 0.1), (5.0, 0.5, 0.9)])
def test_a_range_of_more_cycles_leaves_more_open(width, least, most):
    posterior = PartRange(4 - width / 2, 4 + width / 2, 0.0, True).alone()
    assert posterior.best == 4
    assert least <= posterior.error(4) <= most
    assert posterior.probability.sum() == pytest.approx(1)


def test_a_surface_that_fits_nowhere_is_not_known():
    """Most of a relief of two cycles more than the range; or a part of it, that leaves the range by half a cycle."""
    assert PartRange(5.0, 3.0, 0.0, True).alone() is NOTHING_KNOWN
    assert PartRange(3.2, 3.1, 0.2, True).alone() is not NOTHING_KNOWN
    assert PartRange(2.8, 3.2, 0.5, True).alone() is NOTHING_KNOWN


def test_a_code_that_contradicts_the_range_is_not_believed():
    sure = Posterior(0, np.array([0.0, 0.0, 1.0]))
    assert PartRange(1.5, 2.5, 0.0, False).narrow(sure).error(2) < 1e-6
    assert PartRange(-9.0, 0.5, 0.0, False).narrow(sure) is NOTHING_KNOWN


def test_relief_narrows_and_a_few_pixels_do_not_matter():
    """Patches that lie deep and high leave fewer offsets together than each alone; one in 100 may lie anywhere."""
    height = np.linspace(0, 1.7, 100)  # cycles
    least, most = -height, 2 - height
    least[:1], most[:1] = 40, 42
    roots, pixels = np.zeros(100, np.int32), np.full(100, 128)
    (part,) = OrderRange(least, most, True).by_part(roots, np.array([0]), pixels)
    assert part.least == pytest.approx(0, abs=0.2)
    assert part.most == pytest.approx(0.3, abs=0.25)
    posterior = part.alone()
    assert part.holds and posterior.best == 0
    assert posterior.error(0) < 0.05
    least[:8], most[:8] = 40, 42  # nobody has said that such things are there
    (part,) = OrderRange(least, most, True).by_part(roots, np.array([0]), pixels)
    assert part.least == pytest.approx(0, abs=0.2)
    assert not part.holds


def decoded(scene, depth_range, **rig):
    """Return a plain frame decoded with a depth range, and its truth."""
    calibration = simulated_rig((320, 240), period_px=2 * 768 / 44, **rig)
    settings = SimulationSettings(scene=scene)
    truth = simulate_frame(calibration, settings)
    told = {"depth_range_mm": depth_range, "crosstalk_matrix": settings.crosstalk_matrix}
    return Decoder(DecodeSettings(), calibration.model_copy(update=told), arch="cpu").decode(truth.image), truth


def test_a_plain_pattern_is_absolute_where_one_order_fits():
    frame, truth = decoded("waves", (870.0, 920.0))
    right = np.abs(frame.unwrapped_phase - truth.phase)[frame.mask & truth.mask] < np.pi
    assert right.all()
    assert frame.absolute[frame.mask].all()
    assert frame.order_error_probability[frame.mask].max() < 1e-3


def test_a_wide_range_leaves_a_plain_pattern_open():
    frame, _ = decoded("waves", (600.0, 1200.0))
    assert not frame.absolute.any()
    assert 0.1 < frame.order_error_probability[frame.mask].min() < 1


@pytest.mark.parametrize(("scene", "depth_range"), [("plane", (730.0, 785.0)), ("objects", (960.0, 1020.0))])
def test_a_range_that_the_surface_leaves_tells_nothing(scene, depth_range):
    """A plane from 815 to 1004 mm; and a wall in the range that is given, with things before it."""
    with pytest.warns(DecodeWarning, match="fits at no order into the depth range of"):
        frame, _ = decoded(scene, depth_range)
    assert [doubt.key for doubt in frame.warnings] == ["out of range"]
    assert not frame.absolute.any()


def test_what_hangs_together_has_the_same_orders_unless_its_own_steps_contradict():
    undecided = Posterior(-2, np.full(10, 0.1))
    beside = undecided.beside(3, 0.9)
    assert beside.best == 3
    assert beside.error(3) == pytest.approx(0.1)
    contradicts = np.full(10, 1e-8)
    contradicts[0] = 1 - 9e-8
    assert Posterior(-2, contradicts).beside(3, 0.9).best == -2
    for nothing_to_say in (None, 40):
        assert undecided.beside(nothing_to_say, 0.9) is undecided
