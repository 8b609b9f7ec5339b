"""Predict how far off a calibration leaves depth, before a board is shown.

The covariance of both lenses and of the step between them is the inverse of the bundle adjustment's normal matrix
(`pipeline/calibration/bundle_adjustment.py`), which follows from the places of a board's corners and from their noise
alone. So it is known for a rig without a fault and for boards that are held as they should be; `depth_bias_mm` makes a
standard deviation of depth from it.

**Noise of corners.** A corner's place in the projector is found through the homography between the two pictures around
it, so its error in the camera appears there times the projector px per camera px. The decoded places add the noise of
their phase, which the homography averages: in the middle of a disc of N pixels a surface of second order has the
variance 4 / N of a pixel's. It is a few per cent of the other, which is why more pictures hardly improve a calibration.
"""

from math import hypot, inf, pi, sqrt
from typing import Literal

import cv2
import numpy as np

from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import BoardPose
from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.calibration.lens import Lens
from pipeline.calibration.model import Geometry
from pipeline.calibration.multishot import FINE_PX, fringe_groups, multishot_sequence
from pipeline.calibration.simulated_board import board_turns
from pipeline.calibration.verdict import depth_bias_mm
from pipeline.models import FloatArray
from pipeline.planning.rig_choice import RigChoice, SeenFields

#: What is predicted for: ten poses of these pictures, as on the pages on calibration.
POSES = 10
PICTURES = len(multishot_sequence((1024, 768)).names)
# Standard deviation of a corner's coordinate in the camera, px: what fits of drawn rigs find of a chessboard's corners
# (`tests/benchmarks/calibration_accuracy.py`), and 1.7 times that of a ChArUco board's, as in `docs/calibration.md`.
_CORNER_PX = {"chessboard": 0.021, "charuco": 0.036}
# The distance, mm, that the poses of `board_turns` are made for.
_TURNS_MM = 900.0
# Boards that fill 0.7 of the field's sides are moved by this part of them to every side, and stay in it when tilted.
_ASIDE = 0.08
# The turn, rad, from one move to the next, which spreads any number of them evenly: the golden angle.
_GOLDEN = 2.4
# The disc of a corner's homography, as part of a square's side, of which half is white (`board_poses.py`).
_DISC = 0.9
# A larger part of the distance is no prediction: the camera's picture then reaches beyond what the projector faces.
_MOST = 0.05


def expected_bias_mm(
    geometry: Geometry,
    board: Board,
    turns: list[FloatArray],
    places_mm: FloatArray,
    corner_sigma_px: tuple[float, float],
    depth_mm: float,
) -> float:
    """Return the standard deviation of depth that a calibration from these poses leaves, RMS over the picture, mm.

    It is infinite where a corner lies behind camera or projector.

    Parameters
    ----------
    geometry : Geometry
        The rig's.
    board : Board
        The board.
    turns : list of (3,)
        Each pose's rotation vector.
    places_mm : (poses, 3)
        The middle of the board in each, in the camera's frame.
    corner_sigma_px : (camera, projector)
        Standard deviations of a corner's coordinate, px.
    depth_mm : float
        Depth of the object.
    """
    corners = board.corners_mm()
    corners = corners - corners.mean(axis=0)
    points = np.concatenate(
        [corners @ cv2.Rodrigues(turn)[0].T + place for turn, place in zip(turns, places_mm, strict=True)]
    )
    in_projector = points @ geometry.rotation.T + geometry.translation_mm
    if min(points[:, 2].min(), in_projector[:, 2].min()) <= 0:
        return inf
    # The covariance does not depend on where corners were measured.
    nowhere, nothing = np.zeros((len(corners), 2)), np.zeros((3, 2))
    poses = [BoardPose(f"pose {k}", corners, nowhere, nowhere, nothing, nothing, np.eye(2)) for k in range(len(turns))]
    rig = [
        *_values(geometry.camera),
        *_values(geometry.projector),
        *cv2.Rodrigues(geometry.rotation)[0].ravel(),
        *geometry.translation_mm,
    ]
    stands = [np.concatenate([turn, place]) for turn, place in zip(turns, places_mm, strict=True)]
    sizes = geometry.camera.size_px, geometry.projector.size_px
    fit = BundleAdjustment(poses, *sizes, np.concatenate([rig, *stands]))
    fit.sigma_px = np.array(corner_sigma_px)
    return depth_bias_mm(fit.parameters[:24], fit.covariance(), sizes[0], geometry.phase_axis, depth_mm)


def _values(lens: Lens) -> FloatArray:
    return np.array([*lens.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *lens.distortion])


def planned_bias_mm(choice: RigChoice, fields: SeenFields, board: Board, poses: int = POSES) -> float:
    """Return the standard deviation of depth that calibrating a planned rig leaves; infinite if it cannot be predicted.

    Parameters
    ----------
    choice : RigChoice
        The rig.
    fields : SeenFields
        Its fields.
    board : Board
        The board, tilted by 15 to 35 degrees every way about the object's place.
    poses : int
        Number of poses.
    """
    turns, places = board_turns(poses)
    around = _GOLDEN * np.arange(poses)
    places[:, 0] = _ASIDE * fields.overlap_mm[0] * np.cos(around)
    places[:, 1] = _ASIDE * fields.overlap_mm[1] * np.sin(around)
    places[:, 2] *= choice.distance_mm / _TURNS_MM
    # The covariance does not depend on the pattern's period.
    geometry = choice.calibration(choice.projector_px[choice.phase_axis]).geometry()
    sigma_px = corner_sigma_px(choice, board.kind, board.square_mm / fields.mm_per_px)
    with np.errstate(invalid="ignore"):  # the root of a variance of points that the projector cannot face
        bias_mm = expected_bias_mm(geometry, board, turns, places, sigma_px, choice.distance_mm)
    return bias_mm if bias_mm < _MOST * choice.distance_mm else inf


def corner_sigma_px(choice: RigChoice, kind: Literal["chessboard", "charuco"], square_px: float) -> tuple[float, float]:
    """Return the standard deviation of a corner's coordinate in camera and projector, px.

    Parameters
    ----------
    choice : RigChoice
        The rig, whose brightness is that of the board's white.
    kind : {"chessboard", "charuco"}
        The board's.
    square_px : float
        The side of its squares in the camera's picture.
    """
    camera_px = _CORNER_PX[kind]
    amplitude = 0.5 * choice.contrast * choice.brightness * 255
    # Of the sum of three channels, over the steps of a sinusoid.
    phase_rad = sqrt(2 / len(fringe_groups()[0])) * choice.noise_levels / sqrt(3) / amplitude
    pixels = 0.5 * pi * (_DISC * square_px) ** 2
    decoded_px = phase_rad * FINE_PX / (2 * pi) * sqrt(4 / pixels)
    return camera_px, hypot(camera_px * choice.projector_focal_px / choice.camera_focal_px, decoded_px)
