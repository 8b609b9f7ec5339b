"""Depth as 16-bit pictures, PNG or TIFF, with what a level is worth.

Depth in mm is the level times `depth_step_mm`, which the picture says of itself: a PNG in a text chunk, a TIFF in its
ImageDescription, as JSON. Level 0 is no depth.
"""

import io
import json

import numpy as np

from pipeline.errors import OutputError
from pipeline.output.formats.file_text import Content, Heading
from pipeline.output.range_grid import RangeGrid

# 0 is kept for what has no depth.
_LEVELS = 2**16 - 1
#: Of a picture's remarks: what a level is worth, mm.
STEP = "depth_step_mm"


def depth_step_mm(farthest_mm: float) -> float:
    """Return the finest step of 1, 2 or 5 times a power of ten with which a depth fits into 16 bits, mm."""
    finest = max(farthest_mm, 1e-3) / _LEVELS
    power = 10.0 ** np.floor(np.log10(finest))
    return float(next(round(digit * power, 12) for digit in (1, 2, 5, 10) if digit * power >= finest))


def _levels(grid: RangeGrid, heading: Heading) -> np.ndarray:
    step = float(heading.remarks[STEP])
    depth = grid.depth
    known = np.isfinite(depth)
    levels = np.rint(np.where(known, depth, 0) / step)
    if levels.size and levels.max() > _LEVELS:
        raise OutputError(f"depth reaches {depth[known].max():g} mm, which 16 bits of {step:g} mm do not hold")
    return levels.astype(np.uint16)


def encode_depth_png(grid: RangeGrid, heading: Heading) -> dict[str, Content]:
    """Return a grid's depth as a PNG file of 16 bits, remarks in its text chunks.

    Raises
    ------
    OutputError
        The depth does not fit into the step.
    """
    from PIL import Image, PngImagePlugin  # only needed here

    text = PngImagePlugin.PngInfo()
    for name, value in heading.remarks.items():
        text.add_text(name, value)
    file = io.BytesIO()
    Image.fromarray(_levels(grid, heading)).save(file, "PNG", pnginfo=text, compress_level=3)
    return {".png": file.getvalue()}


def encode_depth_tiff(grid: RangeGrid, heading: Heading) -> dict[str, Content]:
    """Return a grid's depth as a TIFF file of 16 bits, remarks in its description.

    Raises
    ------
    OutputError
        The depth does not fit into the step.
    """
    from PIL import Image  # only needed here

    file = io.BytesIO()
    picture = Image.fromarray(_levels(grid, heading))
    picture.save(file, "TIFF", description=json.dumps(heading.remarks), compression="tiff_adobe_deflate")
    return {".tiff": file.getvalue()}
