"""The options that say which part of a frame becomes its mesh."""

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from pipeline.cli.console import bounded
from pipeline.output.surface_mesh import MeshOptions


@Parameter(name="*")
@dataclass(frozen=True)
class MeshChoice:
    """What to leave out of meshes."""

    crop: Annotated[tuple[float, float, float, float, float, float] | None, Parameter(consume_multiple=True)] = None
    """Keep what is inside a box: two opposite corners, x0 y0 z0 x1 y1 z1, mm in the camera's frame (x right, y down, z
    away from it)."""
    background: Annotated[bool, Parameter(negative="--no-background")] = True
    """Keep the largest plane; --no-background leaves it out, as a wall or a table."""
    triangles: Annotated[int | None, Parameter(validator=bounded(1))] = None
    """The most triangles that a mesh may have; of a larger one vertices are left out."""
    smooth: bool = True
    """Move vertices to the surface through their neighbours; --no-smooth leaves each where it was measured."""

    def options(self) -> MeshOptions:
        """Return the same as a mesh takes it."""
        return MeshOptions(self.smooth, self.crop, not self.background, self.triangles)
