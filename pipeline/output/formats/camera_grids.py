"""The camera's grid of points to PCD, and its depth to 16-bit PNG or TIFF; and back.

Depth in mm is the level times `depth_step_mm`, which the picture states: a PNG in a text chunk, a TIFF in its
ImageDescription, as JSON. Level 0 is no depth. `camera`, as JSON, is the lens by which a pixel's depth becomes a point.
A PCD file is organised, NaN where nothing was measured.

References
----------
Point Cloud Library, The PCD file format, version 0.7.
"""

import io
import json
import re

import numpy as np
import numpy.typing as npt

from pipeline.calibration.lens import Lens
from pipeline.errors import OutputError
from pipeline.limits import check_mesh_size
from pipeline.output.formats import Content, Heading
from pipeline.output.mesh import RangeGrid

# 0 is kept for what has no depth.
_LEVELS = 2**16 - 1
#: Of a picture's remarks: what a level is worth, mm.
STEP = "depth_step_mm"
#: And the lens, as JSON.
CAMERA = "camera"
# The tag of a TIFF's ImageDescription.
_DESCRIPTION = 270

# Comments and a line for each part of the header.
_LONGEST_HEAD = 2**16
_KINDS = {"F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8"}


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
    """Return the points of a depth picture that states its depth per level and its lens.

    Raises
    ------
    ValueError
        It is damaged, larger than `max_pixels` allows, or another picture.
    """
    levels, remarks = _levels_and_remarks(data)
    if not {STEP, CAMERA} <= remarks.keys():
        raise ValueError(f"it has no {STEP} or no {CAMERA}: give one that colorphase export has written")
    try:
        step, lens = float(remarks[STEP]), Lens.model_validate_json(remarks[CAMERA])
    except ValueError:
        raise ValueError(f"its {STEP} or its {CAMERA} cannot be read") from None
    if lens.size_px != levels.shape[::-1] or not 0 < step < np.inf:
        raise ValueError(f"its {CAMERA} is of another size than the picture, or its {STEP} is not above 0")
    depth = np.where(levels > 0, levels * np.float32(step), np.float32(np.nan))
    return RangeGrid(np.concatenate([lens.rays() * depth[..., None], depth[..., None]], axis=-1), camera=lens)


def _levels_and_remarks(data: bytes) -> tuple[npt.NDArray[np.uint16], dict[str, str]]:
    """Return the levels of a picture of 16 bits, and its remarks."""
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
    except (ValueError, MemoryError):
        raise
    except UnidentifiedImageError:
        raise ValueError("it is no PNG and no TIFF picture, or damaged") from None
    except Exception as error:  # its readers raise whatever damaged bytes lead to
        raise ValueError(f"it is damaged ({type(error).__name__})") from None


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


def decode_pcd(data: bytes) -> RangeGrid:
    """Return the grid of points that an organised PCD file holds, in any of its encodings; its places are in m there.

    Raises
    ------
    ValueError
        It is truncated, larger than `max_pixels` allows, or no grid.
    """
    head, mark, rest = data[:_LONGEST_HEAD].partition(b"\nDATA ")
    if not mark:
        raise ValueError(f"its header has no end within {_LONGEST_HEAD} bytes")
    kind = rest.split(b"\n", 1)[0].strip()
    body = data[len(head) + len(mark) + rest.find(b"\n") + 1 :]
    lines = (line.split() for line in head.decode("ascii", "replace").splitlines())
    said = {line[0]: line[1:] for line in lines if line and not line[0].startswith("#")}
    record = _record(said)
    width, height = (_whole(said, name) for name in ("WIDTH", "HEIGHT"))
    check_mesh_size(width * height, 0)
    if kind == b"ascii":
        record, body = _from_text(record, np.array(body.split(), np.float64))
    elif kind == b"binary_compressed":
        body = _decompressed(body, record, width * height)
    elif kind != b"binary":
        raise ValueError(f"its data is {kind.decode('ascii', 'replace')[:80]!r}: save it as binary")
    if len(body) < width * height * record.itemsize:
        raise ValueError(f"it is truncated: its header promises {width * height} points of {record.itemsize} bytes")
    values = np.frombuffer(body, record, width * height).reshape(height, width)
    return RangeGrid.of_records(values)


def _record(said: dict[str, list[str]]) -> np.dtype:
    """Return the layout of a point by a header's lines."""
    names, sizes, kinds = (said.get(name, []) for name in ("FIELDS", "SIZE", "TYPE"))
    counts = said.get("COUNT", ["1"] * len(names))
    # What fills gaps is called _ each time.
    names = [f"_{index}" if name == "_" else name for index, name in enumerate(names)]
    if not len(names) == len(sizes) == len(kinds) == len(counts) == len({*names}):
        raise ValueError("its fields do not each have a name of their own, a size, a type and a count")
    types = [kind + size for kind, size in zip(kinds, sizes, strict=True)]
    single = {name for name, count in zip(names, counts, strict=True) if count == "1"}
    if not {*types} <= _KINDS or not {*"xyz"} <= single or not all(re.fullmatch("[0-9]{1,4}", n) for n in counts):
        raise ValueError("its points have no x, y and z, or a field is of no known type")
    columns = zip(names, types, counts, strict=True)
    return np.dtype([(name, "<" + kind.lower(), () if n == "1" else (int(n),)) for name, kind, n in columns])


def _decompressed(body: bytes, record: np.dtype, count: int) -> bytes:
    """Return the points of a compressed file, in which each field of all points follows the one before.

    The compression is LZF: a byte below 32 is followed by that many bytes and one more; another one begins a
    repetition, its upper three bits how many bytes, its lower five and the byte that follows how far back.
    """
    packed, whole = (int.from_bytes(body[at : at + 4], "little") for at in (0, 4))
    if whole != count * record.itemsize or len(body) < 8 + packed:
        raise ValueError(f"it is truncated: its header promises {count} points of {record.itemsize} bytes")
    packed_bytes, at, out = body[8 : 8 + packed], 0, bytearray()
    try:
        while at < packed:
            control = packed_bytes[at]
            at += 1
            if control < 32:
                out += packed_bytes[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed_bytes[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - packed_bytes[at] - 1
            at += 1
            if start < 0 or len(out) > whole:
                raise ValueError("it is damaged: its compressed data repeats what is not there")
            piece = out[start : start + length + 2]
            out += (piece * (-(-(length + 2) // len(piece))))[: length + 2]
    except IndexError:
        raise ValueError("it is truncated: its compressed data ends early") from None
    if len(out) != whole:
        raise ValueError(f"it is damaged: {len(out)} of {whole} bytes are in its compressed data")
    points, first = np.empty(count, record), 0
    for name in record.names or ():
        size = record[name].itemsize
        column = np.frombuffer(out, record[name].base, count * size // record[name].base.itemsize, first)
        points[name] = column.reshape(points[name].shape)
        first += count * size
    return points.tobytes()


def _from_text(record: np.dtype, numbers: npt.NDArray[np.float64]) -> tuple[np.dtype, bytes]:
    """Return points that were given as text as their bytes, and their layout: a colour's bits are a whole number."""
    names = record.names or ()
    widths = [int(np.prod(record[name].shape)) for name in names]
    table = numbers[: numbers.size // sum(widths) * sum(widths)].reshape(-1, sum(widths))
    layout = np.dtype([(name, "<u4" if name == "rgb" else record[name]) for name in names])
    rows = np.empty(len(table), layout)
    with np.errstate(invalid="ignore", over="ignore"):
        for name, width, end in zip(names, widths, np.cumsum(widths), strict=True):
            column = table[:, end - width : end].reshape(rows[name].shape)
            rows[name] = _float_bits(column) if name == "rgb" and record[name].kind == "f" else column
    return layout, rows.tobytes()


def _float_bits(values: npt.NDArray[np.float64]) -> npt.NDArray[np.uint32]:
    """Return the bits of numbers as float32, subnormal ones too: a processor may be set to take those for 0."""
    small = np.rint(np.abs(values) * 2.0**149)
    return np.where(np.abs(values) < 2.0**-126, small, values.astype(np.float32).view(np.uint32)).astype(np.uint32)


def _whole(said: dict[str, list[str]], name: str) -> int:
    value = " ".join(said.get(name, []))
    if not re.fullmatch("[0-9]{1,10}", value):
        raise ValueError(f"its header has no {name}")
    return int(value)
