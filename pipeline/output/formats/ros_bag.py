"""Frames to a bag in MCAP, as ROS 2, Foxglove and others play it; ROS is not needed.

Of every frame: ``/camera/points`` (PointCloud2, organised), ``/camera/depth`` (Image, 32FC1), ``/camera/image`` (Image,
rgb8: the surface's colour without fringes) and ``/camera/camera_info`` (CameraInfo, of pictures as the lens made them).
Lengths are in m, in the optical frame of REP 103, which the messages call `FRAME_ID`.
"""

import os
from collections.abc import Iterable
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.calibration.lens import Lens
from pipeline.errors import OutputError
from pipeline.limits import check_mesh_size, open_plain
from pipeline.output.mesh import RangeGrid

#: Of the messages' headers.
FRAME_ID = "camera_optical_frame"
_NS = 1_000_000_000
_MISSING = "bags need the package rosbags: pip install 'colorphase[mcap]'"
_CLOUD = "sensor_msgs/msg/PointCloud2"
# NumPy's names of PointField's datatypes.
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def write_bag(folder: Path, grids: Iterable[RangeGrid], remarks: dict[str, str]) -> None:
    """Write frames as a bag: a folder with an MCAP file of its name, and ``metadata.yaml``.

    Parameters
    ----------
    folder : Path
        Made; it must not exist.
    grids : iterable of RangeGrid
        The frames in the order of time; one at a time is in memory.
    remarks : dict
        Their provenance: the bag's custom data.

    Raises
    ------
    OutputError
        The package that writes bags is missing.
    """
    try:
        from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer
        from rosbags.rosbag2.enums import CompressionFormat
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise OutputError(_MISSING) from None
    types = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    for name, value in remarks.items():
        writer.set_custom_data(name, value)
    with writer:
        topics: dict[str, Any] = {}
        for grid in grids:
            messages = _Messages(types.types, grid)
            for topic, message in messages.by_topic():
                kind = message.__msgtype__
                if topic not in topics:
                    topics[topic] = writer.add_connection(f"/camera/{topic}", kind, typestore=types)
                writer.write(topics[topic], messages.stamp_ns, types.serialize_cdr(message, kind))


def read_bag(path: Path, number: int | None = None) -> RangeGrid:
    """Return the points of a frame of a bag: of its PointCloud2 messages, by any program; lengths are in m there.

    Parameters
    ----------
    path : Path
        The MCAP file.
    number : int, optional
        Index of the frame, from 0; may be omitted for a bag of one frame.

    Raises
    ------
    ValueError
        It is damaged, holds no such frame, or no organised points of one topic; or the package that reads bags is
        missing.
    """
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ValueError(_MISSING) from None
    file: Any = _BagFile(path)  # what rosbags uses of a path
    try:
        with Reader(file) as reader:
            topics = [connection for connection in reader.connections if connection.msgtype == _CLOUD]
            if len(topics) != 1:
                raise ValueError(f"it has {len(topics)} topics of points, and one is read")
            count = topics[0].msgcount
            if number is None and count != 1:
                raise ValueError(f"it holds {count} frames: choose one by its number, from 0, as with --frame 0")
            if not 0 <= (number or 0) < count:
                raise ValueError(f"it has no frame {number}: its {count} are numbered from 0")
            _, _, data = next(islice(reader.messages(topics), number or 0, None))
        # The bag's own definitions of messages are not used: they would become a program.
        cloud: Any = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, _CLOUD)
        return RangeGrid.of_records(_records_of(cloud))
    except (ValueError, OSError, MemoryError):
        raise
    except Exception as error:  # its reader raises whatever damaged bytes lead to
        raise ValueError(f"it is damaged ({type(error).__name__})") from None


class _BagFile:
    """A bag as rosbags opens it: reads end where the file does, or a damaged length would be allocated."""

    suffix = ".mcap"

    def __init__(self, path: Path) -> None:
        self._path = path

    def exists(self) -> bool:
        return self._path.exists()

    def is_dir(self) -> bool:
        return False

    def open(self, _: str) -> BufferedReader:
        return _Bounded(open_plain(self._path).detach())


class _Bounded(BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        left = max(0, os.fstat(self.fileno()).st_size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


def _records_of(cloud: Any) -> npt.NDArray[np.void]:
    """Return the points of a message as (H, W) records."""
    height, width, step, row_step = (int(v) for v in (cloud.height, cloud.width, cloud.point_step, cloud.row_step))
    check_mesh_size(height * width, 0)
    fields = [field for field in cloud.fields if field.count == 1 and field.datatype in _KINDS]
    order = ">" if cloud.is_bigendian else "<"
    layout = np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": [order + _KINDS[field.datatype] for field in fields],
            "offsets": [int(field.offset) for field in fields],
            "itemsize": step,
        }
    )
    if row_step < width * step or cloud.data.size < height * row_step:
        raise ValueError(f"it is truncated: {width} times {height} points of {step} bytes are promised")
    rows = cloud.data[: height * row_step].reshape(height, row_step)[:, : width * step]
    return np.ascontiguousarray(rows).view(layout).reshape(height, width)


class _Messages:
    """A frame as messages."""

    def __init__(self, types: Any, grid: RangeGrid) -> None:
        self._types, self._grid = types, grid
        self.stamp_ns = round(grid.time_s * _NS)

    def by_topic(self) -> Iterable[tuple[str, Any]]:
        """Yield each topic and its message."""
        yield "points", self._points()
        yield "depth", self._image("32FC1", self._grid.depth * np.float32(0.001))
        if self._grid.texture is not None:
            yield "image", self._image("rgb8", self._grid.texture)
        if self._grid.camera is not None:
            yield "camera_info", self._camera_info(self._grid.camera)

    def _of(self, kind: str, **values: Any) -> Any:
        return self._types[kind](**values)

    def _header(self) -> Any:
        stamp = self._of("builtin_interfaces/msg/Time", sec=self.stamp_ns // _NS, nanosec=self.stamp_ns % _NS)
        return self._of("std_msgs/msg/Header", stamp=stamp, frame_id=FRAME_ID)

    def _points(self) -> Any:
        records = self._grid.records()
        fields = [
            self._of("sensor_msgs/msg/PointField", name=name, offset=4 * index, datatype=7, count=1)  # 7: FLOAT32
            for index, name in enumerate(records.dtype.names or ())
        ]
        height, width = records.shape
        step = records.dtype.itemsize
        return self._of(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(),
            height=height,
            width=width,
            fields=fields,
            is_bigendian=False,
            point_step=step,
            row_step=step * width,
            data=_bytes_of(records),
            is_dense=False,  # some are NaN
        )

    def _image(self, encoding: str, values: npt.NDArray[Any]) -> Any:
        height, width = values.shape[:2]
        return self._of(
            "sensor_msgs/msg/Image",
            header=self._header(),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=values.nbytes // height,
            data=_bytes_of(values),
        )

    def _camera_info(self, camera: Lens) -> Any:
        (width, height), bent = camera.size_px, camera.distortion
        whole = self._of(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._of(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(),
            height=height,
            width=width,
            distortion_model="plumb_bob" if len(bent) == 5 else "rational_polynomial",
            d=bent if len(bent) == 5 or bent[8:].any() else bent[:8],
            k=camera.matrix.ravel(),
            r=np.eye(3).ravel(),
            p=np.hstack([camera.matrix, np.zeros((3, 1))]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=whole,
        )


def _bytes_of(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    return np.ascontiguousarray(values).view(np.uint8).ravel()
