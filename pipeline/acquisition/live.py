"""Decode while frames are captured: the newest one that there is time for, in a process of its own.

Kernels keep the interpreter to themselves while they run: in the capturing process they would hold up camera and
recorder.
"""

import ctypes
import multiprocessing
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
from pipeline.decoding.frame import DecodedFrame, read_back
from pipeline.errors import DecodeWarning, FootageError, OutputError
from pipeline.models import ImageArray
from pipeline.output.range_image import write_range_image
from pipeline.processes import safe_start
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.errors import ShapeError
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat

# Time that the frame which is just being decoded may take when decoding is closed: several times what one takes, and
# less than a user waits after Ctrl-C. Kernels that are just compiled are given up.
_CLOSE_S = 0.5
# Time that a process takes to end once it has let go of its pipe.
_DIE_S = 0.2
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


class LiveDecoder:
    """Decode frames in a process of its own, of low priority, which ends with this one whatever happens.

    One frame is under way at a time; what is offered meanwhile is not decoded. A script that makes one needs the guard
    ``if __name__ == "__main__"``, as for every process that `multiprocessing` spawns.

    Parameters
    ----------
    settings : DecodeSettings
        How to decode; every frame by itself.
    calibration : Calibration or None
        The rig.
    format : PixelFormat
        How frames come: RGB in one (H, W, 3) plane, or a Bayer mosaic.
    size_px : (width, height)
        Of every frame.
    preview : Path, optional
        A PNG of the range image, written anew a few times a second.
    arch : {"auto", "cpu", "vulkan", "cuda", "metal"}
        Where to compute; a named one never falls back.

    Raises
    ------
    ShapeError
        Such frames cannot be taken.
    """

    def __init__(
        self,
        settings: DecodeSettings,
        calibration: Calibration | None,
        format: PixelFormat,
        size_px: tuple[int, int],
        preview: Path | None = None,
        arch: str = "auto",
    ) -> None:
        if format.layout == "yuv":
            raise ShapeError("live decoding takes RGB in one plane, or a Bayer mosaic")
        (shape,) = format.plane_shapes(size_px[1], size_px[0])
        # An unnamed file: nothing of it stays, whoever is killed.
        context = multiprocessing.get_context("spawn")
        dtype: np.dtype[Any] = np.dtype(format.dtype)
        memory: Any = context.RawArray(ctypes.c_uint8, int(np.prod(shape)) * dtype.itemsize)
        self._slot = np.frombuffer(memory, dtype).reshape(shape)
        self._latest: LiveResult | None = None
        self._ended: str | None = None
        self._idle = False
        self._pipe, theirs = context.Pipe()
        task = LiveTask(settings, calibration, format, size_px, preview, arch)
        self._process = context.Process(
            target=serve_live, args=(theirs, memory, task), name="live decoder", daemon=True
        )
        try:
            with safe_start():
                self._process.start()
        except OSError as error:
            self._ended = f"live decoding could not start: {error.strerror or error}"
            self._pipe.close()
        finally:
            theirs.close()

    def __enter__(self) -> "LiveDecoder":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def ready(self) -> bool:
        """Whether kernels are compiled and no frame is under way: the next one offered is taken."""
        self._listen()
        return self._idle

    def wait(self, most_s: float) -> None:
        """Return when it is ready, has ended, or the time is over."""
        until_s = time.monotonic() + most_s
        while not self.ready and self._ended is None and (left_s := until_s - time.monotonic()) > 0:
            with suppress(OSError):
                self._pipe.poll(left_s)

    @property
    def ended(self) -> str | None:
        """Why no frame is decoded any more, one line; None while frames are."""
        self._listen()
        return self._ended

    def offer(self, frame: ImageArray, number: int, exposed_at_s: float) -> bool:
        """Hand a frame over if there is time for it; never waits.

        Parameters
        ----------
        frame : (H, W, 3) RGB or (H, W) mosaic
            Levels, of the format's type; copied.
        number : int
            By which `latest` names it.
        exposed_at_s : float
            When it was exposed, by `time.monotonic`, which all processes of a machine share.

        Returns
        -------
        bool
            Whether it will be decoded.

        Raises
        ------
        ShapeError
            It has another shape or type.
        """
        if frame.shape != self._slot.shape or frame.dtype != self._slot.dtype:
            expected = f"{self._slot.shape} {self._slot.dtype}"
            raise ShapeError(f"frame has shape {frame.shape} {frame.dtype}, expected {expected}")
        if not self.ready:
            return False
        np.copyto(self._slot, frame)
        try:
            self._pipe.send((number, exposed_at_s))
        except OSError:
            self._note_end()
            return False
        self._idle = False
        return True

    def latest(self) -> LiveResult | None:
        """Return what became of the frame that was decoded last; None: none has been."""
        self._listen()
        return self._latest

    def close(self) -> None:
        """End the process, within a second; a second call does nothing."""
        self._listen()
        if self._ended is None:
            self._ended = "live decoding was closed"
            self._pipe.close()
        self._idle = False
        if self._process.pid is None or self._process.exitcode is not None:
            return
        self._process.join(_CLOSE_S)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join(_DIE_S)

    def _listen(self) -> None:
        """Take what the process has said meanwhile."""
        try:
            while self._ended is None and self._pipe.poll():
                said = self._pipe.recv()
                if isinstance(said, str):
                    self._end(said)
                else:
                    self._idle = True
                    self._latest = said or self._latest
        except (EOFError, OSError):
            self._note_end()

    def _note_end(self) -> None:
        self._process.join(_DIE_S)
        code = self._process.exitcode
        if code is None:
            how = "does not answer any more"
        else:
            how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        self._end(f"its process {how}")

    def _end(self, reason: str) -> None:
        self._ended = f"live decoding has ended: {reason}"
        self._idle = False
        self._pipe.close()


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
        read_back(frame, ("range_image", "phase_sigma"))
