"""What a rig's geometry leaves possible: the order of the rows, and how fine the fringe is."""

import re

import numpy as np
import pytest

from pipeline import Decoder
from pipeline.decoding.expected_fringe import ExpectedFringe
from pipeline.errors import DecodeWarning
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

SIZE = (320, 240)
PERIOD_PX = 2 * 768 / 44


def rig(**options):
    return simulated_rig(SIZE, period_px=PERIOD_PX, **options)


def usual_change(truth, axis):
    change = np.diff(truth.phase, axis=axis)
    return float(np.median(change[np.isfinite(change)]))


@pytest.mark.parametrize("scene", ["plane", "ball", "bust", "waves", "objects"])
@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_every_scene_is_possible_and_no_scene_turned_over_is(cpu, scene, stripes):
    calibration = rig(stripes=stripes)
    truth = simulate_frame(calibration, SimulationSettings(scene=scene))
    expected = ExpectedFringe.of(calibration.geometry(), None)
    rate = usual_change(truth, 0 if stripes == "horizontal" else 1)
    assert expected.contradiction(rate) is None
    assert "the phase runs against the calibrated rig's" in expected.contradiction(-rate)
    assert "the fringe has" in expected.contradiction(rate / 5)
    assert "the fringe has" in expected.contradiction(5 * rate)


def test_a_depth_range_makes_it_narrower(cpu):
    """A wall that fills it, 900 mm away and 12 px a cycle, lies in the middle."""
    geometry = rig().geometry()
    wide, narrow = ExpectedFringe.of(geometry, None), ExpectedFringe.of(geometry, (800.0, 1000.0))
    assert wide.least < narrow.least < 2 * np.pi / 12 < narrow.most < wide.most
    assert narrow.most / narrow.least < 3


def test_nothing_is_expected_of_what_sees_nothing_in_common(cpu):
    away = rig()
    turned = away.model_copy(update={"rotation": np.diag([-1.0, 1.0, -1.0]) @ away.rotation})
    assert ExpectedFringe.of(turned.geometry(), (500.0, 1500.0)) is None
    parallel = away.model_copy(update={"rotation": np.eye(3)})
    assert ExpectedFringe.of(parallel.geometry(), None) is None


@pytest.mark.parametrize(
    ("spoilt", "message"),
    [
        (lambda image: image[::-1, ::-1], "upside down or mirrored, or its colours are stored in the order B, G, R"),
        (lambda image: image[::-1], "the phase runs against"),
        (lambda image: image[..., ::-1], "the phase runs against"),
    ],
)
def test_a_picture_that_the_rig_cannot_have_taken_has_no_depth(cpu, spoilt, message):
    """Its depth would be wrong by hundreds of millimetres, and said to be certain."""
    calibration = rig()
    image = np.ascontiguousarray(spoilt(simulate_frame(calibration).image))
    decoder = Decoder(calibration=calibration, arch="cpu")
    with pytest.warns(DecodeWarning, match=re.escape(message)):
        frame = decoder.decode(image)
    assert not frame.mask.any()
    assert np.isnan(frame.points).all()
    whole = decoder.decode(simulate_frame(calibration).image)
    assert whole.mask.mean() > 0.9


def test_another_pattern_than_the_calibrated_one_has_no_depth(cpu):
    coarser = simulated_rig(SIZE, period_px=6 * PERIOD_PX)
    decoder = Decoder(calibration=rig(), arch="cpu")
    with pytest.warns(DecodeWarning, match=r"has [67]\d\.\d px a cycle, and the calibrated pattern of 34.91 projector"):
        frame = decoder.decode(simulate_frame(coarser).image)
    assert not frame.mask.any()
