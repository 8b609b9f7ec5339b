"""Grids of points to PCD, the Point Cloud Library's format: organised, with NaN where nothing was measured.

References
----------
Point Cloud Library, The PCD file format, version 0.7.
"""

from pipeline.output.formats.file_text import Content, Heading
from pipeline.output.range_grid import RangeGrid


def encode_pcd(grid: RangeGrid, heading: Heading) -> dict[str, Content]:
    """Return a grid as a binary PCD file, its rows and columns kept."""
    records = grid.records()
    names = records.dtype.names or ()
    height, width = records.shape
    head = f"""# .PCD v0.7 - Point Cloud Data file format
{heading.comments("#")}VERSION 0.7
FIELDS {" ".join(names)}
SIZE {" ".join("4" * len(names))}
TYPE {" ".join("F" * len(names))}
COUNT {" ".join("1" * len(names))}
WIDTH {width}
HEIGHT {height}
VIEWPOINT 0 0 0 1 0 0 0
POINTS {width * height}
DATA binary
"""
    return {".pcd": head.encode() + records.tobytes()}
