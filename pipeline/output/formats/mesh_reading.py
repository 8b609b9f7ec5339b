"""Meshes that other programs have written, by trimesh: OBJ, STL and glTF.

Only files beside the mesh are opened, by their plain names: nothing is fetched, and no path leads elsewhere.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.limits import MAX_PIXELS, check_mesh_size, max_pixels
from pipeline.output.mesh import Mesh

#: What this reads.
READ_SUFFIXES = (".obj", ".stl", ".glb", ".gltf")
# A vertex and its two triangles take some 150 bytes as text, and a texture some more.
_BYTES_A_PIXEL = 1000


def read_foreign(path: Path) -> Mesh:
    """Return the mesh that a file holds, with the coordinates that it has there and its colours by vertex.

    Raises
    ------
    OSError
        It cannot be read.
    ValueError
        It holds no triangles, more than `max_pixels` allows, or is damaged.
    """
    import trimesh  # slow to import, and seldom needed

    most = _BYTES_A_PIXEL * max_pixels()
    if path.stat().st_size > most:
        raise ValueError(f"it has more than {most} bytes: set {MAX_PIXELS} to a larger number if it is whole")
    try:
        with path.open("rb") as file:
            scene = trimesh.load_scene(
                file, file_type=path.suffix[1:].lower(), resolver=_Beside(path.parent), process=False
            )
        places = list(scene.graph.nodes_geometry)
        if len(places) == 1:  # joining parts, even a single one, loses colours that stand beside a material
            transform, name = scene.graph[places[0]]
            solid = scene.geometry[name]
            vertices = trimesh.transform_points(solid.vertices, transform).astype(np.float32)
        else:
            solid = scene.to_mesh()
            vertices = np.asarray(solid.vertices, np.float32)
        faces = np.asarray(getattr(solid, "faces", np.empty((0, 3))), np.int32)
        colors = _colors(solid) if len(faces) else None
    except OSError:
        raise
    except Exception as error:  # its readers raise whatever damaged bytes lead to
        raise ValueError(f"it is damaged, or no such file ({type(error).__name__})") from None
    if not len(faces):
        raise ValueError("it has no triangles")
    check_mesh_size(len(vertices), len(faces), repeated=6)
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), colors)


def _colors(solid: Any) -> npt.NDArray[np.uint8] | None:
    """Return the sRGB colours of a mesh at its vertices, where it has some, from its texture if need be."""
    visual = solid.visual
    if visual.kind == "texture" and visual.uv is None:
        # Beside a glTF material without a picture; the format's colours are linear light.
        linear = visual.vertex_attributes.get("color")
        if linear is None or len(linear) != len(solid.vertices):
            return None
        full = np.iinfo(linear.dtype).max if linear.dtype.kind == "u" else 1.0
        light = np.clip(linear[:, :3].astype(np.float64) / full, 0, 1)
        encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        return np.asarray(np.rint(255 * encoded), np.uint8)
    if not visual.defined:
        return None
    found = np.asarray((visual.to_color() if visual.kind == "texture" else visual).vertex_colors, np.uint8)
    return found[:, :3].copy() if found.shape == (len(solid.vertices), 4) else None


class _Beside(Mapping[str, bytes]):
    """The files beside a mesh, by their plain names, which a mesh may name."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __getitem__(self, name: str) -> bytes:
        if Path(name).name != name:
            raise KeyError(name)
        try:
            with (self._folder / name).open("rb") as file:
                return file.read(_BYTES_A_PIXEL * max_pixels())
        except OSError:
            raise KeyError(name) from None

    def __iter__(self) -> Iterator[str]:
        return (entry.name for entry in self._folder.iterdir())

    def __len__(self) -> int:
        return sum(1 for _ in self)
