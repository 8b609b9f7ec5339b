"""Decode the newest frame while others are captured, in a process of its own.

Kernels hold the interpreter while they run: in the capturing process they would delay camera and recorder.
"""

import ctypes
import multiprocessing
import os
import signal
import threading
import time
import warnings
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from hardware.rig import PairedFrame
from pipeline.calibration import Calibration
from pipeline.decoder import Decoder
from pipeline.decoding.frame import DecodedFrame
from pipeline.errors import DecodeWarning, FootageError
from pipeline.models import ImageArray
from pipeline.processes import safe_start
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.errors import ShapeError
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat

# The time that the frame being decoded may still take when decoding is closed: several times a frame's, and less than
# a user waits after Ctrl-C. Compiling kernels is given up.
_CLOSE_S = 0.5
# The time that a process takes to end once it has closed its pipe.
_DIE_S = 0.2
# The longest sleep while waiting: another thread may take the message that would have ended it.
_POLL_S = 0.05
# The highest niceness: the process takes the time of the cores that the capturing process, which has none, leaves.
_NICENESS = 19
# Camera px per cycle of the fringe by which kernels are compiled where the settings name none.
_WARM_PERIOD_PX = 12.0
# The few ranges beyond these percentiles are mostly wrong.
_RANGE_PERCENTILES = (1, 99)

RGB8 = PixelFormat("rgb")


@dataclass(frozen=True, eq=False, repr=False)
class LiveFrame:
    """A frame that was decoded live. Its arrays are the caller's own: later frames do not change them.

    Attributes
    ----------
    number : int
        The number under which it was offered.
    exposed_at_s : float
        Time of its exposure, by `time.monotonic`.
    latency_s : float
        Time from the exposure until all arrays were there.
    warnings : tuple of str
        Warnings for the user, one sentence each; of a frame that cannot be decoded, why.
    range_unit : {"mm", "rad"}
        Unit of `range_image` and `sigma`: mm with a calibrated geometry.
    range_image : (H, W) float32
        Depth in mm, or relative range in rad, see `DecodedFrame.range_image`; larger is farther; NaN outside the mask.
    sigma : (H, W) float32
        One standard deviation: `DecodedFrame.point_sigma` in mm, or `DecodedFrame.phase_sigma` in rad.
    mask : (H, W) bool
        Valid pixels: lit, with fringe contrast, not straddling two surfaces.
    points : (H, W, 3) float32 or None
        Place in the camera's frame in mm (x right, y down, z forward); NaN outside the mask. None without a calibrated
        geometry.
    texture : (H, W, 3) uint8 or None
        The surface's colour without fringes, sRGB. None unless the decoder was set to give it.

    Examples
    --------
    >>> depth = np.full((4, 4), 800, np.float32)
    >>> depth[0] = np.nan
    >>> sigma = np.full((4, 4), 0.1, np.float32)
    >>> colorphase.LiveFrame(7, 0.0, 0.061, (), "mm", depth, sigma, np.isfinite(depth))
    LiveFrame(7, 4x4 px, 75 % measured, 800.0 to 800.0 mm, 61 ms after its exposure)
    """

    number: int
    exposed_at_s: float
    latency_s: float
    warnings: tuple[str, ...]
    range_unit: Literal["mm", "rad"]
    range_image: npt.NDArray[np.float32]
    sigma: npt.NDArray[np.float32]
    mask: npt.NDArray[np.bool_]
    points: npt.NDArray[np.float32] | None = None
    texture: npt.NDArray[np.uint8] | None = None

    @property
    def measured(self) -> float:
        """Share of all pixels that have a range, 0 to 1."""
        return float(np.isfinite(self.range_image).mean())

    def __repr__(self) -> str:
        height, width = self.mask.shape
        known = self.range_image[np.isfinite(self.range_image)]
        extent = ""
        if known.size:
            near, far = np.percentile(known, _RANGE_PERCENTILES)
            extent = f"{near:.1f} to {far:.1f} {self.range_unit}, "
        coverage = f"{width}x{height} px, {100 * self.measured:.0f} % measured"
        return f"LiveFrame({self.number}, {coverage}, {extent}{1e3 * self.latency_s:.0f} ms after its exposure)"


@dataclass(frozen=True, eq=False)
class WatchedFrame:
    """The frame that live decoding accepted last, for a viewer of the capture."""

    decoder: "LiveDecoder"
    format: PixelFormat
    number: int = -1  # by which the decoder names it
    image: ImageArray | None = None  # as the camera sent it; None: none was taken yet
    temperature_c: float | None = None  # of the camera

    def offered(self, newest: PairedFrame, number: int) -> "WatchedFrame":
        """Offer a frame, and return it if it was accepted, else the frame before."""
        if not self.decoder.offer(newest.image, number, newest.exposed_at_s):
            return self
        return replace(self, number=number, image=newest.image, temperature_c=newest.frame.temperature_c)


class _Decoded(NamedTuple):
    """The process's report on a frame whose arrays are in shared memory."""

    slot: int
    number: int
    exposed_at_s: float
    latency_s: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _LiveTask:
    """Arguments of the process."""

    offered: Any  # shared memory of the frame to decode
    decoded: Any  # and of two decoded frames: one is read while the other is written
    layout: np.dtype[np.void]  # a decoded frame's arrays
    shape: tuple[int, ...]  # of the frame to decode
    settings: DecodeSettings
    calibration: Calibration | None
    format: PixelFormat
    arch: str

    def arrays(self) -> tuple[npt.NDArray[Any], npt.NDArray[np.void]]:
        """Return the frame to decode, and the two slots of decoded frames."""
        levels = np.frombuffer(self.offered, self.format.dtype).reshape(self.shape)
        return levels, np.frombuffer(self.decoded, self.layout)


class LiveDecoder:
    """Decode the newest frame in a process of low priority, which ends with this one whatever happens.

    One frame is decoded at a time, by itself; frames that are offered meanwhile are not decoded. Methods may be called
    from any thread. A script needs the guard ``if __name__ == "__main__"``, as for every process that `multiprocessing`
    spawns.

    Parameters
    ----------
    size_px : (width, height)
        Size of every frame, whose array is (height, width, 3) or (height, width).
    settings : DecodeSettings, optional
        Settings to decode with.
    calibration : Calibration, optional
        The rig; with its geometry, ranges are in mm.
    format : PixelFormat
        Format of frames: RGB in one (H, W, 3) plane, or a Bayer mosaic (H, W). OpenCV's BGR is
        ``PixelFormat("rgb", channels="bgr")``.
    arch : {"auto", "cpu", "vulkan", "cuda", "metal"}
        Device to compute on; a named one never falls back.
    texture : bool
        True if frames get their texture, which takes half as long again as decoding.

    Raises
    ------
    ShapeError
        Frames of this format cannot be taken.
    CalibrationError
        The calibration is for frames of another size.

    Examples
    --------
    >>> import time
    >>> rig = colorphase.simulated_rig((320, 240))
    >>> image = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane")).image
    >>> with colorphase.LiveDecoder((320, 240), calibration=rig, arch="cpu") as decoder:
    ...     decoder.wait(60)  # until kernels are compiled
    ...     taken = decoder.offer(image, 0, time.monotonic())
    ...     decoder.wait(60)
    ...     frame = decoder.latest()
    >>> round(float(frame.range_image[120, 160]))  # mm
    900
    """

    def __init__(
        self,
        size_px: tuple[int, int],
        settings: DecodeSettings | None = None,
        calibration: Calibration | None = None,
        format: PixelFormat = RGB8,
        arch: str = "auto",
        *,
        texture: bool = False,
    ) -> None:
        if format.layout == "yuv":
            raise ShapeError("live decoding takes RGB in one plane, or a Bayer mosaic")
        calibrated = calibration is not None and calibration.has_geometry
        if calibration is not None and calibrated:
            calibration.geometry().check_frame(size_px)
        self._range_unit: Literal["mm", "rad"] = "mm" if calibrated else "rad"
        width, height = size_px
        pixels, triples = (height, width), (height, width, 3)
        # Types of 4 bytes first: all are aligned.
        fields: list[tuple[str, str, tuple[int, ...]]] = [("range_image", "f4", pixels), ("sigma", "f4", pixels)]
        fields += [("points", "f4", triples)] if calibrated else []
        fields += [("mask", "?", pixels)]
        fields += [("texture", "u1", triples)] if texture else []
        layout = np.dtype(fields)
        (shape,) = format.plane_shapes(height, width)
        n_bytes = int(np.prod(shape)) * np.dtype(format.dtype).itemsize
        # Unnamed files: nothing of them stays, whoever is killed.
        context = multiprocessing.get_context("spawn")
        offered, decoded = (context.RawArray(ctypes.c_uint8, n) for n in (n_bytes, 2 * layout.itemsize))
        task = _LiveTask(offered, decoded, layout, shape, settings or DecodeSettings(), calibration, format, arch)
        self._levels, self._slots = task.arrays()
        self._lock = threading.RLock()
        self._decoded: _Decoded | None = None
        self._latest: LiveFrame | None = None  # None: the frame that was decoded last has not been read yet
        self._ended: str | None = None
        self._idle = False
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve_live, args=(theirs, task), name="live decoder", daemon=True)
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
        """True if kernels are compiled and no frame is being decoded: the next one offered is taken."""
        with self._lock:
            self._listen()
            return self._idle

    @property
    def ended(self) -> str | None:
        """Why no frame is decoded any more, in one line; None while frames are."""
        with self._lock:
            self._listen()
            return self._ended

    @property
    def latency_s(self) -> float | None:
        """Latency of the frame that was decoded last; None: none has been. Unlike `latest`, it copies nothing."""
        with self._lock:
            self._listen()
            return None if self._decoded is None else self._decoded.latency_s

    def wait(self, most_s: float) -> None:
        """Return when it is ready, has ended, or the time is over."""
        until_s = time.monotonic() + most_s
        while not self.ready and self.ended is None and (left_s := until_s - time.monotonic()) > 0:
            with suppress(OSError):
                self._pipe.poll(min(left_s, _POLL_S))

    def offer(self, frame: ImageArray, number: int, exposed_at_s: float) -> bool:
        """Pass a frame to be decoded if the process is ready for it; never waits for it.

        Parameters
        ----------
        frame : (H, W, 3) RGB or (H, W) mosaic
            Levels, of the format's type; copied.
        number : int
            The number by which `latest` names it.
        exposed_at_s : float
            Time of its exposure, by `time.monotonic`, which all processes of a machine share.

        Returns
        -------
        bool
            True if it will be decoded.

        Raises
        ------
        ShapeError
            It has another shape or type.
        """
        shape = self._levels.shape
        if frame.shape != shape or frame.dtype != self._levels.dtype:
            found = f"frame has shape {frame.shape} {frame.dtype}, expected {shape} {self._levels.dtype}"
            if frame.shape == (shape[1], shape[0], *shape[2:]):
                found += ": width and height are swapped: size_px is (width, height), a frame's shape (height, width)"
            raise ShapeError(found)
        with self._lock:
            if not self.ready:
                return False
            np.copyto(self._levels, frame)
            slot = 0 if self._decoded is None else 1 - self._decoded.slot  # the other one may still be read
            try:
                self._pipe.send((slot, number, exposed_at_s))
            except OSError:
                self._note_end()
                return False
            self._idle = False
            return True

    def latest(self) -> LiveFrame | None:
        """Return the frame that was decoded last, the same object until there is another; None: none has been."""
        with self._lock:
            self._listen()
            if self._latest is None and self._decoded is not None:
                slot, number, exposed_at_s, latency_s, notes = self._decoded
                copied = self._slots[slot : slot + 1].copy()
                arrays = {name: copied[name][0] for name in self._slots.dtype.names or ()}
                self._latest = LiveFrame(number, exposed_at_s, latency_s, notes, self._range_unit, **arrays)
            return self._latest

    def close(self) -> None:
        """End the process, within a second; a second call does nothing."""
        with self._lock:
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
        """Take the messages that the process has sent."""
        try:
            while self._ended is None and self._pipe.poll():
                said = self._pipe.recv()
                if isinstance(said, str):
                    self._end(said)
                    return
                self._idle = True
                if said is not None:
                    self._decoded, self._latest = said, None
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


def serve_live(pipe: Connection, task: _LiveTask) -> None:
    """Decode what comes, in a process of its own, until the other end is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the capturing process decides when to end
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    warnings.simplefilter("ignore", DecodeWarning)  # frames carry them
    try:
        worker = _LiveWorker(task)
        pipe.send(None)
        while True:
            pipe.send(worker.decode(*pipe.recv()))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except Exception as error:
        with suppress(OSError):
            pipe.send(" ".join(str(error).split()) or type(error).__name__)


class _LiveWorker:
    def __init__(self, task: _LiveTask) -> None:
        self._task = task
        self._levels, self._slots = task.arrays()
        self._decoder = Decoder(task.settings, task.calibration, arch=task.arch)
        self._image = runtime.empty((*self._levels.shape[:2], 3), task.format.rgb_dtype)
        self._frame: DecodedFrame | None = None
        self._warm_up()

    def decode(self, slot: int, number: int, exposed_at_s: float) -> _Decoded:
        try:
            frame = self._frame = self._decoder.decode(self._develop(self._levels), out=self._frame)
        except FootageError as error:
            for name in self._slots.dtype.names or ():
                values = self._slots[name][slot]
                values[...] = np.nan if values.dtype.kind == "f" else 0
            return _Decoded(slot, number, exposed_at_s, time.monotonic() - exposed_at_s, (str(error),))
        self._write(frame, slot)
        return _Decoded(slot, number, exposed_at_s, time.monotonic() - exposed_at_s, frame.warnings)

    def _write(self, frame: DecodedFrame, slot: int) -> None:
        """Read a frame's arrays from the device into a slot."""
        for name in self._slots.dtype.names or ():
            sigma = "point_sigma" if frame.calibrated else "phase_sigma"
            self._slots[name][slot] = getattr(frame, sigma if name == "sigma" else name)

    def _develop(self, levels: npt.NDArray[Any]) -> Any:
        return develop((levels,), self._task.format, stripes=self._task.settings.stripes, out=self._image)

    def _warm_up(self) -> None:
        """Compile the kernels, by a plane's fringe, so that the first frame takes no longer than others."""
        format, settings = self._task.format, self._task.settings
        place = np.indices(self._levels.shape[:2])[int(settings.stripes == "vertical")]
        period_px = settings.camera_period_px or _WARM_PERIOD_PX
        phase = 2 * np.pi * place[..., None] / period_px + np.array([-1, 0, 1]) * 2 * np.pi / 3
        fringe = 0.5 + 0.4 * np.cos(phase) + np.random.default_rng(0).normal(0, 0.01, phase.shape)
        if format.layout == "bayer":
            colors = np.array(["rgb".index(color) for color in format.bayer]).reshape(2, 2)
            rows, columns = np.indices(self._levels.shape)
            fringe = fringe[rows, columns, colors[rows % 2, columns % 2]]
        else:
            fringe = fringe[..., ["rgb0".index(channel) % 3 for channel in format.channels]]
        # With a decoder of its own: the first frame is to determine the light.
        decoder = Decoder(settings, self._task.calibration, arch=self._task.arch)
        self._write(decoder.decode(self._develop((fringe * format.white_level).astype(format.dtype))), 0)
