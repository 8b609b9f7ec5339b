"""Photographs of boards before cluttered walls, whose corners are known.

Written apart from the library's renderer and from `pipeline.calibration.simulated_board`: four by four samples a pixel,
in float64.
"""

from dataclasses import dataclass

import cv2
import numpy as np

SAMPLES = 4
# Of a drawn board's squares: a marker of three quarters then has seven modules of six texels.
TEXELS = 56


@dataclass(frozen=True)
class View:
    """What a board is photographed under; a pair is a range to draw from."""

    size_px: tuple = (640, 480)
    square_px: tuple = (14, 60)  # the shortest side of any square
    tilt_deg: tuple = (0, 50)
    blur_px: tuple = (0.3, 1.0)
    noise: tuple = (0.5, 3.0)  # of 255 levels
    unevenness: tuple = (0.0, 0.5)  # the light falls by this part from the brightest place to the darkest
    fringes: tuple = (0.0, 0.0)  # their amplitude over the light
    white: tuple = (60, 230)  # level
    black_part: tuple = (0.04, 0.2)  # what black ink sends back, over white paper
    margin: tuple = (0.3, 1.0)  # white around the squares, over their side
    mounted: bool = False  # on something dark, which covers the margin of any side
    clutter: int = 0  # things on the wall
    bend: float = 0.0  # a lens moves half a width's place outwards by up to this part of it


def photograph(board, view, rng):
    """Return a picture, (H, W, 3) uint8, and where the board's inner corners are in it, (N, 2) px."""
    to_board, corners = _pose(board, view, rng)
    width, height = view.size_px
    place = (np.arange(SAMPLES * max(view.size_px)) + 0.5) / SAMPLES - 0.5
    x, y = np.meshgrid(place[: SAMPLES * width], place[: SAMPLES * height])
    bend = rng.uniform(-view.bend, view.bend)
    straight = _straightened(np.stack([x, y], axis=-1), bend, view)
    on_board = cv2.perspectiveTransform(straight.reshape(-1, 1, 2), to_board).reshape(*x.shape, 2)
    bent = corners
    for _ in range(40):
        bent = bent + corners - _straightened(bent, bend, view)
    u, v = on_board[..., 0], on_board[..., 1]
    light = _light(x / width, y / height, view, rng)
    scene = _wall(view, rng) * light * _fringe(x, y, view, rng)
    columns, rows = board.squares
    left, top, right, bottom = rng.uniform(*view.margin, 4)
    if view.mounted:
        left, top, right, bottom = np.array([left, top, right, bottom]) * rng.integers(0, 2, 4)
        mount = (np.abs(u - columns / 2) < columns / 2 + 1.5) & (np.abs(v - rows / 2) < rows / 2 + 1.5)
        scene[mount] = (0.06 * light)[mount]
    paper = (u > -left) & (u < columns + right) & (v > -top) & (v < rows + bottom)
    drawn = np.pad(board.draw(TEXELS) / 255.0, TEXELS, constant_values=1.0)
    texel = [
        np.clip(TEXELS * (w[paper] + 1), 0, n - 1).astype(int) for w, n in ((u, drawn.shape[1]), (v, drawn.shape[0]))
    ]
    black = rng.uniform(*view.black_part)
    scene[paper] = (black + (1 - black) * drawn[texel[1], texel[0]]) * (light * _fringe(x, y, view, rng))[paper]
    scene = cv2.GaussianBlur(scene, (0, 0), SAMPLES * rng.uniform(*view.blur_px))
    grey = scene.reshape(height, SAMPLES, width, SAMPLES).mean(axis=(1, 3))
    levels = rng.uniform(*view.white) * grey[..., None] * rng.uniform(0.6, 1.0, 3)
    levels += rng.uniform(*view.noise) * rng.standard_normal(levels.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8), bent


def _straightened(places, bend, view):
    """Return where a lens without distortion would show places, px."""
    middle = (np.array(view.size_px) - 1) / 2
    radius2 = ((places - middle) ** 2).sum(axis=-1, keepdims=True) / (view.size_px[0] / 2) ** 2
    return middle + (places - middle) * (1 + bend * radius2)


def wall(view, rng):
    """Return a picture, (H, W, 3) uint8, that shows the wall alone."""
    width, height = view.size_px
    y, x = np.mgrid[: SAMPLES * height, : SAMPLES * width] / SAMPLES
    scene = _wall(view, rng) * _light(x / width, y / height, view, rng) * _fringe(x, y, view, rng)
    grey = cv2.GaussianBlur(scene, (0, 0), SAMPLES * rng.uniform(*view.blur_px))
    grey = grey.reshape(height, SAMPLES, width, SAMPLES).mean(axis=(1, 3))
    levels = rng.uniform(*view.white) * grey[..., None] + rng.uniform(*view.noise) * rng.standard_normal(
        (*grey.shape, 3)
    )
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _pose(board, view, rng):
    """Return the homography from px to squares, from the board's outer corner, and the inner corners, px."""
    width, height = view.size_px
    columns, rows = board.squares
    focal = rng.uniform(1.0, 2.0) * width
    inner = board.corners_mm()[:, :2] / board.square_mm
    grid = np.stack(np.meshgrid(np.arange(columns + 1), np.arange(rows + 1)), axis=-1).astype(float)
    for _ in range(1000):
        tilt, axis, roll = np.radians(rng.uniform(*view.tilt_deg)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
        turn = (
            cv2.Rodrigues(tilt * np.array([np.cos(axis), np.sin(axis), 0]))[0]
            @ cv2.Rodrigues(np.array([0, 0, roll]))[0]
        )
        least = np.exp(rng.uniform(*np.log(view.square_px)))
        middle = np.array([rng.uniform(-0.4, 0.4) * width / focal, rng.uniform(-0.4, 0.4) * height / focal, 1.0])
        camera = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])

        def to_px(distance, middle=middle, turn=turn, camera=camera):
            origin = middle * distance - turn @ np.array([columns / 2, rows / 2, 0])
            return camera @ np.column_stack([turn[:, :2], origin])

        # The distance, in squares, at which the least square has that side.
        distance = focal / least
        for _ in range(4):
            places = cv2.perspectiveTransform(grid.reshape(-1, 1, 2), to_px(distance)).reshape(grid.shape)
            sides = [np.linalg.norm(np.diff(places, axis=k), axis=-1).min() for k in (0, 1)]
            distance *= min(sides) / least
            distance = max(distance, np.hypot(columns, rows))
        places = places.reshape(-1, 2)
        rim = 3 + view.bend * width
        if (places > rim).all() and (places < np.array([width, height]) - 1 - rim).all() and min(sides) > 0.98 * least:
            corners = cv2.perspectiveTransform(inner[:, None], to_px(distance)).reshape(-1, 2)
            return np.linalg.inv(to_px(distance)), corners
    raise ValueError("such a board does not fit into such a picture")


def _light(x, y, view, rng):
    """Return the light on the scene, (H, W), at most 1, from places 0..1; it falls from a place and along a line."""
    middle, angle = rng.uniform(0.2, 0.8, 2), rng.uniform(0, 2 * np.pi)
    fall = np.hypot(x - middle[0], y - middle[1]) + 0.5 * (x * np.cos(angle) + y * np.sin(angle))
    fall = (fall - fall.min()) / np.ptp(fall)
    return 1 - rng.uniform(*view.unevenness) * fall


def _fringe(x, y, view, rng):
    """Return by how much fringes change the light."""
    period, angle, phase = rng.uniform(8, 20), rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
    along = x * np.cos(angle) + y * np.sin(angle)
    return 1 + rng.uniform(*view.fringes) * np.cos(2 * np.pi * along / period + phase)


def _wall(view, rng):
    """Return a wall with things on it, (SAMPLES H, SAMPLES W)."""
    width, height = (SAMPLES * n for n in view.size_px)
    picture = np.full((height, width), rng.integers(25, 230), np.uint8)
    for _ in range(view.clutter):
        kind, level = rng.integers(0, 5), int(rng.integers(8, 255))
        at = rng.uniform(0, 1, 2) * (width, height)
        size = rng.uniform(0.03, 0.3) * width
        if kind == 0:  # a sheet of paper, a box
            turned = cv2.boxPoints((at, (size, size * rng.uniform(0.3, 1)), rng.uniform(0, 180)))
            cv2.fillConvexPoly(picture, turned.astype(int), level)
        elif kind == 1:
            cv2.circle(picture, at.astype(int), int(size / 2), level, -1)
        elif kind == 2:  # a cable, an edge
            cv2.line(
                picture,
                at.astype(int),
                (rng.uniform(0, 1, 2) * (width, height)).astype(int),
                level,
                int(rng.uniform(1, 6) * SAMPLES),
            )
        elif kind == 3:
            cv2.putText(
                picture, "Calibration 4711", at.astype(int), cv2.FONT_HERSHEY_SIMPLEX, size / 300, level, SAMPLES
            )
        else:  # tiles, keys, a grille
            side, angle = rng.uniform(8, 40) * SAMPLES, rng.uniform(0, np.pi)
            steps = np.stack(np.meshgrid(np.arange(6), np.arange(4)), -1).reshape(-1, 2) * side
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            for tile in at + steps @ turn.T:
                corners = cv2.boxPoints((tile, (0.8 * side, 0.8 * side), np.degrees(angle)))
                cv2.fillConvexPoly(picture, corners.astype(int), level)
    return picture / 255.0


def rms_px(board, numbers, places, corners):
    """Return how far found corners lie off the true ones, RMS px; a chessboard may be numbered from any end."""
    columns, rows = board.squares[0] - 1, board.squares[1] - 1
    order = np.arange(columns * rows).reshape(rows, columns)
    orders = [order]
    if board.kind == "chessboard":
        orders += [np.rot90(order, turn) for turn in ((1, 2, 3) if columns == rows else (2,))]
    return min(np.sqrt(((places - corners[o.ravel()[numbers]]) ** 2).sum(axis=1).mean()) for o in orders)
