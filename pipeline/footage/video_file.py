"""Frames from a video file, in the planes that its codec stored, by numbers that do not depend on its clock."""

import json
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.errors import FootageError
from pipeline.footage.ffmpeg_frames import caught_messages, orientation_of, stored_planes, transfer_of, views_of
from pipeline.footage.footage import BadFrame, Footage, Frames, StoredAs, StoredFrame, other_than_first, turned
from pipeline.footage.frame_times import LOG, FrameTimes
from pipeline.footage.zarr_recording import RecordingTags, rate_of
from pipeline.limits import check_size, ffmpeg_limits
from pipeline.models import SensorPart, build
from tikernels.raw.pixel_format import PixelFormat

# A file counts as unreadable when its first frames are damaged, this many of them: ten seconds of most footage.
_MOST_DAMAGED = 300
_MISSING = "it is missing from the file, or cannot be decoded"
# An AVI file's index names the head of a coded frame, its reader what comes behind.
_AVI_HEAD_BYTES = 8
#: Tags by which an exported recording states what its pixels and time stamps do not: how many frames per second, how
#: many bits are used, which mosaic its grey pixels are, and which part of the camera's sensor.
RATE_TAG, BITS_TAG, BAYER_TAG, SENSOR_TAG = (f"COLORPHASE_{name}" for name in ("RATE", "BITS", "BAYER", "SENSOR"))
# How Exif's orientations turn a picture.
_TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "turned clockwise by 90 degrees and mirrored left to right",
    6: "turned clockwise by 90 degrees",
    7: "turned counterclockwise by 90 degrees and mirrored left to right",
    8: "turned counterclockwise by 90 degrees",
}
#: In place of a position and a packet, when there are no more.
_END: tuple[int, Any] = (-1, None)


class VideoFile(Footage):
    """A video file, by FFmpeg through PyAV.

    Frames are numbered by their order in time, whatever their time stamps are worth.

    Parameters
    ----------
    path : Path
        The file.
    says : StoredAs
        The user's description of the pixels.

    Raises
    ------
    FootageError
        It is no video, it is empty or cut off where nothing can be found any more, its pixels are stored in a way that
        no kernel reads, or none of its frames can be decoded.
    """

    def __init__(self, path: Path, says: StoredAs) -> None:
        self.name = str(path)
        self._url = f"file:{path.absolute()}"
        self._says = says
        self.transfer: str | None = None
        self.transfer_because = "nothing in the file says otherwise"
        self.notes: tuple[str, ...] = ()
        self.size_px = (0, 0)
        self.format = PixelFormat("rgb")
        if path.stat().st_size == 0:
            raise FootageError(f"{path} is empty: copy it again")
        with self._opened() as (container, stream):
            tags, self._says = _tagged(container.metadata, says)
            self._rate_hz = None if tags is None else tags.rate_hz
            self.sensor = None if tags is None else tags.sensor
            self._stamp_s = float(stream.time_base or 0)
            self._index = _index_frames(container, stream)
            self._n_frames = 1 + max(self._index.numbers, default=-1)
            self._note_missing_end(container, stream)
            others = sum(other is not stream for other in films(container))
            if others:
                self.notes += (f"it holds {others + 1} videos, of which the first is read: the others are left out",)
            if stream.sample_aspect_ratio not in (None, 0, 1):
                self.notes += ("players stretch it, for its pixels are not square; here it stays as it is stored",)
            shown = sum(number >= 0 for number in self._index.numbers)
            if shown < len(self._index.numbers):
                hidden = len(self._index.numbers) - shown
                self.notes += (f"its head hides {hidden} of its frames from players: they are left out here, too",)
        self._positions = {mark: position for position, mark in enumerate(self._index.marks)}
        reason = "it holds no frames"
        for frame in islice(self.frames(), _MOST_DAMAGED):
            if isinstance(frame, StoredFrame):
                return
            reason = frame.reason if frame.number == 0 else reason
        raise FootageError(f"cannot read {path}: {reason}")

    def __len__(self) -> int:
        return self._n_frames

    @property
    def stamps(self) -> list[int]:
        """Times at which frames are to be shown, in the order of their numbers; empty where unknown."""
        shown = zip(self._index.numbers, self._index.stamps, strict=False)
        return [stamp for number, stamp in sorted(shown) if number >= 0]

    @property
    def times(self) -> FrameTimes | None:
        """Times at which frames were taken, by a recording's capture log, or are to be shown; see `Footage`."""
        if self._rate_hz is not None:
            logged = FrameTimes.logged(Path(self.name).parent / LOG, len(self))
            if logged is not None:
                return logged
        stamps = self.stamps
        seconds = [(stamp - stamps[0]) * self._stamp_s for stamp in stamps]
        if self._rate_hz is not None:  # stamps are rounded to ms
            seconds = [float(round(time * self._rate_hz) / self._rate_hz) for time in seconds]
        times = FrameTimes(np.array(seconds, np.float64), None)
        return times if len(seconds) == len(self) and times.ascend else None

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Frames:
        """Yield frames by number; see `Footage`."""
        wanted = range(len(self))[start:stop:step]
        reasons: dict[int, str] = {}
        due = 0  # of those wanted
        while due < len(wanted):
            n_damaged = len(reasons)
            with self._opened() as (container, stream):
                for number, frame in self._decoded(container, stream, wanted[due:], reasons):
                    while due < len(wanted) and wanted[due] < number:
                        yield BadFrame(wanted[due], reasons.get(wanted[due], _MISSING))
                        due += 1
                    if due < len(wanted) and wanted[due] == number:
                        yield self._stored(number, frame, stream.codec_context.name, reasons.get(number))
                        due += 1
                    if due == len(wanted):
                        return
            # Where every frame stands alone, decoding ends at a damaged one and begins anew after it: a damaged frame
            # can change the decoder's state and spoil all later ones.
            last = max(reasons) if self._index.intra_only and len(reasons) > n_damaged else len(self)
            while due < len(wanted) and wanted[due] <= last:
                yield BadFrame(wanted[due], reasons.get(wanted[due], _MISSING))
                due += 1

    def files(self) -> list[Path]:
        """Return the one file; see `Footage`."""
        return [Path(self.name)]

    def close(self) -> None:
        """Do nothing: each iteration opens and closes the file."""

    @contextmanager
    def _opened(self) -> Iterator[tuple[Any, Any]]:
        import av  # slow to import, and only needed here

        with caught_messages():
            # A file may not make FFmpeg open anything but files, nor take memory for larger pictures than any camera's.
            options = {"protocol_whitelist": "file", **ffmpeg_limits()}
            try:
                container = av.open(self._url, options=options, metadata_errors="replace")
            except av.error.FFmpegError as error:
                raise FootageError(
                    f"{self.name} is not a video that can be read ({error.strerror}): it may be cut off or damaged"
                ) from None
        with container:
            stream = next(films(container), None)
            if stream is None:
                raise FootageError(f"{self.name} holds no video: give the file with the pictures")
            if stream.codec_context is None:
                raise FootageError(f"{self.name} has a codec that is not known: convert it with ffmpeg -c:v ffv1")
            if stream.codec_context.width:  # the first frame may be the one that has it
                check_size(self.name, stream.codec_context.width, stream.codec_context.height)
            # Cropped to the pixel; else what is cut off on the left is rounded to what a processor likes.
            stream.codec_context.flags |= av.codec.context.Flags.unaligned
            stream.codec_context.options = ffmpeg_limits()
            yield container, stream

    def _decoded(
        self, container: Any, stream: Any, wanted: range, reasons: dict[int, str]
    ) -> Iterator[tuple[int, Any]]:
        """Yield decoded frames with their numbers, and note why others do not come or should not be trusted."""
        import av

        index, context = self._index, stream.codec_context
        if context.name == "ffv1":
            context.thread_type = "SLICE"
        else:
            context.thread_count = 1  # messages from other threads could not be assigned to a file
        begin = index.position_before(wanted[0])
        packets = self._packets(container, stream, begin)
        damaged: list[int] = []  # positions
        at_once = context.codec.intra_only or context.name == "ffv1"  # whether each packet gives its frame
        n_came = 0
        while True:
            with caught_messages() as said:
                frames: list[Any] = []
                failure = None
                try:
                    position, packet = next(packets, _END)
                except av.error.FFmpegError:
                    position, packet = _END
                if packet is not None:
                    number = index.numbers[position]
                    if index.intra_only and number > wanted[-1]:
                        packet = None
                    elif index.intra_only and number not in wanted:
                        continue
                    else:
                        packet.pts = packet.dts = position  # comes out with the frame
                try:
                    frames = context.decode(packet)
                except av.error.FFmpegError as error:
                    failure = error.strerror
            if at_once and not frames:
                failure = failure or "nothing can be decoded"
            if packet is not None and (failure or said) and number >= index.numbers[begin]:
                reasons[number] = f"it is damaged: {said[0] if said else failure}"
                damaged.append(position)
                n_came += failure is not None
            for frame in frames:
                if frame.pts is None:
                    continue  # its number is unknown
                position_out = int(frame.pts)
                number = index.numbers[position_out] if index.stamps else n_came
                n_came += 1
                if frame.is_corrupt and number not in reasons:
                    reasons[number] = "it is damaged"
                    damaged.insert(bisect_left(damaged, position_out), position_out)
                before = bisect_left(damaged, position_out) - 1
                if before >= 0 and damaged[before] >= index.first_needed(position_out):
                    spoilt = index.numbers[damaged[before]]
                    reasons.setdefault(number, f"it is predicted from frame {spoilt}, which is damaged")
                yield number, frame
            if packet is None or (damaged and index.intra_only):
                return

    def _packets(self, container: Any, stream: Any, begin: int) -> Iterator[tuple[int, Any]]:
        """Yield packets with their positions, from one position on where the file can be entered there."""
        import av

        if begin > 0:
            with suppress(av.error.FFmpegError):  # then the file is read from its beginning
                container.seek(self._index.stamps[begin], stream=stream)
            packets = self._placed(container, stream)
            entered = next((found for found in packets if found[0] >= begin), None)
            if entered is not None and entered[0] == begin:
                yield entered
                yield from packets
                return
            container.seek(self._index.stamps[0], stream=stream)
        yield from self._placed(container, stream)

    def _placed(self, container: Any, stream: Any) -> Iterator[tuple[int, Any]]:
        n_packets = 0
        for packet in container.demux(stream):
            if packet.size == 0:
                continue  # a repeated frame of an AVI file, or the end
            position = n_packets
            n_packets += 1
            if self._index.stamps:
                mark = getattr(packet, self._index.mark)
                position = self._positions.get(mark, -1)
                if position < 0 and self._index.mark == "pos":
                    position = self._positions.get(mark - _AVI_HEAD_BYTES, -1)
            if 0 <= position < len(self._index.numbers):
                yield position, packet

    def _stored(self, number: int, frame: Any, codec: str, reason: str | None) -> StoredFrame | BadFrame:
        if reason is not None:
            return BadFrame(number, reason)
        try:
            planes, format, notes = stored_planes(frame, codec, self._says)
            planes, format = turned(planes, format, orientation_of(frame) or 1)
        except FootageError as error:
            return BadFrame(number, str(error))
        except Exception as error:  # of one frame, whatever it is: the others are read
            return BadFrame(number, f"it cannot be read ({type(error).__name__}: {error})")
        size_px = (planes[0].shape[1], planes[0].shape[0])
        if self.size_px == (0, 0):
            self.size_px, self.format = size_px, format
            self._learn(frame, notes)
        other = other_than_first(format, size_px, self)
        return StoredFrame(number, planes, format) if other is None else BadFrame(number, other)

    def _learn(self, frame: Any, notes: tuple[str, ...]) -> None:
        """Note what the first good frame shows of all."""
        self.notes += notes
        transfer, not_undone = transfer_of(frame)
        if self.transfer is None and transfer is not None:
            self.transfer, self.transfer_because = transfer, "the file says so"
        if not_undone is not None:
            self.notes += (f"its light is encoded as {not_undone}, which is not undone: record with another transfer",)
        self.notes += views_of(frame)
        orientation = orientation_of(frame)
        if orientation is None:
            self.notes += ("players turn it by an odd angle; here it stays as the camera stored it",)
        elif orientation != 1:
            self.notes += (f"it is {_TURNS[orientation]}, as its head says and as players show it",)

    def _note_missing_end(self, container: Any, stream: Any) -> None:
        index = self._index
        if stream.frames > len(index.numbers):
            self.notes += (
                f"{stream.frames - len(index.numbers)} of its {stream.frames} frames are missing: it may be cut off",
            )
            return
        if len(container.streams) > 1 or not container.duration or not index.stamps or len(self) < 2:
            return
        first, last = min(index.stamps), max(index.stamps)
        rest_s = container.duration / 1e6 - float((last - first) * stream.time_base)
        frame_s = float((last - first) * stream.time_base) / (len(self) - 1)
        if rest_s > 3 * frame_s:
            self.notes += (f"it ends {rest_s:.1f} s before it says: it may be cut off",)


def films(container: Any) -> Iterator[Any]:
    """Yield the video streams of an open file that are no cover and no thumbnails."""
    from av.stream import Disposition  # slow to import, and only needed here

    cover = Disposition.attached_pic | Disposition.timed_thumbnails
    return (stream for stream in container.streams.video if not stream.disposition & cover)


def _tagged(metadata: Mapping[str, str], says: StoredAs) -> tuple[RecordingTags | None, StoredAs]:
    """Return the tags of an exported recording, None of another video; and the pixels by the user, or else by them.

    Raises
    ------
    FootageError
        The tags are wrong, or some are missing.
    """
    tags = {name.upper(): value for name, value in metadata.items()}
    if RATE_TAG not in tags:
        return None, says
    try:
        if len(bits := tags[BITS_TAG]) > 2:
            raise ValueError(f"bits {bits[:40]!r} is no number of bits")
        said = tags.get(SENSOR_TAG)
        sensor = None if said is None else build(SensorPart, json.loads(said), ValueError, "sensor")
        known = RecordingTags(rate_of(tags[RATE_TAG]), None, tags.get(BAYER_TAG), int(bits), sensor)
    except (KeyError, ValueError, RecursionError) as error:
        raise FootageError(f"its tags are not those of a recording ({error}): export it again") from None
    stored: dict[str, Any] = {"bayer": known.bayer, "bits": known.bits}
    return known, replace(says, **{name: value for name, value in stored.items() if getattr(says, name) is None})


@dataclass(frozen=True)
class VideoIndex:
    """Every coded frame of a file: its position is its place in the file, its number that in time."""

    stamps: Sequence[int]  # by position, in the stream's time base; empty where stamps do not distinguish frames
    marks: Sequence[int]  # by position: what identifies the packet
    mark: Literal["pts", "pos"]  # what that is: a packet's time stamp, or where it begins in the file
    numbers: Sequence[int]  # by position; -1: decoded, because others need it, but not shown
    keys: Sequence[int]  # positions at which decoding can begin, ascending

    @property
    def intra_only(self) -> bool:
        """True if every frame can be decoded by itself: without stamps its number follows only from those before it."""
        return bool(self.stamps) and len(self.keys) == len(self.numbers)

    def position_before(self, number: int) -> int:
        """Return the position to decode from, so that a frame comes out whole."""
        if not self.stamps:
            return 0
        if self.intra_only and isinstance(self.numbers, range):
            return number
        before = (key for key in self.keys if self.numbers[key] <= number)
        return max(before, key=lambda key: (self.numbers[key], key), default=0)

    def first_needed(self, position: int) -> int:
        """Return the first position that a frame may have been predicted from."""
        k = bisect_right(self.keys, position) - 1
        # What comes before a key frame in time but after it in the file may be predicted from both sides of it.
        if k > 0 and self.numbers[position] < self.numbers[self.keys[k]]:
            k -= 1
        return self.keys[k] if k >= 0 else 0


def _index_frames(container: Any, stream: Any) -> VideoIndex:
    """List the coded frames of an open file, without reading them where the container lists them.

    Raises
    ------
    FootageError
        The file claims to hold more frames than it has room for.
    """
    n_frames = max(stream.frames, len(stream.index_entries))
    if n_frames > container.size:
        raise FootageError(f"its head says that it holds {n_frames} frames, but it is too short: copy it again")
    entries = list(stream.index_entries)
    stamps = [entry.timestamp for entry in entries]
    everything = len(entries) == stream.frames > 0 and len(set(stamps)) == len(stamps)
    if everything and all(entry.is_keyframe and not entry.is_discard for entry in entries):
        # AVI counts its packets for time stamps: where one is lost only the place in the file still identifies a frame.
        return VideoIndex(stamps, [entry.pos for entry in entries], "pos", range(len(stamps)), range(len(stamps)))
    return _index_by_reading(container, stream)


def _index_by_reading(container: Any, stream: Any) -> VideoIndex:
    """Look at every packet: where the container lists no frames, or frames are predicted from later ones."""
    import av

    stamps: list[Any] = []
    keys: list[int] = []
    hidden = set()
    with caught_messages():
        try:
            for packet in container.demux(stream):
                if packet.size == 0:
                    continue
                if packet.is_keyframe:
                    keys.append(len(stamps))
                if packet.is_discard:
                    hidden.add(len(stamps))
                stamps.append(packet.pts)
        except av.error.FFmpegError:
            pass  # frames end where the file cannot be read any further
    if None in stamps or len(set(stamps)) < len(stamps):
        return VideoIndex((), (), "pts", range(len(stamps)), keys)
    numbers = [-1] * len(stamps)
    shown = (position for position in range(len(stamps)) if position not in hidden)
    for number, position in enumerate(sorted(shown, key=stamps.__getitem__)):
        numbers[position] = number
    return VideoIndex(stamps, stamps, "pts", numbers, keys)
