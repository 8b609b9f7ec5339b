"""The measured points of a frame to XYZ and CSV, one a line, and the camera's grid of them to NPZ.

XYZ is numbers alone, since the programs that read it agree on nothing else.
"""

import io
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.output.formats import Content, Heading, text_rows
from pipeline.output.mesh import COLOR, RangeGrid


def encode_xyz(grid: RangeGrid, heading: Heading) -> dict[str, Content]:
    """Return the points as lines of x, y and z, y up, and where there is a texture red, green and blue."""
    columns, row = _columns(grid)
    columns["y_mm"], columns["z_mm"] = -columns["y_mm"], -columns["z_mm"]
    names = [name for name in columns if name in ("x_mm", "y_mm", "z_mm", *COLOR)]
    return {".xyz": _rows({name: columns[name] for name in names}, [row[name] for name in names], " ").encode()}


def encode_csv(grid: RangeGrid, heading: Heading) -> dict[str, Content]:
    """Return the points as a table with the names of its columns in the first line, with all that is known of each."""
    columns, row = _columns(grid)
    return {".csv": f"{','.join(columns)}\n{_rows(columns, [*row.values()], ',')}".encode()}


def encode_npz(grid: RangeGrid, heading: Heading) -> dict[str, Content]:
    """Return the grid as NumPy's archive: points, texture and properties by their names, and remarks as text."""
    arrays: dict[str, Any] = {"points": grid.points, **grid.properties, **heading.remarks}
    if grid.texture is not None:
        arrays["texture"] = grid.texture
    if grid.camera is not None:
        arrays |= {"camera_matrix": grid.camera.matrix, "camera_distortion": grid.camera.distortion}
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return {".npz": file.getvalue()}


def _columns(grid: RangeGrid) -> tuple[dict[str, npt.NDArray[Any]], dict[str, str]]:
    """Return what is known of each measured pixel, and how it is written, by name."""
    known = np.isfinite(grid.depth)
    rows, columns = np.nonzero(known)
    table: dict[str, npt.NDArray[Any]] = {"row": rows, "column": columns}
    table |= {f"{axis}_mm": grid.points[known][:, k] for k, axis in enumerate("xyz")}
    if grid.texture is not None:
        table |= {name: grid.texture[known][:, k] for k, name in enumerate(COLOR)}
    table |= {name: values[known] for name, values in grid.properties.items()}
    return table, {name: "%d" if values.dtype.kind in "iu" else "%.7g" for name, values in table.items()}


def _rows(columns: dict[str, npt.NDArray[Any]], row: list[str], between: str) -> str:
    return text_rows(between.join(row) + "\n", np.stack([*columns.values()], axis=1).astype(np.float64))
