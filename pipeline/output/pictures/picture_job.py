"""What is to be drawn, as the process that draws is told."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.models import Model, Signed
from pipeline.output.pictures.color_meaning import Colors
from pipeline.output.pictures.viewpoint import CameraPath, View, Viewpoint

Buffer = Literal["depth", "normals"]

#: What software renderers, and H.264, can do.
MOST_SIDE_PX = 8192


class PictureOptions(Model):
    """How a surface is drawn, in a still and in a film.

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
    fps : float
        A film's pictures a second.
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
    fps: Annotated[float, Field(ge=0.1, le=1000)] = 30.0
    seconds: Annotated[float, Field(ge=0.1, le=3600)] = 4.0
    size_px: tuple[Annotated[int, Field(ge=16, le=MOST_SIDE_PX)], Annotated[int, Field(ge=16, le=MOST_SIDE_PX)]] = (
        1280,
        960,
    )

    @property
    def moves(self) -> bool:
        """Whether the eye does."""
        return self.path is not None or self.turn_deg != 0 or self.sway_deg != 0


class FilmPart(Model):
    """Some pictures of a film, in a file of their own."""

    first: int
    stop: int
    path: str


class PictureJob(Model):
    """What the process that draws is told.

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
        Files to write beside it, in its folder: ``depth.tiff``, ``normals.png``.
    parts : tuple of FilmPart
        Those of a film to draw.
    compared : str, optional
        The PLY file of another mesh, the distance from which colours show.
    """

    options: PictureOptions
    mesh: str | None = None
    store: str | None = None
    numbers: tuple[int, ...]
    picture: str | None = None
    buffers: tuple[Buffer, ...] = ()
    parts: tuple[FilmPart, ...] = ()
    compared: str | None = None

    @model_validator(mode="after")
    def _one_subject(self) -> "PictureJob":
        if (self.mesh is None) == (self.store is None):
            raise ValueError("give a mesh or a store")
        return self
