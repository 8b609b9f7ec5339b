"""Does a calibration still hold? Planes, balls and epipolar lines of rigs that stand as they did, and that do not."""

import cv2
import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Uncertainty
from pipeline.diagnosis.rig_check import check_surface
from pipeline.errors import CalibrationError
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig

# Frames of rigs that differ from what their settings say.
pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.filterwarnings("ignore:the colours' fringes differ")]

KNOWN = {
    "crosstalk_matrix": np.array(TYPICAL_CROSSTALK),
    "uncertainty": Uncertainty(depth_bias_mm=0.3, reprojection_px=(0.05, 0.08)),
}


def half_rig(**lenses):
    """Return a rig of half the usual picture; at twice the pattern's period its fringes are as fine."""
    return simulated_rig((320, 240), period_px=2 * 768 / 44, **lenses)


def checked(scene, shape, radius_mm=None, rig=None, **moved):
    """Check a capture of a rig with a calibration that says something else of it."""
    rig = (rig or half_rig()).model_copy(update=KNOWN)
    truth = simulate_frame(rig, SimulationSettings(scene=scene))
    calibration = rig.model_copy(update=moved)
    frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(truth.image)
    return check_surface(frame, calibration, shape, radius_mm)


def turned(degrees):
    return cv2.Rodrigues(np.radians(degrees))[0] @ half_rig().rotation


@pytest.mark.parametrize(
    ("rig", "radius_off_mm"),
    [(half_rig(), 0.2), (simulated_rig(), 0.1)],  # half as deep a cycle
    ids=["half", "whole"],
)
def test_a_rig_that_stands_as_it_did(rig, radius_off_mm):
    plane = checked("plane", "plane", rig=rig)
    assert plane.fine
    assert [measure.name for measure in plane.measures] == ["noise of a point", "flatness measurement error, trueness"]
    precision = plane.measures[0]
    assert 0.5 < precision.measured / precision.predicted < 1.5
    ball = checked("ball", "ball", 85.0, rig=rig)
    assert ball.fine
    assert abs(ball.radius_mm - 85) < radius_off_mm
    np.testing.assert_allclose(ball.position_mm, (0, 0, 880), atol=0.2)


@pytest.mark.parametrize(
    "moved",
    [
        {"rotation": turned([0.0, 0.4, 0.3])},
        {"projector": half_rig(projector_distortion=(0.08, 0, 0, 0, 0)).projector},
    ],
    ids=["turned", "lens"],
)
def test_a_plane_that_is_not_flat_any_more(moved):
    assert not checked("plane", "plane", **moved).fine


def test_a_ball_of_another_size():
    assert not checked("ball", "ball", 86.0).fine


def test_absolute_orders_are_not_moved_to_make_a_ball_fit():
    """A baseline that is said to be a fifth longer makes a ball of 85 mm one of 102, whatever other cycles would."""
    rig = simulated_rig(code="contrast")
    ball = checked("ball", "ball", 85.0, rig, translation_mm=1.2 * rig.translation_mm)
    assert not ball.fine and ball.radius_mm == pytest.approx(102, abs=1)


def test_what_a_plane_cannot_show():
    """A projector turned about the stripes leaves a plane flat: the verdict says so, and a ball's radius shows it."""
    plane = checked("plane", "plane", rotation=turned([0.3, 0.0, 0.0]))
    assert plane.fine and "stripes' direction" in plane.blind_spot
    assert not checked("ball", "ball", 85.0, rotation=turned([0.3, 0.0, 0.0])).fine
    assert "unknown radius" in checked("ball", "ball").blind_spot
    assert checked("ball", "ball", 85.0).blind_spot == ""


def test_another_shape():
    rig = half_rig().model_copy(update=KNOWN)
    frame = Decoder(DecodeSettings(), rig, arch="cpu").decode(simulate_frame(rig).image)
    frame.region[frame.mask] = 1  # bust and wall, as if they were one
    with pytest.raises(CalibrationError, match="mm from the nearest plane"):
        check_surface(frame, rig, "plane")
    with pytest.raises(CalibrationError, match="radius is given as 0 mm"):
        checked("ball", "ball", 0.0)


def test_nothing_to_check():
    rig = half_rig().model_copy(update=KNOWN)
    frame = Decoder(DecodeSettings(crosstalk_matrix=np.eye(3)), arch="cpu").decode(simulate_frame(rig).image)
    with pytest.raises(CalibrationError, match="without this calibration"):
        check_surface(frame, rig, "plane")
