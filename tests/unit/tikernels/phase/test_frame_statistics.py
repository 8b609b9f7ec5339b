"""What a frame says of itself."""

import numpy as np
import pytest
import reference

import tikernels
from tikernels.phase.frame_statistics import count_out_of_range, measure_frame

COLOR = np.array([0.75, 0.52, 0.42])


def frame(period_px: float, noise: float = 0.01, turn: int = 1) -> np.ndarray:
    phase = turn * reference.ramp(240, 160, period_px, tilt=0.02)
    noise = noise * np.random.default_rng(1).standard_normal((240, 160, 3))
    return (reference.fringes(phase) * COLOR + noise).astype(np.float32)


@pytest.mark.parametrize("period_px", [5.0, 8.0, 12.3, 17.45, 40.0])
@pytest.mark.parametrize("turn", [1, -1])
def test_the_period_is_found(arch, period_px, turn):
    """To three per cent, which changes no window by a pixel; either way round."""
    assert measure_frame(frame(period_px, turn=turn)).period_px == pytest.approx(period_px, rel=0.03)


@pytest.mark.parametrize("noise", [0.002, 0.01, 0.05])
def test_the_noise_is_found(arch, noise):
    """To 20 %, which moves a threshold of five deviations by one."""
    read, gain = measure_frame(frame(12.0, noise)).noise
    assert np.sqrt(read**2 + gain * 0.3) == pytest.approx(noise, rel=0.2)


def test_noise_that_grows_with_the_light(arch):
    """Photons: the variance is proportional to the light, and tells a tenth of the brightness from the whole."""
    shade = np.linspace(0.1, 1, 160, dtype=np.float32)[None, :, None]
    light = shade * np.float32(0.6) * frame(12.0, 0.0)
    rng = np.random.default_rng(3)
    noisy = light + np.sqrt(2e-6 + 1e-4 * light) * rng.standard_normal(light.shape, np.float32)
    read, gain = measure_frame(noisy).noise
    for level in (0.1, 0.3):
        assert read**2 + gain * level == pytest.approx(2e-6 + 1e-4 * level, rel=0.4)


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_read_noise_is_told_from_the_light_s(arch, tilt):
    """By 8-bit levels of full-well 10,000 electrons, in a frame most of which is dark; stripes may be tilted."""
    phase = reference.ramp(480, 640, 12.0, tilt=tilt)
    light = (reference.fringes(phase) * COLOR * 0.8).astype(np.float32)
    light[:, 200:] *= 0.1
    rng = np.random.default_rng(5)
    electrons = rng.poisson(light * 1e4) + 5 * rng.standard_normal(light.shape)
    levels = np.clip(np.rint(electrons / 1e4 * 255), 0, 255).astype(np.uint8)
    read, gain = measure_frame(levels).noise
    for level in (0.1, 0.4):
        true = 5e-4**2 + 1e-4 * level + 1 / 255**2 / 12
        assert read**2 + gain * level == pytest.approx(true, rel=0.35)


def test_the_fringe_is_measured(arch):
    assert measure_frame(frame(12.0, 0.001)).modulation == pytest.approx(
        0.5 * COLOR.mean(), rel=0.25
    )  # colours are not balanced yet


def test_the_brightness_is_found(arch):
    image = np.full((64, 64, 3), 0.2, np.float32)
    image[:, :32] = 0.6
    assert measure_frame(image).brightness == pytest.approx(0.6, abs=1e-6)


def test_what_is_clipped_is_a_share_of_what_is_lit(arch):
    """Each of three channels is cut over acos(0.498 / 0.6) / pi of a cycle, never two at once."""
    phase = np.arange(360)[:, None, None] * (2 * np.pi / 36) + np.array([-1, 0, 1]) * 2 * np.pi / 3
    image = np.zeros((360, 400, 3), np.float32)
    image[:, 200:] = np.clip(0.5 + 0.6 * np.cos(phase), 0, 1)
    share = 3 * np.arccos(0.498 / 0.6) / np.pi
    assert measure_frame(image).clipped == pytest.approx(share, abs=0.05)
    assert measure_frame(0.9 * image).clipped == 0
    assert measure_frame(np.zeros((64, 64, 3), np.uint8)).clipped == 0


@pytest.mark.parametrize("dtype, white", [("uint8", 255), ("uint16", 65535), ("uint16", 4095)])
def test_levels_are_fractions_of_white(arch, dtype, white):
    image = frame(12.0)
    levels = np.rint(np.clip(image, 0, 1) * white).astype(dtype)
    found, expected = measure_frame(levels, white), measure_frame(image)
    assert found.brightness == pytest.approx(expected.brightness, abs=1 / white)
    assert found.period_px == pytest.approx(expected.period_px, rel=1e-3)


def test_no_fringe_is_no_period(arch):
    rng = np.random.default_rng(2)
    across = reference.fringes(reference.ramp(120, 120).T)
    for image in (np.zeros((64, 64, 3), np.float32), rng.random((64, 64, 3), np.float32), across, across[:5]):
        assert measure_frame(image).period_px is None


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (7, 2)])
def test_slim_images(arch, shape):
    assert min(measure_frame(reference.fringes(reference.ramp(*shape))).noise) >= 0


def test_values_out_of_range_are_counted(arch):
    image = np.full((9, 17, 3), 0.5, np.float32)
    image[1, 2] = np.nan, -0.1, 1.1
    image[8, 16, 2] = np.inf
    assert count_out_of_range(image, 1.0) == (1, 3)
    assert count_out_of_range(np.full((3, 3, 3), 200, np.uint8), 199) == (0, 27)


@pytest.mark.parametrize("bad", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4, 3), int)])
def test_wrong_images(arch, bad):
    for measure in (measure_frame, lambda image: count_out_of_range(image, 1.0)):
        with pytest.raises(tikernels.ShapeError, match="image"):
            measure(bad)
