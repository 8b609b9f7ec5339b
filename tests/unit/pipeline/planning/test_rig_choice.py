"""What may be chosen, and the calibration that it makes."""

import numpy as np
import pytest

from pipeline.errors import SettingsError
from pipeline.models import build
from pipeline.planning import RigChoice
from pipeline.simulation import simulated_rig


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_its_rig_is_the_simulators_where_the_figures_are(stripes):
    """Lens of 1232 px, throw ratio of 1.75: the same matrices, to rounding."""
    # Focused on 900 mm, a lens has its picture 1 / (1 / f - 1 / 900) behind it.
    image_mm = 1232 * 4.8e-3
    choice = RigChoice(lens_mm=1 / (1 / image_mm + 1 / 900), stripes=stripes)
    mine, theirs = choice.calibration(17.0, None), simulated_rig(period_px=17.0, stripes=stripes)
    for one, other in ((mine.camera, theirs.camera), (mine.projector, theirs.projector)):
        np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-9)
    np.testing.assert_allclose(mine.rotation, theirs.rotation, atol=1e-12)
    np.testing.assert_allclose(mine.translation_mm, theirs.translation_mm, atol=1e-9)
    assert mine.pattern == theirs.pattern


def test_both_axes_meet_at_the_object():
    rig = RigChoice(distance_mm=1500.0, baseline_mm=400.0).calibration(17.0)
    assert rig.geometry().working_distance_mm() == pytest.approx(1500)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"baseline_mm": 900.0}, "as long as the distance of 900 mm or longer"),
        ({"lens_mm": 500.0}, "a lens of 500 mm cannot show an object 900 mm away"),
        ({"camera_px": (100_000, 100_000)}, "the camera's picture has 100000x100000 px"),
        ({"projector_px": (100_000, 100_000)}, "the projector's picture has 100000x100000 px"),
        ({"throw_ratio": 0.0}, "throw_ratio: must be a number from 0.1 to"),
        ({"distance_mm": float("nan")}, "distance_mm: must be a number"),
        ({"bits": 9}, "bits: must be 8, 10, 12 or 16, got 9"),
    ],
)
def test_what_no_rig_can_be_is_one_line(values, message):
    with pytest.raises(SettingsError, match=message) as refused:
        build(RigChoice, values, SettingsError, "the rig")
    assert "\n" not in str(refused.value)
