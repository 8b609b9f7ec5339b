"""Grids of points to PCD, the Point Cloud Library's format, and back: organised, NaN where nothing was measured.

References
----------
Point Cloud Library, The PCD file format, version 0.7.
"""

import re

import numpy as np
import numpy.typing as npt

from pipeline.limits import check_mesh_size
from pipeline.output.formats.file_text import Content, Heading
from pipeline.output.range_grid import RangeGrid

# Comments and a line for each part of the header.
_LONGEST_HEAD = 2**16
_KINDS = {"F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8"}


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
    """Return the grid of points that an organised PCD file holds, binary or ASCII; its places are in m there.

    Raises
    ------
    ValueError
        It is truncated, larger than `max_pixels` allows, compressed, or no grid.
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
    elif kind != b"binary":
        raise ValueError("it is compressed: `pcl_convert_pcd_ascii_binary IN OUT 1` writes it plain")
    if len(body) < width * height * record.itemsize:
        raise ValueError(f"it is truncated: its header promises {width * height} points of {record.itemsize} bytes")
    values = np.frombuffer(body, record, width * height).reshape(height, width)
    return RangeGrid.of_records(values)


def _record(said: dict[str, list[str]]) -> np.dtype:
    """Return the layout of a point by a header's lines."""
    names, sizes, kinds = (said.get(name, []) for name in ("FIELDS", "SIZE", "TYPE"))
    if {*said.get("COUNT", [])} - {"1"} or not len(names) == len(sizes) == len(kinds) == len({*names}):
        raise ValueError("its fields are not single numbers, each with a name, a size and a type")
    types = [kind + size for kind, size in zip(kinds, sizes, strict=True)]
    if not {*types} <= _KINDS or not {*"xyz"} <= {*names}:
        raise ValueError("its points have no x, y and z, or a field is of no known type")
    return np.dtype([(name, "<" + kind.lower()) for name, kind in zip(names, types, strict=True)])


def _from_text(record: np.dtype, numbers: npt.NDArray[np.float64]) -> tuple[np.dtype, bytes]:
    """Return points that were told in words as their bytes, and their layout: a colour's bits are a whole number."""
    names = record.names or ()
    table = numbers[: numbers.size // len(names) * len(names)].reshape(-1, len(names))
    layout = np.dtype([(name, "<u4" if name == "rgb" else record[name]) for name in names])
    rows = np.empty(len(table), layout)
    with np.errstate(invalid="ignore", over="ignore"):
        for name, column in zip(names, table.T, strict=True):
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
