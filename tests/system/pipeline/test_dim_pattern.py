"""A pattern with less light: the same light up to a factor, and the same phase."""

import numpy as np
import pytest
import reference

from pipeline import Decoder, DecodeSettings
from pipeline.pattern import make_pattern
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

pytestmark = pytest.mark.usefixtures("cpu")

BRIGHTNESS = 0.85
CODES = np.linspace(0, 1, 256)
RESPONSE = np.stack([CODES**gamma for gamma in (1.8, 2.0, 2.4)])


@pytest.mark.parametrize("code", [None, "contrast"])
def test_it_decodes_to_the_same_phase(arch, code):
    """Of a rig whose two pictures take turns; with a projector of gamma 2 the dim one has 0.72 of the light."""
    size = (480, 360)
    rig = simulated_rig(size, period_px=640 / size[0] * 768 / 44, code=code)
    settings = SimulationSettings(scene="ball", exposure=0.7)
    calibration = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})
    decoder = Decoder(DecodeSettings(), calibration, arch=arch)
    found = {}
    for brightness in (1.0, BRIGHTNESS):
        codes = make_pattern((1024, 768), rig.geometry().pattern, brightness=brightness)
        truth = simulate_frame(rig, settings.model_copy(update={"seed": round(100 * brightness)}), codes)
        frame = decoder.decode(truth.image)
        lit = reference.eroded(truth.mask, 4) & (truth.image.mean(axis=2) > 20)
        assert frame.mask[lit].mean() > 0.95
        off = reference.wrapped_difference(frame.wrapped_phase, truth.phase)[lit & frame.mask]
        assert abs(off.mean()) < 0.01
        assert 0.7 < np.sqrt(np.mean((off / frame.phase_sigma[lit & frame.mask]) ** 2)) < 1.3  # within its own sigma
        if code is not None:
            orders = np.abs(np.nan_to_num(frame.unwrapped_phase) - truth.phase) < np.pi
            assert orders[lit & frame.absolute].mean() > 0.998
            assert frame.absolute[lit].mean() > 0.97
        found[brightness] = (
            truth.image.astype(float)[lit].mean(),
            frame.wrapped_phase.copy(),
            frame.phase_sigma.copy(),
            lit & frame.mask,
        )
    (light, phase, sigma, where), (dim_light, dim_phase, dim_sigma, dim_where) = found.values()
    assert 0.70 < dim_light / light < 0.80  # ambient light stays
    both = where & dim_where
    difference = reference.wrapped_difference(dim_phase, phase)[both]
    # The noise of the two is independent, so their difference has both variances.
    assert np.sqrt(np.mean(difference**2 / (sigma**2 + dim_sigma**2)[both])) < 1.3
    assert abs(difference.mean()) < 0.002
