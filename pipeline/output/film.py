"""A film of the meshes of a ``result.zarr``, drawn without a screen.

A child process makes the meshes, draws and encodes them, one frame at a time, so that a film takes no more memory than
one image.
"""

import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from pipeline.errors import FootageError, OutputError, RenderError
from pipeline.files import write_atomically
from pipeline.output.mesh import Mesh
from pipeline.output.range_image import CLAY, depth_colors
from pipeline.output.render import VIEWS, Renderer, View, draw_apart
from pipeline.output.stored_result import StoredResult, mesh_fields
from tikernels import runtime

Colors = Literal["depth", "shaded", "modulation", "sigma"]

_COMMAND = [sys.executable, "-P", "-m", "pipeline.output.film"]
# Frames, evenly spaced, that tell the eye's place and the colours' limits for the whole film.
_ASKED = 16
# Of their points every sixteenth is enough for that.
_EVERY = 16
# Share of the points on each side that may be stray ones, and does not move the eye away.
_STRAY = 0.002
# Quality of H.264 and of MPEG-4 that shows no blocks.
_X264, _MPEG4 = {"crf": "18", "preset": "medium"}, {"qmin": "2", "qmax": "5"}


@dataclass(frozen=True)
class FilmOptions:
    """How a film is drawn.

    Parameters
    ----------
    view : {"three-quarter", "front"}
        From where at its beginning: the camera's side, from its upper left or straight on.
    turn_deg : float
        By how much the eye goes round the surface, about the upright axis, from the first to the last image.
    sway_deg : float
        By how much it swings to either side, once to and fro.
    colors : {"depth", "shaded", "modulation", "sigma"}
        What the colours show, with the same limits all along: depth, nothing (clay), the fringe's modulation, or the
        standard deviation of phase or depth.
    fps : float
        Images a second.
    seconds : float
        How long a store of one frame is shown.
    size_px : (int, int)
        Width and height, even.
    """

    view: View = "three-quarter"
    turn_deg: float = 0.0
    sway_deg: float = 0.0
    colors: Colors = "depth"
    fps: float = 30.0
    seconds: float = 4.0
    size_px: tuple[int, int] = (1280, 960)


@dataclass(frozen=True)
class Film:
    """What has been drawn."""

    n_images: int
    held: tuple[int, ...]  # frames that are not there, or show nothing: the one before stands in for them
    codec: str


def render_film(
    location: str | Path,
    path: str | Path,
    options: FilmOptions | None = None,
    *,
    timeout_s: float = 120.0,
    tell: Callable[[int, int], None] = lambda done, of: None,
) -> Film:
    """Draw a film of every frame from a store's first to its last one, off screen.

    Parameters
    ----------
    location : str or Path
        The ``result.zarr``.
    path : str or Path
        The MP4 file.
    options : FilmOptions, optional
        View, motion, colours and rate.
    timeout_s : float
        Time without a new image after which drawing is given up, s.
    tell : callable
        Is told how many of how many images are drawn.

    Raises
    ------
    FootageError
        There is no such store, or it lacks a field that is needed.
    RenderError
        No frame shows a surface, or the machine cannot draw.
    OutputError
        The file cannot be written.
    """
    options = options or FilmOptions()
    for name, value, known in (("view", options.view, get_args(View)), ("colors", options.colors, get_args(Colors))):
        if value not in known:
            raise ValueError(f"{name}: got {value!r}, expected one of {', '.join(known)}")
    if Path(path).suffix.lower() != ".mp4":
        raise OutputError(f"{path} is not an MP4 file: name it .mp4")
    if any(side % 2 or side < 16 for side in options.size_px):
        raise OutputError(f"the size is {options.size_px[0]}x{options.size_px[1]}: films need even numbers, 16 or more")
    result = StoredResult(location)
    if not result.done:
        raise FootageError(f"{result.name} holds no frame that is done: decode first")
    for field in _needed(result, options.colors):
        result.read(field, result.done[0])
    where = str(location) if "://" in str(location) else str(Path(location).absolute())
    last: dict[str, Any] = {}

    def hear(line: str) -> None:
        last.update(json.loads(line))
        if "held" not in last:
            tell(last["done"], last["of"])

    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "job.json").write_text(json.dumps({"location": where, "options": asdict(options)}))
        draw_apart([*_COMMAND, "job.json", "film.mp4"], folder, "film.mp4", timeout_s, hear)
        with Path(folder, "film.mp4").open("rb") as film:
            write_atomically(path, lambda file: shutil.copyfileobj(film, file))
    return Film(last["done"], tuple(last["held"]), last["codec"])


def _needed(result: StoredResult, colors: str) -> tuple[str, ...]:
    more = {"modulation": ("modulation",), "sigma": (_sigma(result),)}
    return (*mesh_fields(in_mm=result.in_mm), *more.get(colors, ()))


def _sigma(result: StoredResult) -> str:
    return "point_sigma" if result.in_mm else "phase_sigma"


class _FilmSetup:
    """What all images of a film share: proportions, colours' limits, and where the eye is."""

    def __init__(self, meshes: Sequence[Mesh], options: FilmOptions) -> None:
        self.options = options
        points = np.concatenate([mesh.vertices[::_EVERY] for mesh in meshes])
        self.scale = np.ones(3, np.float32)
        if meshes[0].unit == "rad":  # which has no true proportions
            low, high = np.percentile(points[:, 2], (1, 99))
            width = np.ptp(points[:, :2], axis=0).max()
            self.scale[2] = 0.33 * width / max(high - low, 1e-6)
        near, far = np.quantile(points * self.scale, (_STRAY, 1 - _STRAY), axis=0)
        self.corners = np.clip(points * self.scale, near, far)
        if options.turn_deg or options.sway_deg:
            # One distance from all sides: that of the ball around everything.
            middle, radius = (near + far) / 2, float(np.linalg.norm(far - near)) / 2
            around = np.stack(np.meshgrid(*3 * [[-1.0, 0.0, 1.0]]), axis=-1).reshape(-1, 3)
            around = around[np.any(around != 0, axis=1)]
            self.corners = middle + radius * around / np.linalg.norm(around, axis=1, keepdims=True)
        self.limits = (0.0, 1.0)
        values = [shown for mesh in meshes if (shown := self._shown(mesh)) is not None]
        if values:
            bounds = np.percentile(np.concatenate([v[::_EVERY] for v in values]), (1, 99))
            low, high = (0.0 if options.colors == "sigma" else float(bounds[0])), float(bounds[1])
            self.limits = (low, max(high, low + 1e-6 * max(abs(low), 1.0)))

    def _shown(self, mesh: Mesh) -> npt.NDArray[np.float32] | None:
        """Return what a mesh's colours stand for; None: nothing."""
        if self.options.colors == "shaded":
            return None
        if self.options.colors == "depth":
            return mesh.vertices[:, 2]
        name = "modulation" if self.options.colors == "modulation" else f"sigma_{mesh.unit}"
        return mesh.properties[name]

    def colors(self, mesh: Mesh) -> npt.NDArray[np.uint8]:
        """Return a colour a vertex, (N, 3)."""
        shown = self._shown(mesh)
        if shown is None:
            return np.full((len(mesh.vertices), 3), CLAY, np.uint8)
        return depth_colors(shown[:, None], np.ones((len(shown), 1), bool), self.limits)[:, 0]

    def towards_eye(self, part: float) -> tuple[float, float, float]:
        """Return where the eye is when this part, 0..1, of the film is over."""
        angle = np.radians(self.options.turn_deg * part + self.options.sway_deg * np.sin(2 * np.pi * part))
        x, y, z = VIEWS[self.options.view]
        c, s = float(np.cos(angle)), float(np.sin(angle))
        return (c * x + s * z, y, c * z - s * x)


def _draw_film(location: str, options: FilmOptions, path: str) -> None:
    runtime.init("cpu")  # meshes are joined while the graphics card draws
    result = StoredResult(location)
    asked = [result.done[i] for i in np.unique(np.linspace(0, len(result.done) - 1, _ASKED).astype(int))]
    needed = _needed(result, options.colors)
    meshes = [mesh for number in asked if len((mesh := result.mesh(number, needed)).faces)]
    if not meshes:
        raise RenderError("no frame shows a surface")
    setup, renderer = _FilmSetup(meshes, options), Renderer(options.size_px)
    del meshes
    numbers: Sequence[int] = result.wanted
    if len(numbers) == 1:
        numbers = max(1, round(options.seconds * options.fps)) * [numbers[0]]
    done, held, shown = set(result.done), [], -1
    with _Encoder(path, options) as encoder:
        for i, number in enumerate(numbers):
            if number != shown:
                now = result.mesh(number, needed) if number in done else None
                if now is not None and len(now.faces):
                    renderer.show(now.vertices * setup.scale, now.faces, setup.colors(now))
                    shown = number
                else:
                    held.append(number)
            renderer.aim(setup.corners, setup.towards_eye(i / max(len(numbers) - 1, 1)))
            encoder.add(renderer.image())
            _say({"done": i + 1, "of": len(numbers)})
        _say({"held": held, "codec": encoder.codec})


class _Encoder:
    """Images to an MP4 file: H.264 where FFmpeg can make it, else MPEG-4."""

    def __init__(self, path: str, options: FilmOptions) -> None:
        import av  # slow to import, and only needed here

        self.codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
        self._container = av.open(path, "w", options={"movflags": "faststart"})
        rate = Fraction(round(options.fps * 1000), 1000)
        settings = _X264 if self.codec == "libx264" else _MPEG4
        self._stream: Any = self._container.add_stream(self.codec, rate=rate, options=settings)
        self._stream.width, self._stream.height = options.size_px
        self._stream.pix_fmt = "yuv420p"
        # Of a file that does not say it, players guess the matrix by the number of rows: 1 is BT.709, limited range.
        context = self._stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = context.color_range = 1

    def __enter__(self) -> "_Encoder":
        return self

    def __exit__(self, error: object, *_: object) -> None:
        if error is None:
            self._container.mux(self._stream.encode())
        self._container.close()

    def add(self, image: npt.NDArray[np.uint8]) -> None:
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")
        self._container.mux(self._stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))


def _say(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    job = json.loads(Path(sys.argv[1]).read_text())
    job["options"]["size_px"] = tuple(job["options"]["size_px"])
    _draw_film(job["location"], FilmOptions(**job["options"]), sys.argv[2])
