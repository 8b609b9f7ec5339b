"""Films of a surface, or of the frames of a ``result.zarr``, drawn without a screen.

A film is drawn in parts, side by side, in processes that read, draw and encode one frame after another. Each part is a
file in a folder next to the film, ``.film.mp4.parts``, whose name holds the hash of all that it shows; so a film that
was stopped continues where it was, and what has changed since is drawn anew. At the end the parts are joined as they
are.
"""

import hashlib
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import OutputError, RenderError
from pipeline.files import explain, write_atomically
from pipeline.limits import check_missing
from pipeline.locking import locked
from pipeline.output.folder import file_digest
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import write_mesh
from pipeline.output.pictures.drawing_process import FilmPart, PictureJob, PictureOptions, draw_apart
from pipeline.output.pictures.picture_source import MeshSource, StoreSource
from pipeline.output.render import absolute_location, refuse_empty, write_compared
from pipeline.output.stored_result import StoredResult

# Pictures of a part: the most that a process loses where a film is stopped, and between two pictures that players can
# jump to. Short films have four parts, for more than one process to draw.
_MOST_PICTURES, _LEAST_PICTURES, _SHORT_PARTS = 24, 6, 4

# Quality of H.264 and of MPEG-4 that shows no blocks. One thread: parts of a film are encoded side by side. No picture
# depends on later ones, so that parts follow each other without a gap.
_X264 = {"crf": "17", "preset": "veryfast", "threads": "1", "bf": "0"}
_MPEG4 = {"qmin": "2", "qmax": "5"}


@dataclass(frozen=True)
class Film:
    """A film that has been drawn."""

    n_images: int
    before: int
    """Pictures that a run before had drawn."""
    held: tuple[int, ...]
    """Frames that are not there, or show nothing: the one before replaces them."""
    broken: dict[int, str]
    """Those of them that are damaged, and how."""
    codec: str
    renderer: str


def render_film(
    subject: str | Path | Mesh,
    path: str | Path,
    options: PictureOptions | None = None,
    *,
    frame: int | None = None,
    compared: Mesh | None = None,
    timeout_s: float = 120.0,
    notify: Callable[[int, int], None] = lambda done, of: None,
    remark: Callable[[str], None] = lambda line: None,
) -> Film:
    """Draw a film off screen: of every frame of a store, from its first to its last one; or of a single surface.

    Parameters
    ----------
    subject : str, Path or Mesh
        A ``result.zarr``, or a mesh.
    path : str or Path
        The MP4 file.
    options : PictureOptions, optional
        The eye's path, colours, rate and size.
    frame : int, optional
        The only frame to show of a store.
    compared : Mesh, optional
        Another mesh, the signed distance from which colours show.
    timeout_s : float
        Time without a new image after which drawing is given up, s.
    notify : callable
        Called with the number of images drawn and of all; first with the number drawn by earlier runs.
    remark : callable
        Called with each line that the user should know about the film.

    Raises
    ------
    FootageError
        There is no such store, or it lacks a field that is needed.
    RenderError
        No frame shows a surface, or the machine cannot draw.
    OutputError
        The file cannot be written, or is being written by another run.
    """
    path, options = Path(path), options or PictureOptions()
    if path.suffix.lower() != ".mp4":
        raise OutputError(f"{path} is not an MP4 file: name it .mp4")
    if any(side % 2 for side in options.size_px):
        raise OutputError(f"the size is {options.size_px[0]}x{options.size_px[1]}: films need even numbers")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source: MeshSource | StoreSource
        if isinstance(subject, Mesh):
            refuse_empty(subject)
            write_mesh(subject, folder / "mesh.ply")
            source, where = MeshSource(folder / "mesh.ply"), {"mesh": str(folder / "mesh.ply")}
            numbers = _lasting(0, options)
        else:
            source, where = StoreSource(subject, options.colors), {"store": absolute_location(subject)}
            numbers = _wanted(source.result) if frame is None else (frame,)
            numbers = _lasting(numbers[0], options) if len(numbers) == 1 else numbers
        compared_name = write_compared(compared, folder)
        if compared_name is not None:
            compared_name = str(folder / compared_name)
        job = PictureJob.model_validate({**where, "options": options, "numbers": numbers, "compared": compared_name})
        with locked(path):
            return _FilmRun(job, source, path, folder, timeout_s, notify, remark).run()


def _wanted(result: StoredResult) -> tuple[int, ...]:
    """Return the frames that a film shows: all from the first to the last, as long as enough of them are there."""
    check_missing(result.name, len(result.wanted), len(result.done))
    return tuple(result.wanted)


def _lasting(number: int, options: PictureOptions) -> tuple[int, ...]:
    return max(1, round(options.seconds * options.fps)) * (number,)


class _FilmRun:
    """One film, while nobody else writes it."""

    def __init__(
        self,
        job: PictureJob,
        source: MeshSource | StoreSource,
        path: Path,
        folder: Path,
        timeout_s: float,
        notify: Callable[[int, int], None],
        remark: Callable[[str], None],
    ) -> None:
        self._remarks, self._remark = set[str](), remark
        self._job, self._source, self._path, self._folder = job, source, path, folder
        self._timeout_s, self._notify = timeout_s, notify
        self._work = path.with_name(f".{path.name}.parts")
        self._lock, self._stopped = threading.Lock(), False
        self._drawn: dict[int, int] = {}  # pictures of each part, by its first one's number

    def run(self) -> Film:
        try:
            self._work.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot write {self._path}: {explain(error)}") from error
        try:
            return self._made(self._parts())
        finally:
            with suppress(OSError):  # what holds something stays, for the next run to continue
                self._work.rmdir()

    def _made(self, parts: list[FilmPart]) -> Film:
        todo = [part for part in parts if not _whole(part)]
        self._keep_only([part for part in parts if part not in todo])
        before = len(self._job.numbers) - sum(part.stop - part.first for part in todo)
        self._drawn = {part.first: part.stop - part.first for part in parts if part not in todo}
        self._notify(before, len(self._job.numbers))
        renderer = self._draw(todo) if todo else "an earlier run"
        records = [part.record() for part in parts]
        held = [number for record in records for number in record.held]
        if len(held) == len(self._job.numbers):
            shutil.rmtree(self._work)
            raise RenderError("no frame shows a surface: run colorphase inspect on the footage")
        joined = self._folder / "film.mp4"
        join_parts([(Path(part.path), part.stop - part.first) for part in parts], joined, self._job.options.fps)
        with joined.open("rb") as film:
            write_atomically(self._path, lambda file: shutil.copyfileobj(film, file))
        shutil.rmtree(self._work)
        broken = {number: why for record in records for number, why in record.broken.items()}
        held = list(dict.fromkeys(held))
        return Film(len(self._job.numbers), before, tuple(held), broken, records[0].codec, renderer)

    def _parts(self) -> list[FilmPart]:
        """Return the film's parts; a file's name is a hash of all that it depends on."""
        n_pictures = len(self._job.numbers)
        length = min(_MOST_PICTURES, max(_LEAST_PICTURES, -(-n_pictures // _SHORT_PARTS)))
        digests = [self._source.digest(number) for number in dict.fromkeys(self._job.numbers)]
        shared = [version("colorphase"), self._job.options.model_dump_json(), str(n_pictures), *digests]
        if self._job.compared is not None:
            shared.append(str(file_digest(Path(self._job.compared))))
        parts = []
        for first in range(0, n_pictures, length):
            stop = min(first + length, n_pictures)
            key = hashlib.sha256("\n".join([*shared, str(first)]).encode()).hexdigest()[:32]
            parts.append(FilmPart(first=first, stop=stop, path=str((self._work / f"{key}.mp4").absolute())))
        return parts

    def _keep_only(self, parts: list[FilmPart]) -> None:
        """Remove what an earlier run has left that is of no use any more."""
        kept = {Path(part.path).stem for part in parts}
        for file in self._work.iterdir():
            if file.stem not in kept:
                file.unlink()

    def _draw(self, todo: list[FilmPart]) -> str:
        """Draw parts in a process for each core, and return what has drawn them."""
        n_processes = min(len(todo), os.cpu_count() or 1)
        threads = max(1, (os.cpu_count() or 1) // n_processes)
        pool = ThreadPoolExecutor(n_processes)
        try:
            running = [pool.submit(self._draw_some, i, todo[i::n_processes], threads) for i in range(n_processes)]
            ended, _ = wait(running, return_when=FIRST_EXCEPTION)
            renderers = [drawing.result() for drawing in ended]  # raises what one has raised
            for line in self._remarks:  # which each process has made
                self._remark(line)
            return renderers[-1]
        except KeyboardInterrupt:
            missing = sum(part.stop - part.first for part in todo if not _whole(part))
            whole, of = len(self._job.numbers) - missing, len(self._job.numbers)
            raise KeyboardInterrupt(
                f"stopped: {whole} of {of} pictures are drawn; the same command goes on from there"
            ) from None
        finally:
            self._stopped = True
            pool.shutdown()

    def _draw_some(self, process: int, parts: list[FilmPart], threads: int) -> str:
        folder = self._folder / f"process_{process}"
        folder.mkdir()

        def hear(said: dict[str, Any]) -> None:
            if self._stopped:
                raise RenderError("another process has stopped")
            if "drawn" in said:
                with self._lock:
                    self._drawn[said["part"]] = said["drawn"]
                    self._notify(sum(self._drawn.values()), len(self._job.numbers))

        job = self._job.replace(parts=tuple(parts))
        return draw_apart(job, folder, self._timeout_s, hear, remark=self._remarks.add, threads=threads)


def _whole(part: FilmPart) -> bool:
    """Return whether a part is there, and none of its frames was damaged, which may have been repaired since."""
    file = Path(part.path)
    try:
        record = part.record()
        return file.is_file() and file.stat().st_size == record.bytes and not record.broken
    except (OSError, ValueError):
        return False


class FilmEncoder:
    """Pictures to an MP4 file: H.264 where FFmpeg can make it, else MPEG-4.

    Parameters
    ----------
    path : str or Path
        The file.
    size_px : (int, int)
        Width and height, even.
    fps : float
        Pictures per second.
    """

    def __init__(self, path: str | Path, size_px: tuple[int, int], fps: float) -> None:
        import av  # slow to import, and only needed here

        self.codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
        self._container = av.open(str(path), "w")
        rate = Fraction(round(fps * 1000), 1000)
        settings = _X264 if self.codec == "libx264" else _MPEG4
        self._stream: Any = self._container.add_stream(self.codec, rate=rate, options=settings)
        self._stream.width, self._stream.height = size_px
        self._stream.pix_fmt = "yuv420p"
        # Where a file does not specify it, players guess the matrix by the number of rows: 1 is BT.709, limited range.
        context = self._stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = context.color_range = 1

    def __enter__(self) -> "FilmEncoder":
        return self

    def __exit__(self, error: object, *_: object) -> None:
        if error is None:
            self._container.mux(self._stream.encode())
        self._container.close()

    def add(self, image: npt.NDArray[np.uint8]) -> None:
        """Add a picture, (H, W, 3) RGB."""
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")
        self._container.mux(self._stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))


def join_parts(parts: Sequence[tuple[Path, int]], path: Path, fps: float) -> None:
    """Join parts of a film to one, as they are encoded.

    Parameters
    ----------
    parts : sequence of (Path, int)
        MP4 files of `FilmEncoder`, in their order, and how many pictures each has.
    path : Path
        The MP4 file to write.
    fps : float
        Pictures per second.
    """
    import av

    step = Fraction(1000, round(fps * 1000))  # seconds a picture
    shift = Fraction(0)
    with av.open(str(path), "w", options={"movflags": "faststart"}) as film:
        stream: Any = None
        for part, n_pictures in parts:
            with av.open(str(part)) as source:
                video = source.streams.video[0]
                if stream is None:
                    stream = film.add_stream_from_template(video)
                    stream.time_base = video.time_base
                for packet in source.demux(video):
                    if packet.dts is None:  # the end
                        continue
                    ticks = round(shift / video.time_base)
                    packet.pts, packet.dts = packet.pts + ticks, packet.dts + ticks
                    packet.stream = stream
                    film.mux(packet)
            shift += n_pictures * step
