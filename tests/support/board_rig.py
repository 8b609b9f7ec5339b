"""Pictures of a flat board under any pattern, by tracing camera rays to its plane: a rig for calibration to measure.

Written apart from the library's renderer: NumPy and OpenCV alone, in float64.
"""

from collections.abc import Mapping

import cv2
import numpy as np

from pipeline.calibration import Calibration
from pipeline.calibration.board import Board


class BoardCaptures(Mapping):
    """The captures of one pose, rendered when they are asked for.

    The board lies at `place_mm` (its middle), turned by the rotation vector; its white reflects 0.8, its black 0.05.
    """

    def __init__(
        self, rig: Calibration, board: Board, turn, place_mm, names, codes, *, gamma=2.0, noise=1.0, seed=0,
        samples=3, mirror=False, hide=None, camera_shift=None, projector_shift=None, crosstalk=None, blur_px=0.0,
    ):  # fmt: skip
        self.names, self.codes = names, codes
        self.gamma, self.noise, self.seed, self.mirror, self.blur_px = gamma, noise, seed, mirror, blur_px
        self.crosstalk = np.eye(3) if crosstalk is None else np.asarray(crosstalk)
        self.camera_shift = np.zeros((3, 2)) if camera_shift is None else np.asarray(camera_shift, float)
        self.projector_shift = np.zeros((3, 2)) if projector_shift is None else np.asarray(projector_shift, float)
        self.samples = samples
        geometry = rig.geometry()
        self.size = geometry.camera.size_px
        pixels_per_square = 80
        picture = board.draw(pixels_per_square).astype(np.float32) / 255
        if hide is not None:
            picture[hide] = 0
        margin = pixels_per_square
        self.texture = 0.05 + 0.75 * np.pad(picture, margin, constant_values=1.0)
        scale = pixels_per_square / board.square_mm
        rotation = cv2.Rodrigues(np.asarray(turn, float))[0]
        middle = np.array([*board.squares, 0]) / 2 * board.square_mm
        origin = np.asarray(place_mm, float) - rotation @ middle
        self.corners_camera = board.corners_mm() @ rotation.T + origin
        self._pictures = {}
        self.views = {}
        for shift in {tuple(row) for row in self.camera_shift}:
            self.views[shift] = self._look(geometry, rotation, origin, scale, margin, np.array(shift))

    def _look(self, geometry, rotation, origin, scale, margin, shift):
        width, height = self.size
        step = (np.arange(self.samples) + 0.5) / self.samples - 0.5
        x = (np.arange(width)[:, None] + step).ravel()
        y = (np.arange(height)[:, None] + step).ravel()
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2) - shift
        lens = geometry.camera
        rays = cv2.undistortPoints(
            grid, lens.matrix, lens.distortion, criteria=(cv2.TERM_CRITERIA_COUNT, 20, 1e-12)
        ).reshape(-1, 2)
        rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        normal = rotation[:, 2]
        points = rays * ((origin @ normal) / (rays @ normal))[:, None]
        on_board = (points - origin) @ rotation
        shape = (len(y), len(x))
        place = (on_board[:, :2] * scale + margin - 0.5).astype(np.float32).reshape(*shape, 2)
        reflectance = cv2.remap(
            self.texture, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )
        projector, _ = cv2.projectPoints(
            points, cv2.Rodrigues(geometry.rotation)[0], geometry.translation_mm, geometry.projector.matrix,
            geometry.projector.distortion,
        )  # fmt: skip
        return reflectance, projector.reshape(*shape, 2).astype(np.float32)

    def __getitem__(self, name):
        if name not in self._pictures:
            self._pictures[name] = self._photograph(name)
        return self._pictures[name]

    def _photograph(self, name):
        codes = self.codes(name)
        is_grey = codes.strides[2] == 0  # one plane, broadcast to three
        planes = [np.power(codes[..., k], self.gamma, dtype=np.float32) for k in range(1 if is_grey else 3)]
        width, height = self.size
        channels = np.zeros((height, width, 3), np.float32)
        landed = {}  # the light of a plane where a channel of the camera looks
        for i in range(3):
            place = tuple(self.camera_shift[i])
            reflectance, position = self.views[place]
            for k in range(3):
                if self.crosstalk[i, k] == 0:
                    continue
                # A channel whose light lands beside its place shows there what belongs elsewhere.
                beside = tuple(self.projector_shift[k])
                plane = 0 if is_grey else k
                if (place, beside, plane) not in landed:
                    at = position - np.array(beside, np.float32)
                    light = cv2.remap(planes[plane], at[..., 0], at[..., 1], cv2.INTER_LINEAR)
                    landed[place, beside, plane] = self._averaged(reflectance * light)
                channels[..., i] += np.float32(self.crosstalk[i, k]) * landed[place, beside, plane]
            channels[..., i] += 0.02 * self._averaged(reflectance)
        if self.blur_px:
            channels = cv2.GaussianBlur(channels, (0, 0), self.blur_px)
        rng = np.random.default_rng([self.seed, list(self.names).index(name)])
        levels = 255 * channels + self.noise * rng.standard_normal(channels.shape, dtype=np.float32)
        picture = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
        return np.ascontiguousarray(picture[:, ::-1]) if self.mirror else picture

    def _averaged(self, fine):
        """Return the mean of each pixel's samples."""
        width, height = self.size
        return cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)

    def __iter__(self):
        return iter(self.names)

    def __len__(self):
        return len(self.names)


def board_turns(count=10, seed=1):
    """Rotation vectors of boards tilted by 15 to 35 degrees every way, and places around (0, 0, 900) mm."""
    rng = np.random.default_rng(seed)
    around = 2 * np.pi * (np.arange(count) + 0.3) / count
    tilt = np.radians(rng.uniform(15, 35, count))
    turns = [
        cv2.Rodrigues(
            cv2.Rodrigues(t * np.array([np.cos(a), np.sin(a), 0.0]))[0] @ cv2.Rodrigues(np.array([0, 0, s]))[0]
        )[0].ravel()
        for a, t, s in zip(around, tilt, rng.uniform(-0.2, 0.2, count), strict=True)
    ]
    places = np.stack([rng.uniform(-25, 25, count), rng.uniform(-20, 20, count), rng.uniform(840, 960, count)], axis=1)
    return turns, places
