"""Picture jobs, and the child process that draws them.

The drawing library ends the whole process where a machine has no graphics library, hence the child.
"""

import json
import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, Annotated, Any, Literal

from pydantic import Field, PlainValidator, model_validator

from pipeline.errors import RenderError
from pipeline.limits import read_text
from pipeline.models import Model, Signed
from pipeline.output.pictures.color_meaning import Colors
from pipeline.output.pictures.picture_overlay import Colormap
from pipeline.output.pictures.viewpoint import CameraPath, View, Viewpoint
from pipeline.processes import start_python
from tikernels import runtime

Buffer = Literal["depth", "normals"]

# A file's name, which need not be UTF-8.
_Place = Annotated[str, PlainValidator(str)]

#: What software renderers, and H.264, can do.
MOST_SIDE_PX = 8192

#: What Python is told to run.
COMMAND = ("-m", "pipeline.output.pictures.drawing_child")
#: The file that a child leaves in its folder when all is done.
DONE = "done"
_GRAPHICS_CURE = (
    "on Debian or Ubuntu run 'apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri' or 'apt-get install libosmesa6', "
    "elsewhere install a working OpenGL driver"
)
# The last line of a traceback names the error's class before its message.
_OUR_ERRORS = re.compile(r"^(pipeline|tikernels)\.errors\.\w+: ")
_GRAPHICS_WORDS = ("opengl", "libgl", "egl", "glx", "osmesa", "x server", "shared object")


class PictureOptions(Model):
    """Options of a drawing, for stills and films.

    Parameters
    ----------
    view : str
        From where, so that all of it is seen: "three-quarter", the camera's side from its upper left; "front", the
        camera itself; "left", "right", "top", "bottom" or "back".
    camera : Viewpoint, optional
        From where by numbers, in place of `view`.
    path : CameraPath, optional
        Where a film's eye goes, in place of `view`.
    turn_deg : float
        By how much a film's eye goes round the surface, to its left, from the first to the last picture.
    sway_deg : float
        By how much it swings to either side, once to and fro.
    colors : str
        What colours show: "clay", nothing, so that relief is seen; "depth", "sigma" (standard deviation), "modulation",
        "texture" (what the camera sees without stripes), or the deviation from a fitted "plane" or "sphere". Limits
        are those of the object and not of a wall behind it, and the same all along.
    limits : (float, float), optional
        Values with the first and the last colour, in mm, rad or levels; left out, by what is drawn.
    colormap : str, optional
        Which colours; left out, as their meaning needs.
    transparent : bool
        Whether a still has nothing behind the surface.
    fps : float
        A film's pictures per second.
    seconds : float
        How long a film of a single surface is.
    size_px : (int, int)
        Width and height; even in films.
    """

    view: View = "three-quarter"
    camera: Viewpoint | None = None
    path: CameraPath | None = None
    turn_deg: Signed = 0.0
    sway_deg: Signed = 0.0
    colors: Colors = "clay"
    limits: tuple[Signed, Signed] | None = None
    colormap: Colormap | None = None
    transparent: bool = False
    fps: Annotated[float, Field(ge=0.1, le=1000)] = 30.0
    seconds: Annotated[float, Field(ge=0.1, le=3600)] = 4.0
    size_px: tuple[Annotated[int, Field(ge=16, le=MOST_SIDE_PX)], Annotated[int, Field(ge=16, le=MOST_SIDE_PX)]] = (
        1280,
        960,
    )

    @property
    def moves(self) -> bool:
        """True if the eye moves."""
        return self.path is not None or self.turn_deg != 0 or self.sway_deg != 0


class FilmPart(Model):
    """Some pictures of a film, in a file of their own."""

    first: int
    stop: int
    path: _Place

    @property
    def record_file(self) -> Path:
        """Path of the record of what was drawn."""
        return Path(self.path).with_suffix(".json")

    def record(self) -> "PartRecord":
        """Return the record of what was drawn.

        Raises
        ------
        OSError, ValueError
            It is not there, or is none.
        """
        return PartRecord.model_validate_json(read_text(self.record_file))


class PartRecord(Model):
    """The record of a part that was drawn."""

    held: tuple[int, ...]  # frames for which the one before stands
    broken: dict[int, str]  # those of them that are damaged, and how
    codec: str
    bytes: int


class PictureJob(Model):
    """The job of the process that draws.

    Parameters
    ----------
    options : PictureOptions
        How it is drawn.
    mesh : str, optional
        A PLY file.
    store : str, optional
        A ``result.zarr``, in place of it.
    numbers : tuple of int
        The frame of each picture; of a still one, of a mesh's film zeros.
    picture : str, optional
        The PNG file of a still.
    buffers : tuple of str
        Files to write next to it, in its folder: ``depth.tiff``, ``normals.png``.
    parts : tuple of FilmPart
        Those of a film to draw.
    compared : str, optional
        The PLY file of another mesh, the distance from which colours show.
    """

    options: PictureOptions
    mesh: _Place | None = None
    store: _Place | None = None
    numbers: tuple[int, ...]
    picture: _Place | None = None
    buffers: tuple[Buffer, ...] = ()
    parts: tuple[FilmPart, ...] = ()
    compared: _Place | None = None

    @model_validator(mode="after")
    def _one_subject(self) -> "PictureJob":
        if (self.mesh is None) == (self.store is None):
            raise ValueError("give a mesh or a store")
        return self


def draw_apart(
    job: PictureJob,
    folder: Path,
    timeout_s: float,
    notify: Callable[[dict[str, Any]], None] = lambda _: None,
    *,
    remark: Callable[[str], None] = lambda line: None,
    threads: int | None = None,
) -> str:
    """Draw in a child process; what goes wrong there becomes one line here.

    Parameters
    ----------
    job : PictureJob
        What is to be drawn; its files' names are relative to `folder`, or absolute.
    folder : Path
        Where the child runs; nothing else does.
    timeout_s : float
        Time without a line from it after which it is given up, s.
    notify : callable
        Is given what it says.
    remark : callable
        Is given a line where the user should know something of the picture.
    threads : int, optional
        Of kernels and of a software renderer; None: one a core.

    Returns
    -------
    str
        What has drawn it, as in "llvmpipe (LLVM 15.0.6, 256 bits), EGL".

    Raises
    ------
    RenderError
        It cannot draw.
    """
    # Off screen needs no X server, and a dead one would be waited for.
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    if threads is not None:
        names = (*runtime.THREAD_VARIABLES, "OPENBLAS_NUM_THREADS")
        # Mesa's renderer counts the threads in addition to the one that calls it.
        few = {**dict.fromkeys(names, str(threads)), "LP_NUM_THREADS": str(threads - 1)}
        environment = few | environment  # a user's own numbers win
    (folder / "job.json").write_text(json.dumps(job.model_dump(mode="json")), encoding="utf-8")
    said: dict[str, Any] = {}

    def hear(line: str) -> None:
        try:
            what = json.loads(line)
        except ValueError:  # of a library
            return
        if isinstance(what, dict):
            said.update(what)
            notify(what)

    # A graphics card or its stand-in first; OSMesa is only found by name where it is alone.
    for window in ({}, {"VTK_DEFAULT_OPENGL_WINDOW": "vtkOSOpenGLRenderWindow"}):
        code, errors = _listen([*COMMAND, "job.json"], folder, environment | window, timeout_s, hear)
        if code == 0 and (folder / DONE).exists():
            if "note" in said:
                remark(said["note"])
            return str(said.get("renderer", "an unknown renderer"))
        last_line = (errors.strip().splitlines() or [""])[-1]
        crashed = code not in (0, 1)
        if last_line and not crashed and not any(word in last_line.lower() for word in _GRAPHICS_WORDS):
            raise RenderError(f"cannot draw: {_OUR_ERRORS.sub('', last_line)}")
    raise RenderError(f"cannot draw, the graphics library (OpenGL) is missing or broken: {_GRAPHICS_CURE}")


def _listen(
    command: list[str], folder: Path, environment: dict[str, str], timeout_s: float, notify: Callable[[str], None]
) -> tuple[int, str]:
    """Run a child to its end, and return its exit code and what it wrote to standard error."""
    with tempfile.TemporaryFile() as errors:
        try:
            child = start_python(command, environment, cwd=folder, stdout=subprocess.PIPE, stderr=errors)
        except OSError as error:
            raise RenderError(f"cannot start {sys.executable} to draw: {error.strerror}") from error
        lines: queue.Queue[bytes] = queue.Queue()

        def read(output: IO[bytes]) -> None:
            for line in output:
                lines.put(line)
            lines.put(b"")

        with child:
            reader = threading.Thread(target=read, args=(child.stdout,), daemon=True)
            reader.start()
            try:
                while line := lines.get(timeout=timeout_s):
                    notify(line.decode(errors="replace").strip())
                code = child.wait(timeout_s)
            except (queue.Empty, subprocess.TimeoutExpired) as error:
                raise RenderError(f"drawing took more than {timeout_s:g} s: {_GRAPHICS_CURE}") from error
            finally:
                child.kill()  # does nothing to one that has ended
                reader.join()
        errors.seek(0)
        return code, errors.read().decode(errors="replace")
