"""A simulated board's captures, against the corners that the rig projects."""

import numpy as np
from support.posed_boards import CHESSBOARD, PROJECTOR_PX, SEQUENCE, codes, rig

from pipeline.calibration.multishot import BLACK, WHITE
from pipeline.calibration.simulated_board import BoardCaptures, CaptureLight, board_turns


def captures(**light):
    return BoardCaptures(
        rig(), CHESSBOARD, (0.2, 0.1, 0.0), (0, 0, 900), SEQUENCE.names, codes, CaptureLight(noise=0.0, **light)
    )


def test_paper_sends_back_what_the_projector_and_the_room_shine_on_it():
    """White ink reflects 0.8 of the projector's light and of two hundredths of it beside."""
    seen = captures()
    assert abs(int(seen[WHITE].max()) - 255 * 0.8 * 1.02) <= 1
    assert abs(int(seen[BLACK].max()) - 255 * 0.8 * 0.02) <= 1
    assert list(seen) == list(SEQUENCE.names) and len(seen) == 12


def test_crosstalk_mixes_the_projectors_primaries():
    mixed = captures(crosstalk=np.array([[0.5, 0.0, 0.0], [0.0, 0.6, 0.2], [0.0, 0.0, 1.0]]))[WHITE]
    top = mixed.reshape(-1, 3).max(axis=0)
    np.testing.assert_allclose(top, 255 * 0.8 * (np.array([0.5, 0.8, 1.0]) + 0.02), atol=1)


def test_poses_are_tilted_every_way_by_15_to_35_degrees():
    turns, places = board_turns(10, 4)
    tilts = [np.degrees(np.arccos(1 - (t[:2] @ t[:2]) / (t @ t) * (1 - np.cos(np.linalg.norm(t))))) for t in turns]
    assert 15 <= min(tilts) and max(tilts) <= 35
    assert ((places[:, 2] >= 840) & (places[:, 2] <= 960)).all()
    assert np.abs(np.mean([turn[:2] / np.linalg.norm(turn[:2]) for turn in turns], axis=0)).max() < 0.3


def test_the_projector_has_its_own_size():
    assert codes(WHITE).shape == (PROJECTOR_PX[1], PROJECTOR_PX[0], 3)
