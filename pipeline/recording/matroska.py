"""FFV1 in Matroska, written so that what was committed can be read whatever happens later.

FFmpeg's own muxer keeps a file's length to itself until the end. Here the head, which tells it, is always of one size,
and a commit writes it anew in place: that needs no room, and what comes behind the length it tells is not in the file.

References
----------
Matroska: RFC 9559. EBML: RFC 8794. FFV1: RFC 9043.
"""

import os
import struct
from array import array
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import DamageError
from pipeline.files import sync
from pipeline.footage.recording_clusters import CLUSTER, cluster, element, length
from pipeline.footage.recording_tags import RecordingTags
from pipeline.models import ImageArray
from tikernels.errors import ShapeError
from tikernels.raw.pixel_format import PixelFormat

_EBML = bytes.fromhex("1A45DFA3")
_SEGMENT = bytes.fromhex("18538067")
_VOID = bytes.fromhex("EC")
_SEEK_HEAD, _SEEK, _SEEK_ID, _SEEK_POSITION = (bytes.fromhex(id) for id in ("114D9B74", "4DBB", "53AB", "53AC"))
_INFO, _TIMESTAMP_SCALE, _DURATION = (bytes.fromhex(id) for id in ("1549A966", "2AD7B1", "4489"))
_MUXING_APP, _WRITING_APP = (bytes.fromhex(id) for id in ("4D80", "5741"))
_TRACKS, _TRACK_ENTRY = (bytes.fromhex(id) for id in ("1654AE6B", "AE"))
_TRACK_NUMBER, _TRACK_UID, _TRACK_TYPE = (bytes.fromhex(id) for id in ("D7", "73C5", "83"))
_LACING, _DEFAULT_DURATION, _CODEC_ID, _CODEC_PRIVATE = (bytes.fromhex(id) for id in ("9C", "23E383", "86", "63A2"))
_VIDEO, _WIDTH, _HEIGHT, _INTERLACED = (bytes.fromhex(id) for id in ("E0", "B0", "BA", "9A"))
_TAGS, _TAG, _TARGETS, _SIMPLE_TAG = (bytes.fromhex(id) for id in ("1254C367", "7373", "63C0", "67C8"))
_TAG_NAME, _TAG_STRING = (bytes.fromhex(id) for id in ("45A3", "4487"))
_CUES, _CUE_POINT, _CUE_TIME = (bytes.fromhex(id) for id in ("1C53BB6B", "BB", "B3"))
_CUE_PLACE, _CUE_TRACK, _CUE_CLUSTER = (bytes.fromhex(id) for id in ("B7", "F7", "F1"))

_VIDEO_TYPE, _PROGRESSIVE = 1, 2
_NS_A_MS = 1_000_000


class MatroskaWriter:
    """Encode frames and append them to a file.

    Parameters
    ----------
    path : Path
        The file, which must not exist.
    size_px : (int, int)
        Width and height of every frame.
    format, tags
        How they are stored, and what the file says of itself.

    Raises
    ------
    OSError
        The file cannot be written.
    ShapeError
        FFV1 does not hold such values.
    """

    #: How many threads may call `write`: the encoder has several of its own.
    most_threads = 1

    def __init__(self, path: Path, size_px: tuple[int, int], format: PixelFormat, tags: RecordingTags) -> None:
        import av  # slow to import, and only needed here

        if format.dtype == np.float32:
            raise ShapeError("Matroska recordings hold 8 to 16 bits: record floats to .zarr")
        deep = format.dtype == np.uint16
        if format.layout == "bayer":
            self._pixels = "gray16le" if deep else "gray"
        else:
            self._pixels = "gbrp16le" if deep else "bgr0"
        self._tags = tags
        self._encoder: Any = av.CodecContext.create("ffv1", "w")
        self._encoder.width, self._encoder.height = size_px
        self._encoder.pix_fmt = self._pixels
        self._encoder.time_base, self._encoder.framerate = Fraction(1, 1000), tags.rate_hz
        self._encoder.thread_type = "SLICE"  # so that each frame comes out when it goes in
        # Every frame by itself, in slices that are coded in parallel, each with a checksum.
        self._encoder.options = {"g": "1", "level": "3", "slicecrc": "1", "slices": "16"}
        self._encoder.open()
        self._clusters = array("Q")  # where each frame begins in the segment
        self.n_frames = 0  # of those committed
        self._n_bytes = 0  # of what was written
        self._end = 0  # of what was committed
        self._head, self._segment = self._head_of(0, 0, None)
        self._file = path.open("xb", buffering=0)
        try:
            self._append(self._head)
            self.commit(0)
            sync(path.parent)
        except OSError:
            self._file.close()
            path.unlink()
            raise

    def write(self, number: int, frame: ImageArray) -> int:
        """Append a frame, one after another, and return how many bytes that took."""
        import av

        coded = av.VideoFrame(frame.shape[1], frame.shape[0], self._pixels)
        if self._pixels == "bgr0":
            _plane(coded, 0, (*frame.shape[:2], 4), np.uint8)[..., :3] = frame[..., ::-1]
        elif self._pixels == "gbrp16le":
            for i, color in enumerate((1, 2, 0)):
                _plane(coded, i, frame.shape[:2], np.uint16)[...] = frame[..., color]
        else:
            _plane(coded, 0, frame.shape, frame.dtype)[...] = frame
        coded.time_base, coded.pts = Fraction(1, 1000), self._tags.stamp(number)
        (packet,) = self._encoder.encode(coded)
        self._clusters.append(self._n_bytes - self._segment)
        coded = cluster(self._tags.stamp(number), bytes(packet))
        self._append(coded)
        return len(coded)

    def commit(self, n_frames: int) -> None:
        """Make the file end with what has been written, on the disk: first the frames, then the length."""
        head, _ = self._head_of(n_frames, self._n_bytes, None)
        os.fsync(self._file.fileno())
        _write(self._file, 0, head)
        os.fsync(self._file.fileno())
        self.n_frames, self._end = n_frames, self._n_bytes

    def close(self) -> None:
        """Cut off what was not committed, and list where frames are, for players; a second call does nothing."""
        if self._file.closed:
            return
        try:
            os.truncate(self._file.fileno(), self._end)
            del self._clusters[self.n_frames :]
            cues = element(_CUES, map(self._cue, range(self.n_frames)))
            try:
                _write(self._file, self._end, cues)
                head, _ = self._head_of(self.n_frames, self._end + len(cues), self._end - self._segment)
                _write(self._file, 0, head)
            except OSError:  # no room; it reads as well without
                os.truncate(self._file.fileno(), self._end)
        finally:
            self._file.close()

    def _cue(self, number: int) -> bytes:
        place = [element(_CUE_TRACK, 1), element(_CUE_CLUSTER, self._clusters[number])]
        return element(_CUE_POINT, [element(_CUE_TIME, self._tags.stamp(number)), element(_CUE_PLACE, place)])

    def _append(self, data: bytes) -> None:
        _write(self._file, self._n_bytes, data)
        self._n_bytes += len(data)

    def _head_of(self, n_frames: int, end: int, cues: int | None) -> tuple[bytes, int]:
        """Return the head of a file that ends there, and where its segment's content begins; always of one size."""
        tags = [
            element(_SIMPLE_TAG, [element(_TAG_NAME, name.encode()), element(_TAG_STRING, value.encode())])
            for name, value in self._tags.write().items()
        ]
        seek = element(_SEEK_HEAD, [element(_SEEK, [element(_SEEK_ID, _CUES), element(_SEEK_POSITION, cues or 0)])])
        if cues is None:
            seek = element(_VOID, bytes(len(seek) - len(_VOID) - 8))
        info = [
            element(_TIMESTAMP_SCALE, _NS_A_MS),
            element(_DURATION, struct.pack(">d", self._tags.stamp(n_frames))),
            element(_MUXING_APP, b"colorphase"),
            element(_WRITING_APP, b"colorphase"),
        ]
        video = [
            element(_WIDTH, self._encoder.width),
            element(_HEIGHT, self._encoder.height),
            element(_INTERLACED, _PROGRESSIVE),
        ]
        track = [
            element(_TRACK_NUMBER, 1),
            element(_TRACK_UID, 1),
            element(_TRACK_TYPE, _VIDEO_TYPE),
            element(_LACING, 0),
            element(_DEFAULT_DURATION, round(1000 * _NS_A_MS / self._tags.rate_hz)),
            element(_CODEC_ID, b"V_FFV1"),
            element(_CODEC_PRIVATE, bytes(self._encoder.extradata)),
            element(_VIDEO, video),
        ]
        content = b"".join(
            [
                seek,
                element(_INFO, info),
                element(_TRACKS, [element(_TRACK_ENTRY, track)]),
                element(_TAGS, [element(_TAG, [element(_TARGETS, []), *tags])]),
            ]
        )
        begin = _EBML_HEAD + _SEGMENT
        segment = len(begin) + 8
        return begin + length(max(end - segment, len(content))) + content, segment


def cut_off(path: Path) -> int:
    """Cut off what a program that was killed had written and not committed; return how many frames stay.

    Raises
    ------
    DamageError
        It is no file of ours.
    OSError
        It cannot be written.
    """
    begin = _EBML_HEAD + _SEGMENT
    with path.open("r+b") as file:
        head = file.read(len(begin) + 8)
        if len(head) < len(begin) + 8 and begin.startswith(head[: len(begin)]):
            return 0  # it was killed while it made this
        if not head.startswith(begin):
            raise DamageError(f"{path.name} does not begin as a recording does")
        end = len(head) + int.from_bytes(head[len(begin) + 1 :], "big")
        n_frames, place = 0, len(head)
        while place < end:
            file.seek(place)
            element_head = file.read(12)
            # An element's first byte tells how long its name is; ours have lengths of eight bytes.
            id_bytes = 9 - element_head[0].bit_length() if element_head and element_head[0] else 12
            if len(element_head) < id_bytes + 8:
                break
            n_frames += element_head.startswith(CLUSTER)
            place += id_bytes + 8 + int.from_bytes(element_head[id_bytes + 1 : id_bytes + 8], "big")
        size = file.seek(0, os.SEEK_END)
        if n_frames and (place != end or end > size):
            raise DamageError(f"{path.name} is damaged at byte {min(place, size)}")
        if n_frames:
            file.truncate(end)
            os.fsync(file.fileno())
    return n_frames


# Of the fourth version of Matroska, to be read by whoever knows the second.
_EBML_FIELDS: dict[str, int | bytes] = {
    "4286": 1, "42F7": 1, "42F2": 4, "42F3": 8, "4282": b"matroska", "4287": 4, "4285": 2,
}  # fmt: skip
_EBML_HEAD = element(_EBML, [element(bytes.fromhex(id), value) for id, value in _EBML_FIELDS.items()])


def _write(file: Any, position: int, data: bytes) -> None:
    """Write all of it to an unbuffered file."""
    rest = memoryview(data)
    file.seek(position)
    while rest:
        rest = rest[file.write(rest) :]


def _plane(frame: Any, plane: int, shape: tuple[int, ...], dtype: npt.DTypeLike) -> ImageArray:
    """Return a plane of a frame of FFmpeg to write into."""
    size = np.dtype(dtype).itemsize
    strides = (frame.planes[plane].line_size, size * (shape[2] if len(shape) == 3 else 1), size)
    return np.ndarray(shape, dtype, frame.planes[plane], 0, strides[: len(shape)])
