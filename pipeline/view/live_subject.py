"""The live subject of the viewer: the newest decoded frame of a rig, its exposure, contrast and sharpness."""

import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.acquisition.live import LiveFrame, WatchedFrame
from pipeline.errors import FootageError
from pipeline.models import ImageArray
from pipeline.view.message import ViewedFrame
from pipeline.view.subjects import Subject, as_bytes
from tikernels.raw.pixel_format import PixelFormat

# Interval at which a newer frame is looked for, s: little compared with the time per frame.
_POLL_S = 0.004
# Bins of a histogram, and the step between the pixels that are counted.
_BARS, _EVERY = 64, 4
# Side of the blocks that contain whole fringes, in px of the subsampled picture; blocks darker than this share of full
# scale are not lit.
_BLOCK, _DARK = 8, 0.04


class LiveSubject(Subject):
    """A running capture.

    Parameters
    ----------
    title : str
        Title of the page.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self._watched: WatchedFrame | None = None
        self._n_rejected = 0
        self._images: dict[int, tuple[ImageArray, float | None]] = {}  # of the last two frames that were offered
        self._started = threading.Event()

    def hear(self, watched: WatchedFrame, n_rejected: int) -> None:
        """Note the state of the capture; called after every burst."""
        if watched.image is not None and watched.number not in self._images:
            newest = {watched.number: (watched.image, watched.temperature_c)}
            self._images = dict([*self._images.items()][-1:]) | newest
        self._watched, self._n_rejected = watched, n_rejected
        self._started.set()

    def about(self) -> dict[str, Any]:
        """See `Subject`."""
        newest = self._newest(0.0)
        if newest is None:
            raise FootageError("waiting for the first frame: compiling kernels takes up to a minute at the first start")
        height, width = newest.mask.shape
        unit = newest.range_unit
        maps = {name: {"unit": unit, "kind": "number"} for name in ("depth", "sigma")}
        maps["mask"] = {"unit": "", "kind": "number"}
        return self._describe(maps, count=1, size_px=(width, height), camera=True, live=True)

    def frame(self, place: int, names: Sequence[str]) -> ViewedFrame:
        """See `Subject`."""
        newest = self._newest(0.0)
        if newest is None:
            raise FootageError("no frame has been decoded yet")
        return self._viewed(newest, names)

    def next(self, after: int, names: Sequence[str], most_s: float) -> ViewedFrame | None:
        """See `Subject`."""
        newest = self._newest(most_s, after)
        return None if newest is None else self._viewed(newest, names)

    def _newest(self, most_s: float, after: int = -1) -> LiveFrame | None:
        """Return the newest frame once its number exceeds `after`; None: it did not come in time."""
        until_s = time.monotonic() + most_s
        self._started.wait(most_s)
        while self._watched is not None:
            decoder = self._watched.decoder
            if (frame := decoder.latest()) is not None and frame.number > after:
                return frame
            if (reason := decoder.ended) is not None:
                raise FootageError(reason)
            if time.monotonic() >= until_s:
                break
            time.sleep(_POLL_S)
        return None

    def _viewed(self, frame: LiveFrame, names: Sequence[str]) -> ViewedFrame:
        arrays: dict[str, npt.NDArray[Any]] = {"sigma": frame.sigma, "mask": frame.mask}
        if frame.points is None:
            arrays["depth"] = frame.range_image
        else:
            arrays["points"] = frame.points
        arrays = {name: values for name, values in arrays.items() if name in names or name == "depth"}
        watched, (image, temperature_c) = self._watched, self._images.get(frame.number, (None, None))
        parts = [f"{1000 * frame.latency_s:.0f} ms from exposure to surface"]
        more: dict[str, Any] = {"exposed_at_s": frame.exposed_at_s}
        if image is not None and watched is not None:
            levels, white = _rgb_levels(image, watched.format), watched.format.white_level * 2**watched.format.shift
            arrays["picture"] = as_bytes(levels, linear=True, white=white)
            small = levels[::_EVERY, ::_EVERY] * np.float32(1 / white)
            more["histogram"] = [np.histogram(small[..., i], _BARS, (0, 1))[0].tolist() for i in range(3)]
            parts.append(_in_words(small, levels[:, ::_EVERY] * np.float32(1 / white)))
        if temperature_c is not None:
            parts.append(f"camera {temperature_c:.1f} °C")
        if self._n_rejected:
            parts.append(f"{self._n_rejected} bursts thrown away")
        more["status"] = ", ".join(parts)
        return ViewedFrame(arrays, frame.number, warnings=frame.warnings, more=more)


def _rgb_levels(image: ImageArray, format: PixelFormat) -> ImageArray:
    """Return a camera's frame as RGB, (H, W, 3), in its levels; the four pixels of a mosaic's cell share a colour."""
    if format.layout == "rgb":
        order = [format.channels.index(color) for color in "rgb"]
        return image if order == [0, 1, 2] == [*range(image.shape[2])] else image[..., order]
    height, width = image.shape
    cells = image[: height // 2 * 2, : width // 2 * 2]
    found = np.empty((height, width, 3), image.dtype)
    for channel, color in enumerate("rgb"):
        row, column = divmod(format.bayer.index(color), 2)  # of two greens the first
        large = cells[row::2, column::2].repeat(2, axis=0).repeat(2, axis=1)
        found[..., channel] = np.pad(large, ((0, height % 2), (0, width % 2)), "edge")
    return found


def _in_words(picture: npt.NDArray[np.float32], columns: npt.NDArray[np.float32]) -> str:
    """Describe fringe contrast, sharpness (mean step from row to row) and the share of clipped pixels."""
    height, width = (side // _BLOCK * _BLOCK for side in picture.shape[:2])
    blocks = picture[:height, :width].reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK, 3)
    means, spreads = blocks.mean(axis=(1, 3)), blocks.std(axis=(1, 3))
    lit = means > _DARK
    clipped = float((picture >= 1).any(axis=-1).mean())
    if not lit.any():
        return "nothing is lit"
    contrast = np.sqrt(2) * np.median(spreads[lit] / means[lit])
    steps = np.abs(np.diff(columns, axis=0)).mean() / columns.mean()
    return f"contrast {contrast:.0%}, sharpness {steps:.1%}, clipped {clipped:.1%}"
