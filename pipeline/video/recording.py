"""Our own lossless recordings: FFV1 in Matroska, or Zarr; `docs/footage.md` defines both."""

import os
import secrets
import shutil
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from pipeline.errors import FootageError, OutputError
from pipeline.files import explain
from pipeline.video.stored import BadFrame, Frames, StoredAs, StoredFrame
from pipeline.video.tags import VERSION, RecordingTags, rate_of
from tikernels.errors import ShapeError
from tikernels.pixel_format import PixelFormat

_ATTRIBUTE = "colorphase_recording"
_FRAMES = "frames"
# Frames by which a Zarr array grows; what is left over is cut off at the end.
_GROWTH = 1024


class Recorder:
    """Write frames without loss, under their final name only once all of them are there.

    Parameters
    ----------
    path : str or Path
        ``.mkv`` for FFV1 in Matroska (8 to 16 bits), ``.zarr`` for Zarr; it must not exist.
    format : PixelFormat
        How frames come: RGB in one (H, W, 3) plane, or a Bayer mosaic.
    transfer : {"linear", "srgb", "bt709"}, optional
        How light is encoded, if that is known.
    rate_hz : int or Fraction
        Frames a second, up to 500: for players; frames are known by their numbers.

    Raises
    ------
    OutputError
        The name has another ending, or is taken.
    ShapeError
        Such frames, this transfer or this rate cannot be recorded.
    """

    def __init__(
        self,
        path: str | Path,
        format: PixelFormat,
        *,
        transfer: str | None = None,
        rate_hz: int | Fraction = 30,
    ) -> None:
        self._path = Path(path)
        if (format.layout, format.channels, format.shift) not in (("rgb", "rgb", 0), ("bayer", "rgb", 0)):
            raise ShapeError("recordings hold RGB in one plane, or a Bayer mosaic: develop other frames first")
        writers: dict[str, type[_Writer]] = {".mkv": _MatroskaWriter, ".zarr": _ZarrWriter}
        suffix = self._path.suffix.lower()
        if suffix not in writers:
            raise OutputError(f"cannot record to {path}: the name must end in {' or '.join(writers)}")
        if self._path.exists():
            raise OutputError(f"cannot record to {path}: it exists, choose another name")
        self._format = format
        self._temporary = self._path.with_name(f".{secrets.token_hex(8)}.part{suffix}")
        self._new_writer = writers[suffix]
        self._tags = RecordingTags(
            Fraction(rate_hz), transfer, format.bayer if format.layout == "bayer" else None, format.bits
        )
        self._writer: _Writer | None = None
        self._shape: tuple[int, ...] = ()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, error: object, *_: object) -> None:
        """Finish the recording, or leave nothing after an error."""
        if error is None:
            self.close()
        else:
            self.discard()

    def add(self, frame: npt.NDArray[Any]) -> None:
        """Write one frame.

        Parameters
        ----------
        frame : (H, W, 3) RGB or (H, W) mosaic
            Levels, of the format's type.

        Raises
        ------
        ShapeError
            It has another shape or type than the format says, or than the first frame.
        OutputError
            The disk is full, or the folder cannot be written.
        """
        shape = self._format.plane_shapes(*frame.shape[:2])[0] if frame.ndim >= 2 else ()
        if frame.shape != (self._shape or shape) or frame.dtype != self._format.dtype:
            expected = self._shape or ("(H, W, 3)" if self._format.layout == "rgb" else "(H, W)")
            raise ShapeError(f"frame is {frame.shape} {frame.dtype}, expected {expected} {self._format.dtype}")
        try:
            if self._writer is None:
                self._writer = self._new_writer(self._temporary, frame, self._format, self._tags)
                self._shape = frame.shape
            self._writer.add(frame)
        except OSError as error:
            self.discard()
            raise OutputError(f"cannot record to {self._path}: {explain(error)}") from error

    def close(self) -> None:
        """Finish: only now the recording stands under its name. Without frames there is none.

        Raises
        ------
        OutputError
            The disk is full, or the folder cannot be written.
        """
        if self._writer is None:
            return
        try:
            self._writer.close()
            os.replace(self._temporary, self._path)
            self._writer = None
        except OSError as error:
            raise OutputError(f"cannot record to {self._path}: {explain(error)}") from error
        finally:
            self.discard()

    def discard(self) -> None:
        """Stop, and leave nothing."""
        if self._writer is not None:
            with suppress(OSError, EOFError):  # it is thrown away, and an encoder ends but once
                self._writer.close()
            self._writer = None
        if self._temporary.is_dir():
            shutil.rmtree(self._temporary, ignore_errors=True)
        else:
            with suppress(OSError):  # where the folder is unreachable nothing was left in it
                self._temporary.unlink(missing_ok=True)


class _Writer(Protocol):
    def __init__(self, path: Path, first: npt.NDArray[Any], format: PixelFormat, tags: RecordingTags, /) -> None: ...

    def add(self, frame: npt.NDArray[Any]) -> None: ...

    def close(self) -> None: ...


class _MatroskaWriter:
    def __init__(self, path: Path, first: npt.NDArray[Any], format: PixelFormat, tags: RecordingTags) -> None:
        import av  # slow to import, and only needed here

        if format.dtype == np.float32:
            raise ShapeError("Matroska recordings hold 8 to 16 bits: record floats to .zarr")
        deep = format.dtype == np.uint16
        if format.layout == "bayer":
            self._pixels = "gray16le" if deep else "gray"
        else:
            self._pixels = "gbrp16le" if deep else "bgr0"
        self._tags = tags
        self._n_frames = 0
        self._container = av.open(f"file:{path.absolute()}", "w", format="matroska")
        self._container.metadata.update(tags.write())
        # Every frame by itself, in slices that are coded in parallel, each with a checksum.
        options = {"g": "1", "level": "3", "slicecrc": "1", "slices": "16"}
        self._stream: Any = self._container.add_stream("ffv1", rate=tags.rate_hz, options=options)
        self._stream.height, self._stream.width = first.shape[:2]
        self._stream.pix_fmt = self._pixels
        self._stream.codec_context.time_base = Fraction(1, 1000)

    def add(self, frame: npt.NDArray[Any]) -> None:
        import av

        coded = av.VideoFrame(frame.shape[1], frame.shape[0], self._pixels)
        if self._pixels == "bgr0":
            _plane(coded, 0, (*frame.shape[:2], 4), np.uint8)[..., :3] = frame[..., ::-1]
        elif self._pixels == "gbrp16le":
            for i, color in enumerate((1, 2, 0)):
                _plane(coded, i, frame.shape[:2], np.uint16)[...] = frame[..., color]
        else:
            _plane(coded, 0, frame.shape, frame.dtype)[...] = frame
        coded.time_base = Fraction(1, 1000)
        coded.pts = self._tags.stamp(self._n_frames)
        coded.duration = self._tags.stamp(self._n_frames + 1) - coded.pts
        self._n_frames += 1
        for packet in self._stream.encode(coded):
            self._container.mux(packet)

    def close(self) -> None:
        try:
            for packet in self._stream.encode():
                self._container.mux(packet)
        finally:
            self._container.close()


def _plane(frame: Any, plane: int, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return a plane of a frame of FFmpeg to write into."""
    size = np.dtype(dtype).itemsize
    strides = (frame.planes[plane].line_size, size * (shape[2] if len(shape) == 3 else 1), size)
    return np.ndarray(shape, dtype, frame.planes[plane], 0, strides[: len(shape)])


class _ZarrWriter:
    def __init__(self, path: Path, first: npt.NDArray[Any], format: PixelFormat, tags: RecordingTags) -> None:
        import zarr  # slow to import, and only needed here
        from zarr.codecs import BloscCodec, Crc32cCodec

        about: dict[str, Any] = {
            "version": VERSION,
            "layout": format.layout,
            "bits": format.bits,
            "bayer": tags.bayer,
            "transfer": tags.transfer,
            "rate_hz": str(tags.rate_hz),
        }
        group = zarr.open_group(path, mode="w-", attributes={_ATTRIBUTE: about})
        self._array = group.create_array(
            _FRAMES,
            shape=(_GROWTH, *first.shape),
            chunks=(1, *first.shape),
            dtype=first.dtype,
            # A checksum, because one wrong bit would change the rest of a chunk.
            compressors=[BloscCodec(cname="lz4", clevel=5, shuffle="bitshuffle"), Crc32cCodec()],
            config={"write_empty_chunks": True},  # so that a chunk that is not there is a frame that is missing
        )
        self._n_frames = 0

    def add(self, frame: npt.NDArray[Any]) -> None:
        if self._n_frames == self._array.shape[0]:
            self._array.resize((self._n_frames + _GROWTH, *frame.shape))
        self._array[self._n_frames] = frame
        self._n_frames += 1

    def close(self) -> None:
        self._array.resize((self._n_frames, *self._array.shape[1:]))


class ZarrRecording:
    """A recording of ours in a Zarr group; a `Source`.

    Parameters
    ----------
    path : Path
        The group.
    says : StoredAs
        What the user says of the pixels.

    Raises
    ------
    FootageError
        It is not a recording, of a later version, or damaged.
    """

    notes: tuple[str, ...] = ()

    def __init__(self, path: Path, says: StoredAs) -> None:
        import zarr  # slow to import, and only needed here

        self.name = str(path)
        self._path = path
        try:
            # Arrays of an older format may name codecs that run what they hold.
            group: Any = zarr.open_group(path, mode="r", zarr_format=3)
            about = group.attrs[_ATTRIBUTE]
            version = about["version"]
        except (KeyError, TypeError, ValueError, OSError):
            raise FootageError(
                f"{path} is not a recording of frames: give a video, a folder of pictures or a recording"
            ) from None
        if version != VERSION:
            raise FootageError(f"{path} is a recording of version {version}, this program reads {VERSION}: update it")
        try:
            layout, bayer = about["layout"], about["bayer"]
            tags = RecordingTags(rate_of(about["rate_hz"]), about["transfer"], bayer, int(about["bits"]))
            format = PixelFormat(layout, tags.bits, **({"bayer": bayer} if layout == "bayer" else {}))
            self._array = group[_FRAMES]
            height, width = self._array.shape[1:3]
            if self._array.shape[1:] != format.plane_shapes(height, width)[0] or self._array.dtype != format.dtype:
                raise ValueError(f"its frames are {self._array.shape[1:]} {self._array.dtype}")
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise FootageError(f"{path} is damaged: {error}") from None
        self.transfer = tags.transfer
        if len(self) == 0:
            raise FootageError(f"{path} holds no frames")
        self.size_px = (width, height)
        self.format = says.applied_to(format)

    def __len__(self) -> int:
        return int(self._array.shape[0])

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Frames:
        """Yield frames by number; see `Source`."""
        for number in range(len(self))[start:stop:step]:
            yield self._read(number)

    def close(self) -> None:
        """Do nothing: no file is open between two frames."""

    def _read(self, number: int) -> StoredFrame | BadFrame:
        chunk = self._path / _FRAMES / self._array.metadata.encode_chunk_key((number, *(0,) * (self._array.ndim - 1)))
        if not chunk.exists():
            return BadFrame(number, "it is missing: its chunk is not there")
        try:
            levels = np.asarray(self._array[number])
        except Exception as error:  # each codec has errors of its own
            return BadFrame(number, f"it is damaged: {' '.join(str(error).split())}")
        return StoredFrame(number, (levels,), self.format)
