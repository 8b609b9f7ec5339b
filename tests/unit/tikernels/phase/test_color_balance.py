"""Local colour balance against full-resolution Gaussian windows."""

import numpy as np
import pytest
import reference

import tikernels
from pipeline.simulation import TYPICAL_CROSSTALK
from tikernels import runtime
from tikernels.phase.color_balance import Gains, WindowSum, apply_gains_kernel
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameLevels

MATRIX = np.array(TYPICAL_CROSSTALK)
PERIOD_PX = 12.3


def skin(height: int, width: int) -> np.ndarray:
    """Return a reflectance that changes by some per cent a cycle, (H, W, 3)."""
    y, x = np.mgrid[:height, :width]
    return np.stack([0.75 + 0.1 * np.sin(x / 30), 0.52 + 0.05 * np.cos(x / 25 + y / 40), 0.42 + 0 * x], axis=-1)


def scene(height: int = 97, width: int = 131, matrix: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return a coloured plane under fringes and its phase."""
    phase = reference.ramp(height, width, PERIOD_PX, tilt=0.02)
    light = reference.fringes(phase, crosstalk_matrix=matrix) * skin(height, width)
    return light.astype(np.float32), phase


def phase_of(balanced: np.ndarray, matrix: np.ndarray | None = None) -> np.ndarray:
    if matrix is not None:
        balanced = reference.correct_crosstalk(balanced, matrix / matrix.sum(axis=1, keepdims=True))
    return reference.compute_wrapped_phase(balanced)[0]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("matrix", [None, MATRIX], ids=["no crosstalk", "crosstalk"])
@pytest.mark.parametrize("masked", [False, True])
def test_as_the_twin(arch, matrix, masked):
    image, _ = scene(matrix=matrix)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    mask = (y < 80) & (x > 20) if masked else np.ones(y.shape, bool)
    balanced = tikernels.balance_color(image, PERIOD_PX, mask if masked else None, crosstalk_matrix=matrix)
    gains = reference.balance_gains(image, PERIOD_PX, mask, matrix)
    # The coarse grid interpolates gains that change by some per cent a cycle: 2 % of a gain is 0.02 rad at the worst
    # phase of the worst corner, and a quarter of the best frame's noise over the picture.
    assert np.abs(balanced / image / gains - 1)[mask].max() < 0.02
    difference = reference.wrapped_difference(phase_of(balanced, matrix), phase_of(image * gains, matrix))[mask]
    assert np.abs(difference).max() < 0.04
    assert rms(difference) < 0.01


@pytest.mark.parametrize("matrix", [None, MATRIX], ids=["no crosstalk", "crosstalk"])
def test_the_colour_no_longer_bends_the_phase(arch, matrix):
    """0.2 rad RMS before; 0.03 rad, the noise of the best frame, where the window is whole, some more at the rim."""
    image, phase = scene(matrix=matrix)
    before = reference.wrapped_difference(phase_of(image, matrix), phase)
    after = reference.wrapped_difference(
        phase_of(tikernels.balance_color(image, PERIOD_PX, crosstalk_matrix=matrix), matrix), phase
    )
    assert rms(before) > 0.2
    assert rms(after[30:-30, 30:-30]) < 0.035
    assert rms(after) < 0.06


def test_the_mean_of_the_channels_stays(arch):
    """The gains' reciprocals average to one: a grey level is worth what it was."""
    image, _ = scene()
    gains = tikernels.balance_color(image, PERIOD_PX) / image
    np.testing.assert_allclose((1 / gains).mean(axis=-1), 1, atol=5e-3)


def test_grey_stays_grey(arch):
    """A white surface needs no balance: gains within half a per cent of one, where the windows are whole."""
    image = reference.fringes(reference.ramp(97, 131, PERIOD_PX, tilt=0.02))
    balanced = tikernels.balance_color(image, PERIOD_PX)
    np.testing.assert_allclose((balanced / image)[30:-30, 30:-30], 1, atol=5e-3)


def test_nothing_lit_changes_nothing(arch):
    image, _ = scene(23, 31)
    np.testing.assert_array_equal(tikernels.balance_color(image, PERIOD_PX, np.zeros((23, 31), bool)), image)
    black = np.zeros_like(image)
    np.testing.assert_array_equal(tikernels.balance_color(black, PERIOD_PX), black)


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (2, 300)])
def test_slim_images(arch, shape):
    image = reference.fringes(reference.ramp(*shape))
    balanced = tikernels.balance_color(image, PERIOD_PX)
    assert balanced.shape == image.shape and np.isfinite(balanced).all()


def test_a_masked_hole_is_not_looked_at(arch):
    image, _ = scene(47, 61)
    mask = np.ones((47, 61), bool)
    mask[20:25, 30:40] = False
    expected = tikernels.balance_color(image, PERIOD_PX, mask)
    image[~mask] = np.nan
    np.testing.assert_array_equal(tikernels.balance_color(image, PERIOD_PX, mask)[mask], expected[mask])


def test_menu(menu):
    image, _ = scene(24, 32)
    menu(
        lambda image, mask, out=None: tikernels.balance_color(image, PERIOD_PX, mask, out=out),
        np.empty_like(image),
        image=image,
        mask=np.random.default_rng(3).random((24, 32)) < 0.9,
    )


@pytest.mark.parametrize("period_px", [3.9, 0.0, -12.0, float("nan")])
def test_periods_that_no_camera_resolves(arch, period_px):
    with pytest.raises(tikernels.ShapeError, match=r"period_px is .*: three colours resolve a cycle of 4 px or more"):
        tikernels.balance_color(np.ones((8, 8, 3), np.float32), period_px)


@pytest.mark.parametrize("matrix", [None, MATRIX], ids=["no crosstalk", "crosstalk"])
def test_the_decoders_gains_are_those_of_the_public_stage(arch, matrix):
    """Bit by bit, for a frame in which every pixel is bright enough for both."""
    image, _ = scene(matrix=matrix)
    crosstalk = Crosstalk.of(np.eye(3) if matrix is None else matrix)
    gains = Gains(*image.shape[:2], PERIOD_PX)
    gains.measure(image, crosstalk, FrameLevels(1.0, 0.001, 0.0, 0.001, 0.005, 0.005))
    balanced = np.empty_like(image)
    apply_gains_kernel(image, gains.gains, gains.spacing_px, balanced)
    np.testing.assert_array_equal(balanced, tikernels.balance_color(image, PERIOD_PX, crosstalk_matrix=matrix))


def test_blocks_of_even_light_do_not_count(arch):
    """The right half has the light of a room; in the block between the two halves both are seen."""
    image, _ = scene(96, 160)
    image[:, 80:] = (0.1, 0.14, 0.12)
    gains = Gains(*image.shape[:2], PERIOD_PX)
    gains.measure(image, Crosstalk.of(np.eye(3)), FrameLevels(1.0, 0.001, 0.0, 0.001, 0.005, 0.005))
    counted = runtime.to_host(gains.sums)[..., WindowSum.SAMPLES] > 0
    edge = 80 // gains.spacing_px
    assert counted[:, :edge].all()
    assert not counted[:, edge + 1 :].any()


def test_a_frame_of_another_size_is_refused(arch):
    gains = Gains(24, 32, PERIOD_PX)
    levels = FrameLevels(1.0, 0.001, 0.0, 0.001, 0.005, 0.005)
    with pytest.raises(tikernels.ShapeError, match=r"image has shape \(25, 32, 3\), expected \(24, 32, 3\)"):
        gains.measure(np.ones((25, 32, 3), np.float32), Crosstalk.of(np.eye(3)), levels)
