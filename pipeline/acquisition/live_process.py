"""The process in which frames are decoded live: it takes one at a time, until the other end of its pipe is gone."""

import os
import signal
import time
import warnings
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.decoder import Decoder
from pipeline.decoding.frame import DecodedFrame
from pipeline.errors import DecodeWarning, FootageError, OutputError
from pipeline.output.range_image import write_range_image
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat

# The process's niceness, the highest: it takes what the capturing process, which has none, leaves of the cores.
_NICENESS = 19
# Between two previews, s: nobody looks at more of them.
_PREVIEW_S = 0.3
# Camera px a cycle of the fringe by which kernels are compiled where the settings name none.
_WARM_PERIOD_PX = 12.0


@dataclass(frozen=True)
class LiveResult:
    """What became of one frame."""

    number: int
    latency_s: float  # from the exposure to the finished range image
    measured: float  # pixels that hold a value, 0..1 of all
    phase_sigma: float  # rad, the median pixel's; NaN where none is measured
    warnings: tuple[str, ...]  # what the user should know of it, a sentence each


@dataclass(frozen=True)
class LiveTask:
    """What the process is told when it starts."""

    settings: DecodeSettings
    calibration: Calibration | None
    format: PixelFormat
    size_px: tuple[int, int]
    preview: Path | None
    arch: str


def serve_live(pipe: Connection, memory: Any, task: LiveTask) -> None:
    """Decode what comes, in the process that does nothing else, until the other end is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the capturing process decides when to end
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    warnings.simplefilter("ignore", DecodeWarning)  # frames tell
    try:
        worker = _LiveWorker(memory, task)
        pipe.send(None)
        while True:
            number, exposed_at_s = pipe.recv()
            pipe.send(worker.decode(number, exposed_at_s))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except Exception as error:
        with suppress(OSError):
            pipe.send(" ".join(str(error).split()) or type(error).__name__)


class _LiveWorker:
    def __init__(self, memory: Any, task: LiveTask) -> None:
        self._task = task
        (shape,) = task.format.plane_shapes(task.size_px[1], task.size_px[0])
        self._slot = np.frombuffer(memory, task.format.dtype).reshape(shape)
        self._decoder = Decoder(task.settings, task.calibration, arch=task.arch)
        self._image = runtime.empty((*shape[:2], 3), task.format.rgb_dtype)
        self._frame: DecodedFrame | None = None
        self._previewed_s = -np.inf
        self._warm_up()

    def decode(self, number: int, exposed_at_s: float) -> LiveResult:
        try:
            frame = self._frame = self._decoder.decode(self._develop(self._slot), out=self._frame)
        except FootageError as error:
            return LiveResult(number, time.monotonic() - exposed_at_s, 0.0, np.nan, (str(error),))
        range_image = frame.range_image  # synchronises
        latency_s = time.monotonic() - exposed_at_s
        mask = frame.mask & np.isfinite(range_image)
        sigma = float(np.median(frame.phase_sigma[mask])) if mask.any() else np.nan
        return LiveResult(number, latency_s, float(mask.mean()), sigma, frame.warnings + self._preview(frame))

    def _develop(self, levels: npt.NDArray[Any]) -> Any:
        return develop((levels,), self._task.format, stripes=self._task.settings.stripes, out=self._image)

    def _preview(self, frame: DecodedFrame) -> tuple[str, ...]:
        if self._task.preview is None or time.monotonic() - self._previewed_s < _PREVIEW_S:
            return ()
        self._previewed_s = time.monotonic()
        try:
            write_range_image(self._task.preview, frame.range_image, frame.mask, "mm" if frame.calibrated else "rad")
        except OutputError as error:
            return (str(error),)
        return ()

    def _warm_up(self) -> None:
        """Compile the kernels, by a plane's fringe, so that the first frame takes no longer than others."""
        format, settings = self._task.format, self._task.settings
        place = np.indices(self._slot.shape[:2])[int(settings.stripes == "vertical")]
        period_px = settings.camera_period_px or _WARM_PERIOD_PX
        phase = 2 * np.pi * place[..., None] / period_px + np.array([-1, 0, 1]) * 2 * np.pi / 3
        fringe = 0.5 + 0.4 * np.cos(phase) + np.random.default_rng(0).normal(0, 0.01, phase.shape)
        if format.layout == "bayer":
            colors = np.array(["rgb".index(color) for color in format.bayer]).reshape(2, 2)
            rows, columns = np.indices(self._slot.shape)
            fringe = fringe[rows, columns, colors[rows % 2, columns % 2]]
        # With a decoder of its own: the first frame is to tell the light.
        decoder = Decoder(settings, self._task.calibration, arch=self._task.arch)
        frame = decoder.decode(self._develop((fringe * format.white_level).astype(format.dtype)))
        frame.fetch(("range_image", "phase_sigma"))
