"""Simulated frames, against what optics says of them."""

import numpy as np
import pytest

from pipeline.simulation import TYPICAL_CROSSTALK, WHITE, SimulationSettings, simulate_frame, simulated_rig

SIZE = (160, 120)
PLAIN = {"scene": "plane", "noise_levels": 0.0, "texture": 0.0, "ambient": 0.0, "bits": 16, "reflectance": WHITE}


@pytest.fixture
def rig(cpu):
    return simulated_rig(SIZE, period_px=4 * 768 / 44)


def test_the_cameras_axis_meets_the_plane_where_the_rig_is_turned_to(rig):
    truth = simulate_frame(rig, SimulationSettings(**PLAIN))
    assert truth.image.shape == (120, 160, 3) and truth.image.dtype == np.uint16 and truth.white_level == 65535
    assert truth.points[60, 80, 2] == pytest.approx(900, abs=3)
    middle = rig.projector.matrix[1, 2] / rig.pattern.period_px * 2 * np.pi
    assert truth.phase[59:61, 79:81].mean() == pytest.approx(middle, abs=0.05)


def test_light_is_the_codes_power_mixed_by_the_crosstalk(rig):
    """Of one channel alone, the camera's three see its column of the matrix."""
    codes = np.zeros((768, 1024, 3), np.float32)
    codes[..., 1] = 0.5
    settings = {**PLAIN, "exposure": 0.5}
    seen = {}
    for gamma in (1.0, 2.0):
        light = simulate_frame(rig, SimulationSettings(gamma=gamma, **settings), codes).image[60, 80] / 65535
        seen[gamma] = light
        np.testing.assert_allclose(light / light[1], np.array(TYPICAL_CROSSTALK)[:, 1] / 0.85, rtol=1e-3)
    np.testing.assert_allclose(seen[2.0] / seen[1.0], 0.5, rtol=1e-3)


def test_the_brightest_half_per_cent_reach_nine_tenths(rig):
    image = simulate_frame(rig, SimulationSettings(**PLAIN)).image
    assert np.quantile(image, 0.995) / 65535 == pytest.approx(0.9, abs=2e-3)


def test_noise_is_as_large_as_it_says_and_its_seed_is_its_own(rig):
    settings = {**PLAIN, "noise_levels": 2.0}
    clean = simulate_frame(rig, SimulationSettings(**PLAIN)).image.astype(float)
    frames = [simulate_frame(rig, SimulationSettings(**settings, seed=seed)).image for seed in (1, 1, 2)]
    np.testing.assert_array_equal(frames[0], frames[1])
    noise = (frames[2] - clean)[(clean > 0.1 * 65535) & (clean < 0.85 * 65535)] / 65535 * 255
    assert noise.std() == pytest.approx(2.0, rel=0.03) and abs(noise.mean()) < 0.05


def test_an_encoded_frame_holds_the_same_light(rig):
    linear = simulate_frame(rig, SimulationSettings(**PLAIN)).image / 65535
    encoded = simulate_frame(rig, SimulationSettings(**PLAIN, transfer="srgb")).image / 65535
    bright = linear > 0.01
    np.testing.assert_allclose(((encoded[bright] + 0.055) / 1.055) ** 2.4, linear[bright], atol=2e-4)


def test_a_pixel_with_an_area_is_the_mean_of_finer_ones(rig):
    """A camera of three times as many pixels sees along the same rays."""
    settings = {**PLAIN, "scene": "ball", "exposure": 0.9}
    finer = simulate_frame(simulated_rig((480, 360), period_px=4 * 768 / 44), SimulationSettings(**settings))
    frame = simulate_frame(rig, SimulationSettings(**settings, pixel_rays=3))
    mean = finer.image.reshape(120, 3, 160, 3, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(frame.image, mean, atol=2)
    np.testing.assert_array_equal(frame.points, simulate_frame(rig, SimulationSettings(**settings)).points)


def test_lateral_colour_moves_one_channel(rig):
    shift = np.array([[0.0, 2.0], [0.0, 0.0], [0.0, 0.0]])
    still = simulate_frame(rig, SimulationSettings(**PLAIN, exposure=0.8)).image.astype(float)
    moved = simulate_frame(rig, SimulationSettings(**PLAIN, exposure=0.8, camera_shift_px=shift)).image.astype(float)
    np.testing.assert_array_equal(moved[..., 1:], still[..., 1:])
    np.testing.assert_allclose(moved[12:100, :, 0], still[10:98, :, 0], atol=0.02 * 65535)
    assert np.abs(moved - still)[..., 0].max() > 0.1 * 65535


def test_the_order_is_of_the_true_phase(rig):
    truth = simulate_frame(rig, SimulationSettings(scene="ball"))
    rest = (truth.phase - 2 * np.pi * truth.fringe_order)[truth.mask]
    assert np.abs(rest).max() <= np.pi
    assert not truth.fringe_order[~truth.mask].any()
