"""The process that draws one picture, or parts of a film, and says in lines of JSON what is done.

Frames become meshes, pictures and packets of a film one after another, so that a film takes no more memory than a
picture.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import RenderError
from pipeline.files import sync
from pipeline.output.film import FilmEncoder
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_mesh
from pipeline.output.pictures.color_meaning import check_boxes, distance_from
from pipeline.output.pictures.drawing_process import DONE, FilmPart, PartRecord, PictureJob
from pipeline.output.pictures.picture_source import MeshSource, StoreSource
from pipeline.output.pictures.scene import BLACK, GROUND, WHITE, Scene, SurfaceRenderer
from pipeline.output.range_image import write_png
from tikernels import runtime


class _Drawing:
    """One job."""

    def __init__(self, job: PictureJob) -> None:
        self._job, self._options = job, job.options
        self._source = _source_of(job)
        samples, distance = self._samples(), None
        if job.compared is not None:
            compared = read_mesh(job.compared)
            distance = distance_from(compared)
            note = check_boxes(np.concatenate([mesh.vertices for mesh in samples]), compared.vertices)
            if note is not None:
                _say({"note": note})
        self._scene = Scene(samples, job.options, distance)
        ground = BLACK if job.options.transparent else GROUND
        self._renderer = SurfaceRenderer(job.options.size_px, ground=ground)

    def run(self) -> None:
        """Draw all, and say by what."""
        if self._job.picture is not None:
            self._draw_still(self._job.picture)
        for part in self._job.parts:
            self._draw_part(part)
        _say({"renderer": self._renderer.name()})

    def _samples(self) -> list[Mesh]:
        """Return the meshes that set limits and the eye's place: of a still itself."""
        return self._source.samples() if self._job.picture is None else [self._wanted()]

    def _wanted(self) -> Mesh:
        """Return the surface of a still."""
        mesh = self._source.mesh(self._job.numbers[0])
        if mesh is None:
            number = self._job.numbers[0]
            empty = f"frame {number} shows no surface: choose another --frame"
            raise RenderError(self._source.broken.get(number, empty))
        return mesh

    def _draw_still(self, path: str) -> None:
        still = self._wanted()
        image = self._still(self._renderer, still)
        if self._options.transparent:
            image = _with_opacity(image, self._still(SurfaceRenderer(self._options.size_px, ground=WHITE), still))
        write_png(path, image)
        if not self._job.buffers:
            return
        renderer = SurfaceRenderer(self._options.size_px, samples=1, ground=BLACK)
        self._scene.show(renderer, still)
        if "depth" in self._job.buffers:
            cv2.imwrite("depth.tiff", renderer.depth(self._scene.viewpoint(0.0)))
        if "normals" in self._job.buffers:
            write_png("normals.png", self._scene.normal_image(renderer))

    def _still(self, renderer: SurfaceRenderer, mesh: Mesh) -> npt.NDArray[np.uint8]:
        self._scene.show(renderer, mesh)
        return self._scene.picture(renderer, 0.0)

    def _draw_part(self, part: FilmPart) -> None:
        numbers, held = self._job.numbers, []
        shown = self._show_what_was_before(part.first)
        partial = f"{part.path}.{os.getpid()}.mp4"
        with FilmEncoder(partial, self._options.size_px, self._options.fps) as encoder:
            for i in range(part.first, part.stop):
                number, label = numbers[i], ""
                if number != shown:
                    mesh = self._source.mesh(number)
                    if mesh is None:
                        held.append(number)
                    else:
                        self._scene.show(self._renderer, mesh)
                        shown = number
                if self._job.store is not None and len(set(numbers[:2])) > 1:
                    label = f"frame {number}" + ("" if number == shown else ", not there")
                if shown is None:
                    encoder.add(self._renderer.ground())
                else:
                    encoder.add(self._scene.picture(self._renderer, i / max(len(numbers) - 1, 1), label))
                _say({"part": part.first, "drawn": i + 1 - part.first})
        broken = {number: why for number, why in self._source.broken.items() if number in held}
        size = Path(partial).stat().st_size
        record = PartRecord(held=tuple(held), broken=broken, codec=encoder.codec, bytes=size)
        sync(Path(partial))
        part.record_file.write_text(record.model_dump_json(), encoding="utf-8")
        os.replace(partial, part.path)

    def _show_what_was_before(self, first: int) -> int | None:
        """Show what a part's first picture shows, if its frame is not there; return the number of that."""
        numbers = self._job.numbers
        if first == 0 or self._source.mesh(numbers[first]) is not None:
            return None
        for number in reversed(numbers[:first]):
            mesh = self._source.mesh(number)
            if mesh is not None:
                self._scene.show(self._renderer, mesh)
                return number
        return None


def _with_opacity(on_black: npt.NDArray[np.uint8], on_white: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return what is the same before black and before white, (H, W, 4) RGB and opacity."""
    black, white = on_black.astype(np.float64), on_white.astype(np.float64)
    opacity = 255 - (white - black).mean(axis=-1, keepdims=True)
    colors = 255 * black / np.maximum(opacity, 1)
    return np.asarray(np.rint(np.concatenate([colors, opacity], axis=-1).clip(0, 255)), np.uint8)


def _source_of(job: PictureJob) -> MeshSource | StoreSource:
    if job.mesh is not None:
        return MeshSource(job.mesh)
    runtime.init("cpu")  # meshes are joined while a graphics card draws
    return StoreSource(str(job.store), job.options.colors)


def _say(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    np.seterr(all="ignore")
    _Drawing(PictureJob.model_validate(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))).run()
    Path(DONE).touch()
