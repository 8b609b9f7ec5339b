"""Depth as 16-bit pictures, PNG or TIFF, with what a level is worth and the camera's lens, and back.

Depth in mm is the level times `depth_step_mm`, which the picture says of itself: a PNG in a text chunk, a TIFF in its
ImageDescription, as JSON. Level 0 is no depth. `camera`, as JSON, is the lens by which a pixel's depth becomes a point.
"""

import io
import json

import numpy as np
import numpy.typing as npt

from pipeline.calibration.model import Lens
from pipeline.errors import OutputError
from pipeline.limits import check_mesh_size
from pipeline.output.formats.file_text import Content, Heading
from pipeline.output.range_grid import RangeGrid

# 0 is kept for what has no depth.
_LEVELS = 2**16 - 1
#: Of a picture's remarks: what a level is worth, mm.
STEP = "depth_step_mm"
#: And the lens, as JSON.
CAMERA = "camera"
# The tag of a TIFF's ImageDescription.
_DESCRIPTION = 270


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


def decode_depth(data: bytes) -> RangeGrid:
    """Return the points of a depth picture that says what a level is worth, and by which lens it was seen.

    Raises
    ------
    ValueError
        It is damaged, larger than `max_pixels` allows, or another picture.
    """
    levels, remarks = _levels_and_remarks(data)
    if not {STEP, CAMERA} <= remarks.keys():
        raise ValueError(f"it says no {STEP} or no {CAMERA}: give one that colorphase export has written")
    try:
        step, lens = float(remarks[STEP]), Lens.model_validate_json(remarks[CAMERA])
    except ValueError:
        raise ValueError(f"its {STEP} or its {CAMERA} cannot be read") from None
    if lens.size_px != levels.shape[::-1] or not 0 < step < np.inf:
        raise ValueError(f"its {CAMERA} is of another size than the picture, or its {STEP} is not above 0")
    depth = np.where(levels > 0, levels * np.float32(step), np.float32(np.nan))
    return RangeGrid(np.concatenate([lens.rays() * depth[..., None], depth[..., None]], axis=-1), camera=lens)


def _levels_and_remarks(data: bytes) -> tuple[npt.NDArray[np.uint16], dict[str, str]]:
    """Return the levels of a picture of 16 bits, and what it says of itself."""
    from PIL import Image, TiffImagePlugin, UnidentifiedImageError  # only needed here

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "TIFF")) as picture:
            check_mesh_size(picture.width * picture.height, 0)
            if not picture.mode.startswith("I"):
                raise ValueError("it is no picture of depth: that has one channel of 16 bits")
            if isinstance(picture, TiffImagePlugin.TiffImageFile):
                said = json.loads(picture.tag_v2.get(_DESCRIPTION, "{}"))
            else:
                said = picture.info
            return np.asarray(picture).astype(np.uint16), {str(name): str(value) for name, value in said.items()}
    except ValueError:
        raise
    except UnidentifiedImageError:
        raise ValueError("it is no PNG and no TIFF picture") from None
    except Exception as error:  # its readers raise whatever damaged bytes lead to
        raise ValueError(f"it is damaged ({type(error).__name__})") from None
