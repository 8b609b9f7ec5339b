"""What a rig's geometry leaves possible: the order of the rows, and how fine the fringe is."""

import numpy as np
import pytest

from pipeline import Decoder
from pipeline.decoding.expected_fringe import ExpectedFringe
from pipeline.errors import DecodeWarning
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig

SIZE = (320, 240)
PERIOD_PX = 2 * 768 / 44
CROSSTALK = np.array(TYPICAL_CROSSTALK)


def rig(**options):
    return simulated_rig(SIZE, **{"period_px": PERIOD_PX, **options})


def usual_change(truth, axis):
    change = np.diff(truth.phase, axis=axis)
    return float(np.median(change[np.isfinite(change)]))


def causes(calibration, image):
    """Return the keys of what a frame's decoder warns of, and the frame."""
    with pytest.warns(DecodeWarning) as said:
        frame = Decoder(calibration=calibration, arch="cpu").decode(np.ascontiguousarray(image))
    return {getattr(warning.message.args[0], "key", None) for warning in said}, frame


@pytest.mark.parametrize("scene", ["plane", "ball", "bust", "waves", "objects"])
@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_every_scene_is_usual_and_no_scene_turned_over_is_possible(cpu, scene, stripes):
    calibration = rig(stripes=stripes)
    truth = simulate_frame(calibration, SimulationSettings(scene=scene))
    expected = ExpectedFringe.of(calibration.geometry(), None)
    rate = usual_change(truth, 0 if stripes == "horizontal" else 1)
    px = 2 * np.pi / abs(rate)
    assert expected.contradiction(rate, px) is None and expected.surprise(rate, px) is None
    assert expected.is_reversed(-rate) and not expected.is_reversed(rate)
    for factor in (1 / 5, 5):
        assert expected.contradiction(factor * rate, px / factor).key == "impossible period"
        assert expected.contradiction(factor * rate, px) is None  # noise has bent it
    assert expected.contradiction(rate / 2, 2 * px) is None
    assert expected.surprise(rate / 2, 2 * px).key == "unusual period"


@pytest.mark.parametrize("part", [0.6, 1.0, 1.6])
@pytest.mark.parametrize("tilt_deg", [-40, 0, 40])
def test_a_plane_is_usual_over_the_whole_working_distance(part, tilt_deg):
    geometry = rig().geometry()
    y = np.array([119.0, 120.0])
    rays = geometry.camera.rays_through(np.column_stack([np.full(2, 159.5), y]))
    slope = np.tan(np.radians(tilt_deg))
    depth = part * 900 / (1 - slope * rays[:, 1])  # z = z0 + slope y
    points = np.column_stack([rays, np.ones(2)]) * depth[:, None]
    rate = float(2 * np.pi * np.diff(geometry.pattern_cycles(points))[0])
    assert ExpectedFringe.of(geometry, None).surprise(rate, 2 * np.pi / abs(rate)) is None


def test_a_depth_range_makes_it_narrower(cpu):
    """A wall that fills it, 900 mm away and 12 px per cycle, lies in the middle."""
    geometry = rig().geometry()
    wide, narrow = ExpectedFringe.of(geometry, None), ExpectedFringe.of(geometry, (800.0, 1000.0))
    assert wide.possible[0] < narrow.possible[0] < 2 * np.pi / 12 < narrow.possible[1] < wide.possible[1]
    assert narrow.possible[1] / narrow.possible[0] < 3


def test_nothing_is_expected_of_what_sees_nothing_in_common(cpu):
    away = rig()
    turned = away.model_copy(update={"rotation": np.diag([-1.0, 1.0, -1.0]) @ away.rotation})
    assert ExpectedFringe.of(turned.geometry(), (500.0, 1500.0)) is None
    parallel = away.model_copy(update={"rotation": np.eye(3)})
    assert ExpectedFringe.of(parallel.geometry(), None) is None


@pytest.mark.parametrize(
    ("spoilt", "cause"),
    [
        (lambda image: image[::-1, ::-1], "turned over"),
        (lambda image: image[::-1], "turned over"),
        (lambda image: image[..., ::-1], "colours swapped"),
    ],
)
@pytest.mark.parametrize("known", ["code", "crosstalk"])
def test_why_the_phase_runs_the_other_way_is_looked_for(cpu, known, spoilt, cause):
    """By a code, or by the crosstalk, the frame itself shows it; its depth would be wrong by hundreds of mm."""
    light = SimulationSettings(crosstalk_matrix=CROSSTALK, gamma=1.0)
    calibration = rig(code="contrast", period_px=PERIOD_PX / 2) if known == "code" else rig()
    image = simulate_frame(calibration, light).image
    if known == "crosstalk":
        calibration = calibration.model_copy(update={"crosstalk_matrix": CROSSTALK})
    found, frame = causes(calibration, spoilt(image))
    assert found == {cause}
    assert not frame.mask.any() and np.isnan(frame.points).all()
    assert Decoder(calibration=calibration, arch="cpu").decode(image).mask.mean() > 0.9


def test_another_pattern_than_the_calibrated_one_has_no_depth(cpu):
    found, frame = causes(rig(), simulate_frame(rig(period_px=6 * PERIOD_PX)).image)
    assert found == {"impossible period"}
    assert not frame.mask.any()


def test_a_pattern_or_a_field_of_view_of_twice_the_size_is_named(cpu):
    """Depth could be as measured only on a steep surface."""
    found, frame = causes(rig(), simulate_frame(rig(period_px=2 * PERIOD_PX)).image)
    assert found == {"unusual period"} and frame.mask.any()
    usual, region = rig(), np.array([[2.0, 1, 2], [1, 2, 2], [1, 1, 1]])
    zoomed = usual.camera.matrix * region - [[0, 0, SIZE[0] / 2], [0, 0, SIZE[1] / 2], [0, 0, 0]]
    camera = usual.camera.model_copy(update={"matrix": zoomed})
    seen = simulate_frame(usual.model_copy(update={"camera": camera}), SimulationSettings(scene="plane"))
    assert "unusual period" in causes(usual, seen.image)[0]
