"""Still pictures of meshes and of frames of a ``result.zarr``, drawn without a screen."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.errors import OutputError, RenderError
from pipeline.files import write_atomically
from pipeline.models import LARGEST
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import write_mesh
from pipeline.output.pictures.drawing_process import Buffer, PictureJob, PictureOptions, draw_apart

#: Files of buffers in the folder of the process that draws.
_MADE: dict[Buffer, str] = {"depth": "depth.tiff", "normals": "normals.png"}
# A hundredth of what numbers may be here: the eye is some times as far away, so that it sees all.
_FARTHEST_MM = LARGEST / 100


def render_mesh(
    mesh: Mesh,
    path: str | Path,
    options: PictureOptions | None = None,
    *,
    buffers: Sequence[Buffer] = (),
    compared: Mesh | None = None,
    timeout_s: float = 120.0,
    remark: Callable[[str], None] = lambda line: None,
) -> str:
    """Draw a mesh off screen into a PNG file.

    Parameters
    ----------
    mesh : Mesh
        The mesh.
    path : str or Path
        The PNG file.
    options : PictureOptions, optional
        Viewpoint, colours and size.
    buffers : sequence of {"depth", "normals"}
        Images to write next to it, of the same view: ``NAME.depth.tiff``, float32, the depth before the eye along the
        line of sight in mm, NaN where nothing is; ``NAME.normals.png``, the normals to the right, up and towards the
        eye from -1 to 1 as 0 to 255, black where nothing is.
    compared : Mesh, optional
        Another mesh, the signed distance from which colours show.
    timeout_s : float
        Time after which drawing is given up, s.
    remark : callable
        Called with each line that the user should know about the picture.

    Returns
    -------
    str
        The renderer.

    Raises
    ------
    RenderError
        If the mesh is empty or lacks what colours would show, or the machine cannot draw.
    OutputError
        If a file cannot be written.

    Notes
    -----
    The scale bar is true at the depth of the middle of the object; what is nearer looks larger. A mesh in rad has no
    true proportions: its depth is scaled until the relief shows, and there is no scale bar.
    """
    refuse_empty(mesh)
    with tempfile.TemporaryDirectory() as folder:
        write_mesh(mesh, Path(folder, "mesh.ply"))
        job = {"mesh": "mesh.ply", "numbers": (0,)}
        return _draw(job, Path(folder), path, options, buffers, compared, timeout_s, remark)


def render_frame(
    location: str | Path,
    number: int,
    path: str | Path,
    options: PictureOptions | None = None,
    *,
    buffers: Sequence[Buffer] = (),
    compared: Mesh | None = None,
    timeout_s: float = 120.0,
    remark: Callable[[str], None] = lambda line: None,
) -> str:
    """Draw a frame of a ``result.zarr`` as `render_mesh` draws a mesh.

    Raises
    ------
    RenderError
        It shows no surface, or is damaged; or as `render_mesh`.
    """
    with tempfile.TemporaryDirectory() as folder:
        job = {"store": absolute_location(location), "numbers": (number,)}
        return _draw(job, Path(folder), path, options, buffers, compared, timeout_s, remark)


def refuse_empty(mesh: Mesh, what: str = "the mesh") -> None:
    """Refuse a mesh of which nothing can be seen.

    Raises
    ------
    RenderError
        It has no faces, no extent, or too large a one.
    """
    if not len(mesh.vertices):
        ours = "nothing of its frame was measured, colorphase inspect shows why"
        raise RenderError(f"{what} has no point: {ours if mesh.provenance else 'give another file'}")
    if not len(mesh.faces):
        raise RenderError(f"{what} has {len(mesh.vertices)} points and no faces: give one of triangles")
    farthest = float(np.abs(mesh.vertices).max())
    if farthest > _FARTHEST_MM:
        most = f"{_FARTHEST_MM:g} mm is the most"
        raise RenderError(f"{what} reaches {farthest:.1g} mm, and {most}: give its unit, or another file")
    if not np.ptp(mesh.vertices, axis=0).any():
        raise RenderError(f"the points of {what} all lie in one place: give another file")


def absolute_location(location: str | Path) -> str:
    """Return where a store is, whatever folder a process runs in."""
    return str(location) if "://" in str(location) else str(Path(location).absolute())


def write_compared(compared: Mesh | None, folder: Path) -> str | None:
    """Write the mesh that another one is compared with for the process that draws, and return the file's name.

    Raises
    ------
    RenderError
        It has no faces, or is not in mm.
    """
    if compared is None:
        return None
    refuse_empty(compared, "the mesh to compare with")
    if compared.unit != "mm":
        raise RenderError("the mesh to compare with is not in mm: decode with a calibration")
    write_mesh(compared, folder / "compared.ply")
    return "compared.ply"


def buffer_path(picture: str | Path, buffer: Buffer) -> Path:
    """Return the file of a buffer next to a picture.

    >>> buffer_path("face.png", "depth").name
    'face.depth.tiff'
    """
    return Path(picture).with_suffix(f".{_MADE[buffer]}")


def _draw(
    job: Mapping[str, object],
    folder: Path,
    path: str | Path,
    options: PictureOptions | None,
    buffers: Sequence[Buffer],
    compared: Mesh | None,
    timeout_s: float,
    remark: Callable[[str], None],
) -> str:
    options = options or PictureOptions()
    if options.moves:
        raise OutputError(f"{path} is a still picture, in which no eye moves: name it .mp4 for a film")
    more = {"options": options, "picture": "picture.png", "buffers": tuple(buffers)}
    drawn = PictureJob.model_validate({**job, **more, "compared": write_compared(compared, folder)})
    renderer = draw_apart(drawn, folder, timeout_s, remark=remark)
    write_atomically(path, (folder / "picture.png").read_bytes())
    for buffer in buffers:
        write_atomically(buffer_path(path, buffer), (folder / _MADE[buffer]).read_bytes())
    return renderer
