"""Every coded frame of a video file: where it is in the file, and its number in time."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.errors import FootageError
from pipeline.footage.ffmpeg_messages import caught_messages
from pipeline.footage.recording_tags import RecordingTags

# Every frame of a recording has the checksums of 16 slices, and the length of each: as many bytes, at least.
_FRAME_BYTES = 16 * 8


@dataclass(frozen=True)
class VideoIndex:
    """Every coded frame of a file: its position is its place in the file, its number that in time."""

    stamps: Sequence[int]  # by position, in the stream's time base; empty where stamps do not tell frames apart
    marks: Sequence[int]  # by position: what tells which packet is which
    mark: Literal["pts", "pos"]  # what that is: a packet's time stamp, or where it begins in the file
    numbers: Sequence[int]  # by position; -1: decoded, because others need it, but not shown
    keys: Sequence[int]  # positions at which decoding can begin, ascending

    @property
    def intra_only(self) -> bool:
        """Whether every frame can be decoded by itself: without stamps only those before it tell which one it is."""
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


def index_frames(container: Any, stream: Any, recording: RecordingTags | None) -> VideoIndex:
    """List the coded frames of an open file, without looking at them where something else tells where they are.

    Parameters
    ----------
    container, stream
        PyAV's, of the file.
    recording : RecordingTags or None
        What the file says of itself, where it is a recording.

    Raises
    ------
    FootageError
        The file says that it holds more frames than there is room for in it.
    """
    if recording is not None:
        n_frames = recording.n_frames(container.duration or 0)
        _check_count(n_frames, _FRAME_BYTES, container)
        stamps = [recording.stamp(number) for number in range(n_frames)]
        return VideoIndex(stamps, stamps, "pts", range(n_frames), range(n_frames))
    _check_count(max(stream.frames, len(stream.index_entries)), 1, container)
    entries = list(stream.index_entries)
    stamps = [entry.timestamp for entry in entries]
    everything = len(entries) == stream.frames > 0 and len(set(stamps)) == len(stamps)
    if everything and all(entry.is_keyframe and not entry.is_discard for entry in entries):
        # AVI counts its packets for time stamps: where one is lost only the place in the file still tells.
        return VideoIndex(stamps, [entry.pos for entry in entries], "pos", range(len(stamps)), range(len(stamps)))
    return _index_by_reading(container, stream)


def _check_count(n_frames: int, frame_bytes: int, container: Any) -> None:
    """Check that there is room in a file for as many frames as its head says."""
    if n_frames * frame_bytes > container.size:
        raise FootageError(f"its head says that it holds {n_frames} frames, but it is too short: copy it again")


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
