"""A pattern with less light: the same light but for a factor, and the same phase."""

import json

import numpy as np
import pytest
import reference

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Pattern
from pipeline.errors import SettingsError
from pipeline.footage.image_file import read_image
from pipeline.pattern.fringes import make_pattern, write_pattern
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

pytestmark = pytest.mark.usefixtures("cpu")

BRIGHTNESS = 0.85
CODES = np.linspace(0, 1, 256)
RESPONSE = np.stack([CODES**gamma for gamma in (1.8, 2.0, 2.4)])


def light_of(codes):
    """Return the light of codes, with the response above."""
    return np.stack([np.interp(codes[..., j], CODES, RESPONSE[j]) for j in range(3)], axis=-1)


@pytest.mark.parametrize("code", [None, "contrast"])
def test_the_light_is_scaled(code):
    pattern = Pattern(period_px=16, code=code)
    bright = make_pattern((64, 96), pattern, RESPONSE)
    dim = make_pattern((64, 96), pattern, RESPONSE, BRIGHTNESS)
    np.testing.assert_allclose(light_of(dim), BRIGHTNESS * light_of(bright), atol=1e-6)
    assert np.abs(dim - BRIGHTNESS * bright).max() > 0.02  # and so the codes are not
    np.testing.assert_allclose(
        make_pattern((64, 96), pattern, brightness=BRIGHTNESS), BRIGHTNESS * make_pattern((64, 96), pattern), atol=1e-6
    )


def test_files(tmp_path):
    pattern = Pattern(period_px=16)
    for name, brightness in (("bright", 1.0), ("dim", BRIGHTNESS)):
        write_pattern(tmp_path / f"{name}.png", (64, 96), pattern, brightness=brightness)
    write_pattern(tmp_path / "plain.png", (64, 96), pattern)
    for kind in ("png", "json"):
        assert (tmp_path / f"bright.{kind}").read_bytes() == (tmp_path / f"plain.{kind}").read_bytes()
    assert json.loads((tmp_path / "dim.json").read_text()) == json.loads((tmp_path / "plain.json").read_text())
    dim, bright = (read_image(tmp_path / f"{name}.png").astype(float) for name in ("dim", "bright"))
    assert np.abs(dim - BRIGHTNESS * bright).max() <= 1  # each rounded by half a level


@pytest.mark.parametrize("brightness", [0.0, -0.5, 1.001, float("nan"), float("inf")])
def test_brightnesses_that_cannot_be(brightness):
    with pytest.raises(SettingsError, match="more than 0 and at most 1"):
        make_pattern((64, 96), Pattern(period_px=16), brightness=brightness)


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
