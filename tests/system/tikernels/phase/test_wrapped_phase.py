"""The arctangent of three sinusoids, and that backends agree on it."""

import numpy as np
import pytest
import reference

import tikernels
from pipeline import Decoder, DecodeSettings
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig


@pytest.mark.parametrize("shape", [(1, 1), (1, 63), (31, 17)])
def test_as_the_twin(arch, shape):
    image = np.random.default_rng(1).random((*shape, 3), np.float32)
    phase, modulation, background = tikernels.compute_wrapped_phase(image)
    expected = reference.compute_wrapped_phase(image)
    # The arctangent is a polynomial with an error of 2e-6 rad; float32 adds as much at low contrast.
    assert np.abs(reference.wrapped_difference(phase, expected[0])).max() < 1e-5
    np.testing.assert_allclose(modulation, expected[1], atol=1e-6)
    np.testing.assert_allclose(background, expected[2], atol=1e-6)


def test_every_angle_there_and_back(arch):
    """1e-5 rad is a thousandth of the noise; branch cut and octant borders included."""
    angles = np.concatenate([np.linspace(-np.pi, np.pi, 4001), np.arange(-4, 5) * np.pi / 4]).reshape(1, -1)
    phase, modulation, background = tikernels.compute_wrapped_phase(reference.fringes(angles))
    assert np.abs(reference.wrapped_difference(phase, angles)).max() < 1e-5
    assert np.abs(phase).max() <= np.float32(np.pi)
    np.testing.assert_allclose(modulation, 0.25, atol=1e-6)
    np.testing.assert_allclose(background, 0.4, atol=1e-6)


def test_a_plane_is_a_ramp(arch):
    phase, _, _ = tikernels.compute_wrapped_phase(reference.fringes(reference.ramp(48, 40, 12.0)))
    steps = reference.wrapped_difference(phase[1:], phase[:-1])
    np.testing.assert_allclose(steps, 2 * np.pi / 12, atol=1e-5)  # a cycle every twelve pixels


def test_green_is_brightest_at_zero(arch):
    green, red, blue = (np.float32(c).reshape(1, 1, 3) for c in ([0.4, 1, 0.4], [1, 0.4, 0.4], [0.4, 0.4, 1]))
    angles = [float(tikernels.compute_wrapped_phase(image)[0][0, 0]) for image in (green, red, blue)]
    np.testing.assert_allclose(angles, [0, 2 * np.pi / 3, -2 * np.pi / 3], atol=1e-5)


def test_grey_has_no_modulation(arch):
    phase, modulation, background = tikernels.compute_wrapped_phase(np.full((3, 5, 3), 0.5, np.float32))
    assert np.isfinite(phase).all()
    np.testing.assert_allclose(modulation, 0, atol=1e-7)
    np.testing.assert_allclose(background, 0.5)


def test_missing_values_spread_to_no_other_pixel(arch):
    image = reference.fringes(reference.ramp(6, 8))
    expected = tikernels.compute_wrapped_phase(image)
    image[2, 3, 1] = np.nan
    others = np.ones((6, 8), bool)
    others[2, 3] = False
    for found, want in zip(tikernels.compute_wrapped_phase(image), expected, strict=True):
        np.testing.assert_array_equal(found[others], want[others])


def test_menu(menu):
    image = reference.fringes(reference.ramp(5, 7))
    spare = np.empty((5, 7), np.float32), np.empty((5, 7), np.float32)

    def phase(image, out=None):
        return tikernels.compute_wrapped_phase(image, None if out is None else (out, *spare))[0]

    menu(phase, np.empty((5, 7), np.float32), image=image)


@pytest.mark.parametrize("arch", ["vulkan"], indirect=True)
@pytest.mark.parametrize("bands", ["broad", "narrow"])
def test_backends_decode_the_same(arch, bands):
    """A frame's phase to 1e-3 rad, 7 um of depth; its orders except for a pixel in 10,000; each backend bit by bit."""
    frame = simulate_frame(simulated_rig((320, 240)), SimulationSettings(reflectance_bands=bands))
    settings = DecodeSettings(crosstalk_matrix=np.array(TYPICAL_CROSSTALK), reflectance_bands=bands)
    results = {}
    for name in (arch, "cpu"):
        first, second = (Decoder(settings, arch=name).decode(frame.image) for _ in range(2))
        for field in ("wrapped_phase", "unwrapped_phase", "mask", "modulation", "region"):
            np.testing.assert_array_equal(getattr(first, field), getattr(second, field), err_msg=f"{name}: {field}")
        results[name] = first
    gpu, cpu = results[arch], results["cpu"]
    assert np.count_nonzero(gpu.mask != cpu.mask) <= 1e-3 * gpu.mask.size
    both = gpu.mask & cpu.mask
    difference = np.abs(reference.wrapped_difference(gpu.wrapped_phase, cpu.wrapped_phase))[both]
    assert np.count_nonzero(difference > 1e-3) <= 1e-4 * gpu.mask.size
    assert np.count_nonzero((gpu.fringe_order != cpu.fringe_order) & both) <= 1e-4 * gpu.mask.size
