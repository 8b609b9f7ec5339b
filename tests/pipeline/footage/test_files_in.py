"""What users hand us: calibrations, settings and pictures; each mistake is one line that names the file and the key."""

import json
import struct
import zlib

import cv2
import numpy as np
import pytest

from pipeline import Calibration, DecodeSettings
from pipeline.calibration import Pattern
from pipeline.errors import CalibrationError, FootageError, OutputError, SettingsError
from pipeline.footage.image_file import read_image
from pipeline.pattern.fringes import make_pattern, write_pattern
from pipeline.simulation import simulated_rig


def values():
    return json.loads(simulated_rig().model_dump_json())


def test_a_calibration_survives_its_file(tmp_path):
    rig = simulated_rig(stripes="vertical", tilt_deg=7, camera_distortion=(0.1, 0.2, 0.3, 0.4, 0.5))
    rig.write(tmp_path / "calibration.json")
    again = Calibration.read(tmp_path / "calibration.json")
    assert again.digest() == rig.digest()
    np.testing.assert_array_equal(again.rotation, rig.rotation)
    assert again.pattern == rig.pattern
    with pytest.raises(ValueError, match="read-only"):
        again.rotation[0, 0] = 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"baseline": 1}, "baseline: is not a known key"),
        ({"pattern": None}, "pattern"),
        ({"rotation": np.diag([1, 1, 2]).tolist()}, "rotation must be a rotation matrix"),
        ({"rotation": [[1, 0], [0, 1]]}, r"rotation: must have shape \(3, 3\), got \(2, 2\)"),
        ({"translation_mm": [0, 0, "x"]}, "translation_mm: must be 3 numbers"),
        ({"translation_mm": [0, 0, 0]}, "translation_mm must not be zero"),
        ({"crosstalk_matrix": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}, "crosstalk_matrix cannot be inverted"),
        ({"depth_range_mm": [900, 700]}, "depth_range_mm"),
        ({"response": [[0] * 256] * 3}, "response must rise"),
        ({"camera": {"size_px": [640, 480], "matrix": np.eye(3).tolist(), "distortion": [0] * 4}}, "camera.distortion"),
        ({"camera": {"size_px": [640, -1], "matrix": np.eye(3).tolist()}}, "camera.size_px.1"),
        ({"projector": {"size_px": [640, 480], "matrix": np.diag([-1, 1, 1]).tolist()}}, "projector: matrix must be"),
    ],
)
def test_a_wrong_calibration_is_refused_by_its_key(tmp_path, change, message):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({**values(), **change}))
    with pytest.raises(CalibrationError, match=message) as raised:
        Calibration.read(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_missing_key_and_a_broken_file(tmp_path):
    path = tmp_path / "calibration.json"
    broken = values()
    del broken["projector"]
    path.write_text(json.dumps(broken))
    with pytest.raises(CalibrationError, match="projector: is missing"):
        Calibration.read(path)
    path.write_text("{")
    with pytest.raises(CalibrationError, match="not what it should be"):
        Calibration.read(path)
    with pytest.raises(CalibrationError, match="No such file"):
        Calibration.read(tmp_path / "none.json")


def test_settings_from_toml(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text('stripes = "vertical"\nsmoothing_px = 7\nnoise = [1.5, 0.0]\n')
    settings = DecodeSettings.read(path)
    assert (settings.stripes, settings.smoothing_px, settings.noise) == ("vertical", 7, (1.5, 0.0))
    assert settings.equalize  # what is left out is the default


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stripe = 'vertical'", "stripe: is not a known key"),
        ("stripes = 'diagonal'", "stripes: "),
        ("smoothing_px = 4", "smoothing_px: must be 0 or odd"),
        ("camera_period_px = 2.0", "camera_period_px"),
        ("unwrap_method = 'magic'", "unwrap_method"),
        ("crosstalk_matrix = [[1, 0, 0], [1, 0, 0], [0, 0, 1]]", "crosstalk_matrix cannot be inverted"),
        ("a = [", "not what it should be"),
    ],
)
def test_wrong_settings_are_refused_by_their_key(tmp_path, text, message):
    path = tmp_path / "settings.toml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=message):
        DecodeSettings.read(path)


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [(".png", np.uint8), (".png", np.uint16), (".tif", np.uint8), (".tif", np.uint16), (".bmp", np.uint8)],
)
def test_pictures_are_read_as_they_are(tmp_path, suffix, dtype):
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (20, 30, 3)).astype(dtype)
    path = tmp_path / f"Bild ä{suffix}"
    path.write_bytes(cv2.imencode(suffix, image[..., ::-1])[1].tobytes())
    np.testing.assert_array_equal(read_image(path), image)


def test_pictures_that_are_none(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    data = {suffix: cv2.imencode(suffix, image)[1].tobytes() for suffix in (".png", ".jpg", ".tif", ".bmp")}
    bad = {
        "grey.png": (cv2.imencode(".png", image[..., 0])[1].tobytes(), "grey"),
        "alpha.png": (cv2.imencode(".png", np.dstack([image, image[..., 0]]))[1].tobytes(), "transparency"),
        "empty.png": (b"", "not a picture"),
        "text.png": (b"hello", "not a picture"),
        **{f"cut{suffix}": (whole[: len(whole) // 2], "truncated|not a picture") for suffix, whole in data.items()},
    }
    for name, (content, message) in bad.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FootageError, match=message) as raised:
            read_image(tmp_path / name)
        assert name in str(raised.value)
        assert "\n" not in str(raised.value)
    with pytest.raises(FootageError, match="folder"):
        read_image(tmp_path)
    with pytest.raises(FootageError, match="No such file"):
        read_image(tmp_path / "none.png")


def test_what_libpng_says_is_not_printed(tmp_path, capfd):
    """Neither of damage nor of a colour profile that it does not like."""
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    data = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
    profile = b"iCCPx\0\0" + zlib.compress(bytes(200))
    profile = struct.pack(">I", len(profile) - 4) + profile + struct.pack(">I", zlib.crc32(profile))
    (tmp_path / "profile.png").write_bytes(data[:33] + profile + data[33:] + b"and more")
    np.testing.assert_array_equal(read_image(tmp_path / "profile.png"), image)
    (tmp_path / "wrong.png").write_bytes(data[:2000] + bytes(50) + data[2050:])
    with pytest.raises(FootageError, match=r"wrong\.png is damaged: copy it again"):
        read_image(tmp_path / "wrong.png")
    assert capfd.readouterr().err == ""


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
