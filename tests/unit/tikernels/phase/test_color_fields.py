"""When a camera sees colours that are shown one after another."""

import numpy as np
import pytest

from tikernels.phase.color_fields import ColorFields

THIRDS = np.array([[0, 1], [1, 2], [2, 3]]) / 3
GAPS = np.array([[0.05, 0.25], [0.3, 0.6], [0.65, 0.9]])


def seen_times(shown: np.ndarray, start: float, cycles: int) -> np.ndarray:
    """Return the mean times of the colours in an exposure of whole cycles, by counting instants."""
    instants = start + cycles * (np.arange(60_000) + 0.5) / 60_000
    return np.array([(instants[(instants % 1 >= on) & (instants % 1 < off)]).mean() for on, off in shown]) - (
        start + cycles / 2
    )


@pytest.mark.parametrize("shown", [THIRDS, GAPS])
@pytest.mark.parametrize("cycles", [1, 3])
def test_mean_times_are_those_of_all_instants(shown, cycles):
    for start in np.linspace(0, 1, 23):
        (times,) = ColorFields(0.5, shown=shown, start=start).times(1)
        np.testing.assert_allclose(times[0], 0.5 * seen_times(shown, start, cycles), atol=1e-4)


def test_rows_are_exposed_one_after_another():
    (times,) = ColorFields(0.5, 0.002, THIRDS, start=0.1).times(600)
    (later,) = ColorFields(0.5, shown=THIRDS, start=0.1 + 0.002 * 350).times(1)
    np.testing.assert_allclose(times[350], later[0])


def test_a_start_moves_by_a_frame_and_strays():
    """A frame of 2.25 cycles; 0.01 frames are 0.0225 cycles."""
    fields = ColorFields(1 / 2.25, shown=THIRDS)
    before = np.eye(64)[10]
    waves = np.exp(2j * np.pi * np.arange(64) / 64)
    mean = (fields.expect(before) * waves).sum()
    assert np.angle(mean) % (2 * np.pi) == pytest.approx(2 * np.pi * (10 / 64 + 0.25), abs=1e-6)
    assert np.abs(mean) == pytest.approx(0.999 * np.exp(-2 * (np.pi * 0.0225) ** 2), rel=1e-3)
    np.testing.assert_allclose(fields.expect(None), 1 / 64)


def test_a_known_order_is_not_found_and_a_locked_start_stays():
    fields = ColorFields(0.5, shown=THIRDS, start=0.2)
    assert fields.expect(None).tolist() == [1.0]
    assert fields.found_order(np.ones(1), 600) is None
    unknown = ColorFields(0.5, row=0.002)
    assert unknown.found_order(unknown.expect(None), 600) is None
    assert unknown.found_order(np.repeat([0.0, 1 / 64], 64), 600) == "RBG"
    assert unknown.found_order(np.repeat([0.0, 1 / 64], 64), 100) is None
