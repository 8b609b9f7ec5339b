"""The pattern that is projected, and its code."""

import json

import numpy as np
import pytest

from pipeline.calibration import Calibration, Pattern
from pipeline.contrast_code import CYCLES, ContrastCode
from pipeline.errors import CalibrationError, OutputError, SettingsError
from pipeline.footage.image_file import read_image
from pipeline.pattern import make_pattern, write_pattern
from pipeline.simulation import simulated_rig

CODED = (
    Pattern(period_px=768 / 44, code="contrast"),
    Pattern(period_px=768 / 44, code="contrast2", cell_px=8.7),
    Pattern(period_px=768 / 44, stripes="vertical", code="contrast2", cell_px=8.7),
)


@pytest.mark.parametrize("pattern", CODED, ids=lambda pattern: f"{pattern.code} {pattern.stripes}")
def test_a_pattern_holds_a_sinusoid_that_is_as_bright_as_can_be(pattern):
    size_px = (160, 768) if pattern.stripes == "horizontal" else (768, 160)
    codes = make_pattern(size_px, pattern).astype(np.float64)
    codes = codes if pattern.stripes == "horizontal" else codes.swapaxes(0, 1)
    cycles = np.arange(768)[:, None] / pattern.period_px
    modulation = ContrastCode.of(pattern).modulation(cycles, np.arange(160))
    np.testing.assert_allclose(codes.mean(axis=-1), np.broadcast_to(1 - modulation, (768, 160)), atol=1e-6)
    vector = codes @ np.exp(-1j * np.array([-1, 0, 1]) * 2 * np.pi / 3) * 2 / 3
    np.testing.assert_allclose(np.abs(vector), np.broadcast_to(modulation, (768, 160)), atol=1e-6)
    np.testing.assert_allclose(np.angle(vector * np.exp(-2j * np.pi * cycles)), 0, atol=1e-5)
    assert codes.min() >= 0 and codes.max() <= 1
    # Every cycle and cell is as bright as the projector can be.
    middles = np.rint(np.arange(1, 43) * pattern.period_px).astype(int)
    assert codes[middles, :, 1].min() > 0.98


def test_more_cycles_than_the_code_tells_apart():
    assert make_pattern((1, CYCLES * 4), Pattern(period_px=4, code="contrast")).shape == (CYCLES * 4, 1, 3)
    for code in ({"code": "contrast"}, {"code": "contrast2", "cell_px": 2}):
        with pytest.raises(SettingsError, match=r"distinguishes 136 cycles.*take a period of 8 px or more"):
            make_pattern((4, 8 * CYCLES), Pattern(period_px=4, **code))


@pytest.mark.parametrize("code", [{}, {"code": "contrast"}, {"code": "contrast2", "cell_px": 8.5}])
def test_a_written_pattern_names_its_code(tmp_path, code):
    pattern = Pattern(period_px=16, stripes="vertical", **code)
    write_pattern(tmp_path / "p.png", (64, 64), pattern)
    described = json.loads((tmp_path / "p.json").read_text())
    assert described["code_version"] == 1 and Pattern(**described) == pattern
    without = {key: value for key, value in described.items() if key not in ("code_version", "compensated")}
    assert Pattern(**without) == pattern, "files without a version are of the first"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"code_version": 2}, "version 2 of a code was made by a newer colorphase: update this one to read it"),
        ({"code_version": 0}, "must be 1, got 0"),
        ({"cell_px": None}, "cell_px is how wide the cells of contrast2 are"),
        ({"code": "contrast"}, "cell_px is how wide the cells of contrast2 are"),
        ({"code": None}, "cell_px is how wide the cells of contrast2 are"),
        ({"cell_px": 1.5}, "must be a number from 2"),
        ({"code": "contrast3"}, 'must be "contrast" or "contrast2"'),
    ],
)
def test_calibrations_whose_pattern_cannot_be(tmp_path, change, message):
    rig = simulated_rig(code="contrast2").model_dump(mode="json")
    (tmp_path / "rig.json").write_text(json.dumps(rig | {"pattern": rig["pattern"] | change}))
    with pytest.raises(CalibrationError) as refused:
        Calibration.read(tmp_path / "rig.json")
    said = str(refused.value)
    assert message in said and "rig.json: pattern" in said and "\n" not in said


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
    described = {"period_px": 16.0, "stripes": stripes, "code": None, "code_version": 1, "cell_px": None}
    assert json.loads((tmp_path / "P.json").read_text()) == described


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


@pytest.mark.parametrize("code", [{}, {"code": "contrast"}, {"code": "contrast2", "cell_px": 8}])
def test_the_light_is_scaled(code):
    pattern = Pattern(period_px=16, **code)
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
