"""A simulated board's captures, against the corners that the rig projects."""

import cv2
import numpy as np
import pytest
from support.posed_boards import CHESSBOARD, PROJECTOR_PX, SEQUENCE, codes, rig

from pipeline.calibration.multishot import BLACK, WHITE
from pipeline.calibration.simulated_board import BoardCaptures, BoardView, CaptureLight, _seen_by, board_turns


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


def test_a_lens_sees_points_where_opencv_says():
    lens = rig().geometry().projector
    points = np.random.default_rng(0).uniform((-200, -150, 800), (200, 150, 1000), (50, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion)
    np.testing.assert_allclose(_seen_by(lens, points), expected[:, 0], atol=1e-3)


def test_a_bent_boards_edges_are_farther_away():
    flat, bent = (
        BoardView(rig(), CHESSBOARD, (0.0, 0.0, 0.0), (0, 0, 900), CaptureLight(noise=0.0), bow_mm=bow_mm)
        for bow_mm in (0.0, 30.0)
    )
    widths = []
    for view in (flat, bent):
        white = view.photograph(codes(WHITE), np.random.default_rng(0))
        _, corners = CHESSBOARD.find(white.mean(axis=-1) / 255)
        widths.append(np.ptp(corners[:, 0]))
    # An edge 30 mm farther than 900 mm is seen smaller by 30/930, its outermost corners, at 0.8 of it, by 0.64 of that.
    assert widths[1] / widths[0] == pytest.approx(1 - 0.64 * 30 / 930, abs=2e-3)
