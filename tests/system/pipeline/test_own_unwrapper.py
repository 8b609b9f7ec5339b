"""A user's own unwrapper replaces the built-in one."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from support.missing import import_but_fail_in_ci

from pipeline import Decoder, DecodeSettings
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import ShapeError

EXAMPLE = Path(__file__).resolve().parents[3] / "docs" / "examples" / "own_unwrapper.py"
SIZE, SETTINGS = (160, 120), SimulationSettings(scene="waves")


class Wrong:
    """An unwrapping with an answer of another size."""

    def unwrap(self, phase, quality):
        """Return too little."""
        return phase[1:], np.ones(phase[1:].shape, int)


def frame_of(rig, unwrapper, **known):
    calibration = rig.model_copy(update={"crosstalk_matrix": SETTINGS.crosstalk_matrix, **known})
    decoder = Decoder(DecodeSettings(stripes=rig.pattern.stripes), calibration, arch="cpu", unwrapper=unwrapper)
    return decoder.decode(simulate_frame(rig, SETTINGS).image)


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_scikit_image_plugs_in(cpu, stripes):
    import_but_fail_in_ci("skimage")
    rig = simulated_rig(SIZE, period_px=2 * 768 / 44, stripes=stripes)
    scikit_image = runpy.run_path(str(EXAMPLE))["ScikitImage"]()
    own, theirs = (frame_of(rig, unwrapper, depth_range_mm=(800, 1010)) for unwrapper in (None, scikit_image))
    truth = simulate_frame(rig, SETTINGS)
    both = own.mask & theirs.mask & truth.mask
    assert both.sum() > 0.95 * own.mask.sum()
    np.testing.assert_allclose(theirs.unwrapped_phase[both], own.unwrapped_phase[both], atol=1e-4)
    assert np.abs(theirs.unwrapped_phase - truth.phase)[both].max() < np.pi
    assert theirs.points is not None


def test_a_wrong_answer_is_one_line(cpu):
    with pytest.raises(ShapeError, match="the unwrapper's unwrapped phase has shape"):
        frame_of(simulated_rig(SIZE, period_px=2 * 768 / 44), Wrong())
