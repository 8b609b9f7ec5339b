"""A rig that has drifted since its calibration: a still thing in two pictures tells by how much."""

import cv2
import numpy as np
import pytest

from pipeline.calibration.model import Calibration
from pipeline.decoder import Decoder
from pipeline.diagnosis.drift import measure_drift
from pipeline.errors import CalibrationError
from pipeline.settings import DecodeSettings
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

pytestmark = pytest.mark.usefixtures("cpu")

SIDE = np.s_[:, :80]


def drifted(rig: Calibration, turn_deg=(0.0, 0.0, 0.0), shift_px=0.0, scale=1.0) -> Calibration:
    """Return a rig whose projector has turned about its x, y and z, and whose lens has moved and grown."""
    geometry = rig.geometry()
    turn = cv2.Rodrigues(np.radians(turn_deg))[0]
    matrix = geometry.projector.matrix * [[scale, 1, 1], [1, scale, 1], [1, 1, 1]]
    matrix[geometry.phase_axis, 2] += shift_px
    lens = geometry.projector.model_copy(update={"matrix": matrix})
    places = {"rotation": turn @ geometry.rotation, "translation_mm": turn @ geometry.translation_mm}
    return rig.model_copy(update={**places, "projector": lens})


def photographed(rig: Calibration, scene: str, seed: int, **changes):
    """Return a picture of a scene, and its truth."""
    return simulate_frame(rig, SimulationSettings(scene=scene, gamma=1.0, seed=seed, **changes))


def decoded(rig: Calibration, image):
    """Return a picture decoded with what is known of the rig."""
    settings = DecodeSettings(
        crosstalk_matrix=SimulationSettings().crosstalk_matrix, stripes=rig.geometry().pattern.stripes
    )
    return Decoder(settings, rig, arch="cpu").decode(image)


def bias_mm(known: Calibration, rig: Calibration) -> float:
    """Return the mean error of a bust's depth before a rig, decoded with what is known of it."""
    truth = photographed(rig, "bust", 5)
    frame = decoded(known, truth.image)
    sure = frame.mask & truth.mask & frame.absolute
    assert frame.points is not None
    return float(np.median((frame.points - truth.points)[sure][:, 2]))


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
@pytest.mark.parametrize(
    ("changes", "was_mm"),
    [
        ({"shift_px": 0.3}, 0.5),
        ({"turn_deg": (0.05, 0.05, 0.05)}, 3.0),
        ({"turn_deg": (-0.03, 0.0, 0.05), "shift_px": 0.3, "scale": 1.0002}, 0.2),
    ],
)
def test_depths_are_right_again_after_a_drift(stripes, changes, was_mm):
    known = simulated_rig(code="contrast", stripes=stripes)
    rig = drifted(known, **changes)
    before, now = (decoded(known, photographed(each, "plane", seed).image) for seed, each in enumerate((known, rig)))
    found = measure_drift(before, now, known)
    assert abs(bias_mm(known, rig)) > was_mm
    assert abs(bias_mm(found.calibration, rig)) < 0.1
    assert found.depth_mm > was_mm
    assert found.left_mm < 0.1
    assert found.calibration.uncertainty.depth_bias_mm >= found.left_mm


def test_what_is_found_is_what_has_moved():
    known = simulated_rig(code="contrast")
    before = decoded(known, photographed(known, "plane", 0).image)
    now = decoded(known, photographed(drifted(known, (0.0, 0.0, 0.05), 0.3, 1.0003), "plane", 1).image)
    found = measure_drift(before, now, known)
    for (value, sigma), true in ((found.offset_px, 0.3), (found.roll_deg, 0.05), (found.scale, 1.0003)):
        assert value == pytest.approx(true, abs=max(4 * sigma, 0.02 * abs(true - round(true))))


def test_a_strip_at_the_side_tells_less_and_says_so():
    known = simulated_rig(code="contrast")
    rig = drifted(known, (0.04, 0.0, 0.03))
    frames = []
    for seed, each in enumerate((known, rig)):
        image = photographed(each, "plane", seed).image.copy()
        image[SIDE[0], 80:] = 0  # what has stood elsewhere does not matter
        frames.append(decoded(known, image))
    strip = measure_drift(*frames, known)
    whole = measure_drift(*(decoded(known, photographed(each, "plane", 7).image) for each in (known, rig)), known)
    assert strip.left_mm > 2 * whole.left_mm
    assert abs(bias_mm(strip.calibration, rig)) < max(0.15, 2 * strip.left_mm)


def test_what_has_moved_in_the_picture_does_not_count():
    """A bust comes 20 mm nearer before the wall, by which alone a drift of .3 px is told."""
    known = simulated_rig(code="contrast")
    before = decoded(known, photographed(known, "bust", 0).image)
    now = photographed(drifted(known, shift_px=0.3), "bust", 1, object_motion_mm=(0.0, 0.0, -20.0))
    found = measure_drift(before, decoded(known, now.image), known)
    assert found.offset_px[0] == pytest.approx(0.3, abs=0.02)


def test_what_no_drift_explains_is_refused():
    known = simulated_rig(code="contrast")
    before = decoded(known, photographed(known, "plane", 0).image)
    far = decoded(known, photographed(drifted(known, shift_px=9.0), "plane", 1).image)
    with pytest.raises(CalibrationError, match=r"^the pattern has moved by \+9\.\d px: calibrate geometry again$"):
        measure_drift(before, far, known)
    dark = photographed(known, "plane", 1).image.copy()
    dark[160:], dark[:, 40:] = 0, 0
    with pytest.raises(CalibrationError, match=r"^both pictures show too little in common"):
        measure_drift(before, decoded(known, dark), known)
