"""What makes contrasts and phases differ from channel to channel: fits that are told apart by how well they do."""

import numpy as np
import pytest

from pipeline.diagnosis.channel_spectra import PHASES, Tiles
from pipeline.diagnosis.ripple_causes import decide, explain_fundamental, ideal
from pipeline.simulation import TYPICAL_CROSSTALK

#: The sum of each row is one, as the balance makes it.
MIXING = np.array(TYPICAL_CROSSTALK) / np.sum(TYPICAL_CROSSTALK, axis=1, keepdims=True)


def tiles_of(fundamental, frequency=0.5):
    """Return tiles of a picture, 12 x 16 of them, with these fundamentals (3,) or (T, 3) and a little noise."""
    rng = np.random.default_rng(3)
    place = np.argwhere(np.ones((12, 16)))
    count = len(place)
    spectrum = np.broadcast_to(fundamental, (count, 3)) * (1 + 1e-3 * rng.standard_normal((count, 3)))
    mean = np.broadcast_to([0.3, 0.4, 0.5], (count, 3)) + 0.1 * rng.random((count, 1))
    across = (place[:, 0] - 5.5) / 10
    frequency = frequency * (1 + 0.2 * rng.random(count))
    none = np.empty((count, 3, 1, 0), complex)
    return Tiles(mean, spectrum[..., None], np.full(count, 1e-3), frequency, place, across, np.ones(count), none)


def explained(fundamental, matrix=None, lag=(0.0, 0.0, 0.0)):
    matrix = np.eye(3) if matrix is None else matrix
    tiles = tiles_of(fundamental)
    expected = np.broadcast_to(ideal(matrix, np.exp(-1j * np.array(lag))), (len(tiles.mean), 3))
    return explain_fundamental(tiles, expected, matrix, 0.005)


def test_a_rig_that_is_as_it_is_known_to_be():
    assert explained(0.5 * ideal(np.eye(3))) == []
    assert explained(0.5 * ideal(MIXING), MIXING) == []
    assert explained(0.5 * np.exp(1j * (PHASES - [0.1, 0, -0.1])), lag=(0.1, 0.0, -0.1)) == []


def test_one_channel_with_less_contrast():
    (finding,) = explained(0.5 * np.array([1, 0.8, 1]) * np.exp(1j * PHASES))
    assert "projector amplitude" in finding.causes and "G's modulation -20" in finding.size
    assert finding.ripple_rad[2] == pytest.approx(0.2 / 3 / (1 - 0.2 / 3), rel=0.1)


def test_crosstalk_changes_contrasts_and_phases_together():
    (finding,) = explained(0.5 * ideal(MIXING))
    assert finding.causes == ("crosstalk",)


def test_a_lag_that_is_the_same_everywhere_is_the_projectors():
    (finding,) = explained(0.5 * np.exp(1j * (PHASES + np.array([0.1, 0, 0.05]))))
    assert finding.causes == ("lateral colour of the projector",)
    assert "R +0.100 rad, B +0.050 rad from G" in finding.size


def test_what_moves_in_a_part_is_found_beside_crosstalk():
    """A lag of 0.3 rad a field in a third of the picture, which no matrix makes of a third alone."""
    place = np.argwhere(np.ones((12, 16)))
    lag = np.where(place[:, 1:] < 5, [0.3, 0, -0.3], 0.0)
    crosstalk, motion = sorted(explained(0.5 * ideal(MIXING) * np.exp(1j * lag)), key=lambda finding: finding.causes)
    assert crosstalk.causes == ("crosstalk",)
    assert motion.causes == ("motion between colour fields",) and motion.ripple_rad[2] > 0.1


def test_what_fits_as_well_as_the_best_stays_possible():
    possible, confidence = decide({"this": 1.0, "that": 1.01, "no": 2.0}, count=100.0)
    assert possible == {"this", "that"} and confidence > 0.99
    assert decide({"this": 1.0, "that": 1.01}, 100.0) == ({"this", "that"}, 0.99)
    possible, _ = decide({"this": 1.0, "that": 1.01}, 100.0, {"this": 20.0, "that": 0.0})
    assert possible == {"that"}
