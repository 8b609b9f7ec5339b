"""A slide show as a free-running camera films it: pictures in several frames, mixed frames between them, and noise."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.footage.footage import BadFrame, Footage, StoredFrame
from tikernels.raw.pixel_format import PixelFormat

Picture = npt.NDArray[np.float64]


class InMemory(Footage):
    """Frames of a list; None stands for a damaged one."""

    sensor = transfer = None

    def __init__(self, images, format=None, name="film"):
        self.name, self._images, self.format = name, images, format or PixelFormat("rgb")

    def __len__(self):
        return len(self._images)

    @property
    def size_px(self):
        """Width and height of the first good image."""
        return next(image.shape[1::-1] for image in self._images if image is not None)

    def files(self):
        """Return none: they are in memory."""
        return []

    def frames(self, start=0, stop=None, step=1):
        """Yield frames by number."""
        for number in range(len(self))[start:stop:step]:
            image = self._images[number]
            if image is None:
                yield BadFrame(number, "it is damaged")
            else:
                yield StoredFrame(number, (image,), self.format)


def film(
    pictures: Sequence[Picture],
    seed: int,
    *,
    dwell: tuple[float, float] = (4.0, 8.0),
    exposure: float = 0.8,
    readout: float = 0.6,
    noise: float = 1.0,
    shot: float = 0.0,
    drift: float = 0.0,
    spoil: Callable[[npt.NDArray[np.uint8]], npt.NDArray[np.uint8]] | None = None,
) -> tuple[list[npt.NDArray[np.uint8]], list[int]]:
    """Return 8-bit frames of pictures that are shown one after another, and which picture each shows alone; -1: none.

    Parameters
    ----------
    pictures : sequence of (H, W, 3)
        Light without noise, of 255 levels.
    seed : int
        Of everything random.
    dwell : (float, float)
        The least and the greatest time that a picture is shown, in the camera's frames.
    exposure, readout : float
        Of each row, and from the first row's start to the last one's, in frames. Rows that see two pictures mix them.
    noise, shot : float
        Standard deviation of a pixel, of 255 levels: everywhere, and what is added at full scale by the light's own.
    drift : float
        By which part all light changes from frame to frame, at random.
    spoil : callable
        What a codec makes of a frame.
    """
    rng = np.random.default_rng(seed)
    ends = np.cumsum(rng.uniform(*dwell, len(pictures)))
    frames, alone = [], []
    for number in range(int(ends[-1])):
        begin = number + readout * np.linspace(0, 1, len(pictures[0]))[:, None, None]
        light = np.zeros(pictures[0].shape)
        alone.append(-1)
        for which, (picture, start, end) in enumerate(zip(pictures, [0, *ends], [*ends[:-1], np.inf], strict=False)):
            share = np.clip((np.minimum(begin + exposure, end) - np.maximum(begin, start)) / exposure, 0, 1)
            if share.any():
                light += share * picture
            if share.min() > 1 - 1e-9:
                alone[-1] = which
        light *= 1 + drift * rng.standard_normal()
        sigma = np.sqrt(noise**2 + shot**2 * np.clip(light, 0, 255) / 255)
        levels = light + sigma * rng.standard_normal(light.shape, dtype=np.float32)
        image = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
        frames.append(image if spoil is None else spoil(image))
    return frames, alone


def as_jpeg(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return what a webcam's JPEG, with subsampled colours, makes of a frame."""
    data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
