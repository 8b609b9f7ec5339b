"""Standard deviations: as NumPy computes them, and as the errors really are."""

import cv2
import numpy as np
import pytest
import reference

from pipeline.simulation import TYPICAL_CROSSTALK
from tikernels import ShapeError, runtime
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.channel_template import flat_template
from tikernels.phase.color_balance import Gains
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import correction_table
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_fit import fit_phase
from tikernels.phase.smoothing import _window, left_of_variance
from tikernels.phase.surfaces import Surfaces
from tikernels.phase.uncertainty import compare_rows, estimate_phase_sigma, phase_sigma

SHAPE = (41, 67)
DOUBT = 0.02


def case(seed=1):
    """Return a precision, the variance that smoothing leaves, and a mask."""
    rng = np.random.default_rng(seed)
    precision = (1e3 + 4e3 * rng.random(SHAPE)).astype(np.float32)
    return precision, (1e-3 * rng.random(SHAPE)).astype(np.float32), (rng.random(SHAPE) > 0.1).astype(np.uint8)


def expected_sigma(precision, smoothed, mask, empty, scatter, model=0.0):
    """Return the fit's sigma, of which smoothing averages all but the model's 3 %, and 0.025 rad beside nothing."""
    noise = smoothed + 0.03 / precision
    sigma = np.sqrt(scatter**2 * noise + model + 0.025**2 * empty)
    return np.where(mask == 0, np.nan, np.minimum(sigma, np.pi / np.sqrt(3)))


def test_as_the_twin(arch):
    precision, smoothed, mask = case()
    empty = np.random.default_rng(2).random(SHAPE).astype(np.float32)
    model = (1e-4 * np.random.default_rng(5).random(SHAPE)).astype(np.float32)
    precision[:3, :5] = 1e-5  # next to nothing is known
    out = phase_sigma(precision, model, smoothed, mask, empty, 1.3)
    expected = expected_sigma(precision, smoothed, mask, empty, 1.3, model)
    np.testing.assert_allclose(runtime.to_host(out), expected, rtol=1e-5)


def test_rows_that_differ_by_what_is_expected_have_a_ratio_of_one(arch):
    """Of a bent surface with that noise; the median of a normal distribution's size is 0.6745 sigma."""
    height, width = 400, 300
    precision, smoothed = (np.full((height, width), value, np.float32) for value in (2500, 0.2 / 2500))
    mask = np.ones((height, width), np.uint8)
    mask[:5, :7] = 0
    sigma = expected_sigma(precision, smoothed, mask, np.float32(0), 1)
    rows = np.arange(height)[:, None]
    noise = sigma * np.random.default_rng(3).standard_normal((height, width))
    phase = (0.1 * rows + 1e-4 * rows**2 + noise).astype(np.float32)
    step, every, none = 4, 3, np.zeros_like(phase)
    ratio = runtime.to_host(compare_rows(phase, precision, none, smoothed, mask, 1.0, step, every))
    assert np.isnan(ratio[:5, :3]).all() and np.isfinite(ratio[:, 3:]).all()
    assert np.median(ratio[:, 3:]) / 0.6745 == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("overrated", [1.0, 2.0])
def test_the_estimate_is_what_rows_really_differ_by(arch, overrated):
    """Of a plane with smoothed noise, to 5 %, whether the fit's precision is right or half as good as it says."""
    height, width, pairs, period_px = 240, 200, 2, 12.0
    noise = np.random.default_rng(4).standard_normal((height + 2 * pairs, width + 2 * pairs)) * 0.05
    mean, quadric = (weights[:, None] for weights in _window(pairs))
    kernel = quadric @ mean.T + mean @ (quadric - mean).T
    smoothed = cv2.filter2D(noise, -1, kernel)[pairs:-pairs, pairs:-pairs]
    phase = (reference.ramp(height, width, period_px, tilt=0.02) + smoothed).astype(np.float32)
    mask = np.ones((height, width), bool)
    mask[100:110, 50:60] = False
    phase[~mask] = np.nan
    precision = np.full((height, width), overrated**2 / 0.05**2, np.float32)
    variance = left_of_variance(pairs) / precision
    variance[105, 49] = 1 / precision[105, 49]
    sigma = runtime.to_host(estimate_phase_sigma(phase, precision, variance, None, mask, None, pairs, period_px))
    assert np.isnan(sigma[~mask]).all() and np.isfinite(sigma[mask]).all()
    assert np.median(sigma[mask]) == pytest.approx(smoothed.std(), rel=0.05)
    # Beside the hole nothing was smoothed, and part of the model's window is empty.
    assert sigma[105, 49] > 1.5 * np.median(sigma[mask])


def flat(misfit: np.ndarray, edges: np.ndarray | None = None) -> np.ndarray:
    """Return the sigma of a plane with a noise of 0.02 rad, not smoothed, given the fit's misfit."""
    phase = reference.ramp(*misfit.shape, 12.0, tilt=0.02)
    noise = 0.02 * np.random.default_rng(6).standard_normal(phase.shape)
    phase, precision = (phase + noise).astype(np.float32), np.full(phase.shape, 1 / 0.02**2, np.float32)
    everywhere = np.ones(phase.shape, bool)
    return runtime.to_host(estimate_phase_sigma(phase, precision, 1 / precision, misfit, everywhere, edges, 0, 12.0))


def misfits_of_noise(shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    return (np.random.default_rng(7).standard_normal(shape) ** 2).astype(np.float32)


def test_misfits_of_noise_cost_next_to_nothing(arch):
    sigma = flat(misfits_of_noise())[30:-30, 30:-30]
    assert np.median(sigma) == pytest.approx(0.02, rel=0.05)
    assert np.quantile(sigma, 0.9) < 0.023


def test_a_spot_that_the_model_does_not_fit_is_less_sure(arch):
    """Misfits of nine standard deviations squared: a model that is wrong across the phase is as wrong along it."""
    misfit = misfits_of_noise()
    misfit[100:106, 200:206] = 9.0
    sigma = flat(misfit)
    assert np.median(sigma[101:105, 201:205]) == pytest.approx(0.02 * np.sqrt(1 + 8), rel=0.15)
    assert np.median(sigma[40:60, 100:150]) == pytest.approx(0.02, rel=0.05)


def test_a_surface_that_fits_a_little_worse_is_less_sure_all_over(arch):
    """Too little to be seen in a few pixels, plain to see in some hundred."""
    misfit = misfits_of_noise()
    misfit[:, 160:] *= 1.3
    sigma = flat(misfit)
    assert np.median(sigma[20:-20, 200:300]) > 1.07 * np.median(sigma[20:-20, 20:120])


def test_an_edge_of_paint_is_less_sure(arch):
    edges = np.zeros((240, 320), np.float32)
    edges[:, 150:155] = 0.05**2
    sigma = flat(misfits_of_noise(), edges)
    assert np.median(sigma[:, 151:154]) == pytest.approx(np.hypot(0.05, 0.02), rel=0.1)
    assert np.median(sigma[:, :140]) == pytest.approx(0.02, rel=0.05)


def test_a_model_that_is_wrong_over_most_of_a_frame_makes_the_rest_no_surer(arch):
    """What is wrong in the same way over many rows scatters less than it is off: only noise is compared with rows."""
    misfit = misfits_of_noise()
    misfit[:, 100:] *= 20.0
    sigma = flat(misfit)
    assert np.median(sigma[20:-20, 10:50]) == pytest.approx(0.02, rel=0.05)
    assert np.median(sigma[20:-20, 150:-20]) > 0.06


DELAYS = np.array([-1, 0, 1]) * 2 * np.pi / 3
MATRIX = np.array(TYPICAL_CROSSTALK)


@pytest.mark.parametrize("mixed", [False, True])
def test_another_colour_widens_its_own_part(cpu, mixed):
    """A surface of narrow reflectances bends the phase by more than noise; that is said, to a factor of two.

    Where colours are known to act on the projector's light, nothing is left over.
    """
    shape, noise, levels = (240, 320), 1.5, FrameLevels(255.0, 1.5, 0.0, 1.5, 5.0, 5.0)
    truth = reference.ramp(*shape, 12.3, tilt=0.02)
    light = 0.5 + 0.5 * np.cos(truth[..., None] + DELAYS)
    light[:, 240:] *= (1.0, 0.6, 0.4)
    image = (200 * light @ MATRIX.T + noise * np.random.default_rng(7).standard_normal((*shape, 3))).astype(np.float32)
    crosstalk = Crosstalk.of(np.eye(3), surfaces=Surfaces.of(MATRIX)) if mixed else Crosstalk.of(MATRIX)
    gains = Gains(*shape, 12.3)
    model = ChannelModel(gains)
    gains.measure(image, crosstalk, levels)
    correction = correction_table(model.recover(crosstalk, levels), 9)
    model.fit(crosstalk, correction, flat_template(), DOUBT)
    found = fit_phase(image, model, crosstalk, levels, correction, DOUBT)
    difference = reference.wrapped_difference(runtime.to_host(found.phase), truth)
    unwrapped = (truth + difference).astype(np.float32)
    everywhere = np.ones(shape, bool)
    seen = (found.precision, 1 / runtime.to_host(found.precision), found.misfit)
    sigma = runtime.to_host(estimate_phase_sigma(unwrapped, *seen, everywhere, None, 0, 12.3))
    left, right = (difference[40:200, part] for part in (slice(30, 150), slice(260, 310)))
    said = [np.sqrt((sigma[40:200, part] ** 2).mean()) for part in (slice(30, 150), slice(260, 310))]
    assert 0.7 < said[0] / (left - left.mean()).std() < 2
    assert 0.5 < said[1] / (right - right.mean()).std() < 2.5
    if not mixed:
        assert (right - right.mean()).std() > 2 * (left - left.mean()).std()


def test_menu(menu):
    precision, smoothed, mask = case()
    empty = np.random.default_rng(2).random(SHAPE).astype(np.float32)

    def measure(out=None, **inputs):
        found = phase_sigma(**inputs, scatter=1.3, out=out)
        return runtime.to_host(found) if out is None else found

    fields = {
        "precision": precision,
        "model": 1e-4 * empty,
        "smoothed": smoothed,
        "mask": mask,
        "empty": empty,
    }
    menu(measure, np.empty(SHAPE, np.float32), **fields)


def test_too_few_rows_to_compare(arch):
    level = np.ones((12, 5), np.float32)
    with pytest.raises(ShapeError, match="phase has 12 rows: four rows 4 px apart need 13"):
        compare_rows(level, level, level, level, np.ones((12, 5), np.uint8), 1.0, 4, 1)
