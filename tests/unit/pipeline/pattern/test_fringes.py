"""The picture that is projected."""

import json

import numpy as np
import pytest

from pipeline.calibration import Pattern
from pipeline.errors import OutputError, SettingsError
from pipeline.footage.image_file import read_image
from pipeline.pattern import make_pattern, write_pattern


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_the_pattern(tmp_path, stripes):
    pattern = Pattern(period_px=16, stripes=stripes)
    codes = make_pattern((64, 48), pattern)
    assert codes.shape == (48, 64, 3)
    line = codes[:, 5] if stripes == "horizontal" else codes[5]
    assert line[0, 1] == 1  # green brightest at phase 0, the first row's centre
    np.testing.assert_allclose(line.sum(axis=-1), 1.5, atol=1e-6)
    phase = np.arctan2(np.sqrt(3) * (line[:, 0] - line[:, 2]), 2 * line[:, 1] - line[:, 0] - line[:, 2])
    np.testing.assert_allclose(np.unwrap(phase), 2 * np.pi * np.arange(len(line)) / 16, atol=1e-5)
    write_pattern(tmp_path / "P.png", (64, 48), pattern)
    assert np.abs(read_image(tmp_path / "P.png") / 255 - codes).max() <= 0.5 / 255 + 1e-6
    assert json.loads((tmp_path / "P.json").read_text()) == {"period_px": 16.0, "stripes": stripes, "code": None}


def test_patterns_that_cannot_be(tmp_path):
    with pytest.raises(SettingsError, match="cannot hold a cycle"):
        make_pattern((64, 10), Pattern(period_px=16))
    with pytest.raises(OutputError, match=r"\.png"):
        write_pattern(tmp_path / "P.jpg", (64, 48), Pattern(period_px=16))


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
