"""Times of colours and rows are fitted to light whose times are known, and what they cannot be is named."""

import numpy as np
import pytest

from pipeline.acquisition.light_fields import fit_fields

ROWS = np.arange(4, 480, 8.0)
# Green, red and blue, with a dark gap after each: (3, 2) cycles.
SHOWN = np.array([[0.31, 0.60], [0.02, 0.28], [0.63, 0.95]])
WHITE = np.array([[0.0, 0.25]])


def lit(until, shown):
    """Return for how long colours have been on, since the cycle before last, by a sum of rectangles."""
    since = until[:, None, None] - np.arange(-2, 2)[:, None] - shown[:, 0]
    return np.clip(since, 0, np.diff(shown)[:, 0]).sum(axis=1)


def measured(shown, *, hz=120.0, row_s=20e-6, jitter_s=0.0, noise=0.003, white=0.0, same_start=False):
    """Return what is fitted to frames of a free-running camera, 30 per second, that is started 32 times."""
    rng = np.random.default_rng(5)
    starts_s = 0.27 * np.arange(32) + (0 if same_start else rng.uniform(0, 1 / 30, 32))
    times_s = (starts_s[:, None] + np.array([0, 1 / 30])).ravel()
    exposure_s = 0.2 / hz
    begins = hz * (times_s[:, None] + row_s * ROWS).ravel() % 1
    seen = [(lit(begins + 0.2, each) - lit(begins, each)) / 0.2 for each in (shown, WHITE)]
    primaries = np.array([0.8, 0.5, 0.6]) * seen[0]
    light = np.zeros((len(begins), 4, 3))
    light[:, range(3), range(3)] = primaries
    light[:, 3] = primaries + white * seen[1]
    light += noise * rng.standard_normal(light.shape)
    told_s = times_s + jitter_s * rng.standard_normal(len(times_s))
    return fit_fields(light.reshape(len(times_s), -1, 4, 3), told_s, ROWS, exposure_s, 1.0005 / hz)


def errors_s(found, shown, hz):
    """Return by how much edges are off, after red goes on."""
    off = hz * found.shown_s - (shown - shown[0, 0])
    return (off - np.rint(off)) / hz


@pytest.mark.parametrize("hz", [20, 60, 120])
@pytest.mark.parametrize("row_s, jitter_s", [(0.0, 0.0), (20e-6, 0.0), (20e-6, 2e-4)])
def test_edges_and_rows(hz, row_s, jitter_s):
    found = measured(SHOWN, hz=hz * 1.01, row_s=row_s, jitter_s=jitter_s)
    assert found.doubt is None
    # The cycle to as much as the times of 64 frames over 8 s allow; edges to 3 per mille of a cycle.
    assert found.period_s == pytest.approx(1 / (1.01 * hz), rel=1e-6 + jitter_s / 8)
    errors = errors_s(found, SHOWN, 1.01 * hz)
    assert np.abs(errors).max() < 0.003 / hz
    assert np.abs(errors).max() < 3 * found.shown_sigma_s
    assert found.row_s == pytest.approx(row_s, abs=0.02e-6)
    assert found.shown_sigma_s < 0.01 / hz


def test_uncertainty_grows_with_the_errors_of_the_frames_times():
    """With a global shutter an edge is seen by few frames, each of which may be off."""
    found = measured(SHOWN, hz=61.0, row_s=0.0, jitter_s=2e-4)
    errors = np.abs(errors_s(found, SHOWN, 61.0)).max()
    assert 2e-5 < found.shown_sigma_s < 2e-4
    assert errors < 3 * found.shown_sigma_s
    assert found.row_s == 0


def test_colours_that_touch_are_set_apart():
    touching = np.array([[0.0, 0.3], [0.3, 0.7], [0.7, 1.0]])
    found = measured(touching)
    assert found.doubt is None
    on, off = found.apart_s.T
    assert (off[:2] <= on[1:]).all()
    assert off[2] <= found.period_s
    np.testing.assert_allclose(found.apart_s, found.shown_s, atol=3 * found.shown_sigma_s)


@pytest.mark.parametrize(
    "shown, changes, words",
    [
        (np.array([[0.0, 0.4], [0.3, 0.7], [0.7, 1.0]]), {}, "two colours are on at the same time for 0.8"),
        (0.25 + 0.75 * SHOWN, {"white": 0.5}, "more light than red, green and blue: switch off the white segment"),
        (SHOWN, {"jitter_s": 4e-3, "row_s": 0.0}, "the times of the frames are not exact"),
        (SHOWN, {"hz": 60.0, "same_start": True, "row_s": 0.0}, "the camera keeps step with it"),
    ],
)
def test_what_cannot_be_stated_is_named(shown, changes, words):
    assert words in measured(shown, **changes).doubt
