"""Captures of a sequence in footage under any names: frames are matched to its pictures by what they show, in order.

Footage holds either one frame per picture, or a slide show that was filmed (see `still_pictures`), with anything before
and after. Nothing is assigned that the frames do not confirm: a pose has white, black, others between the two, and
fringes whose steps add up to even light; fields are black, and ramps that rise alike, each in its own channel.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from pipeline.calibration.captures import CapturedFolder, PictureSequence, captured_files
from pipeline.calibration.multishot import fringe_groups
from pipeline.calibration.still_pictures import (
    Still,
    developed,
    find_stills,
    measure_changes,
    read_frame,
    single_picture,
)
from pipeline.errors import CalibrationError, FootageError
from pipeline.footage.footage import GREY, Footage
from pipeline.footage.image_folder import natural_key
from pipeline.footage.opening import open_footage
from pipeline.models import FloatArray, ImageArray

#: The recording in a folder that `colorphase capture` has made.
_RECORDING = "recording.zarr"
_VIDEOS = (".mp4", ".mkv", ".avi", ".mov")
# The projector lights a cell if it is this part as bright as the brightest.
_LIT_PART = 0.3
# White, and the top of a ramp, must be brighter than black by this part of full scale.
_MIN_SIGNAL = 0.02
# How far outside of black and white a picture may be, as a share of white, and in which part of the cells it may not.
_OUTSIDE, _INSIDE_PART = 0.1, 0.9
# The mean of a fringe's steps, as a share of white, is the same to this in three quarters of the pixels.
_MAX_UNEVEN = 0.06
# Steps of a ramp differ from those of the others by this part, or by this part of its top: primaries' gammas differ by
# a few tenths, a picture that is missing doubles a step, and the darkest step is 0.007 of the top or more.
_UNLIKE, _UNLIKE_TOP = 0.5, 0.004
# Of each step of a primary its own channel sees more than this part: of light that only brightens it sees a third.
_OWN_PART = 0.4
# Fewer still pictures than this part of a pose that begin like one are anything, as a screen that goes dark.
_MIN_POSE_PART = 0.5
_ADVICE = "show each picture for half a second or longer, in order, or name one capture of each as in the sequence"


class CapturedFrames(Mapping[str, ImageArray]):
    """Captures by their names, each read from its frame on demand.

    Parameters
    ----------
    source : Footage
        Footage that contains them.
    numbers : dict
        The frame of each name.
    """

    def __init__(self, source: Footage, numbers: dict[str, int]) -> None:
        self._source, self.numbers, self.sensor = source, numbers, source.sensor

    def __getitem__(self, name: str) -> ImageArray:
        """Read one capture, (H, W, 3) RGB.

        Raises
        ------
        FootageError
            It cannot be read.
        """
        return developed(read_frame(self._source, self.numbers[name]))

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names in order."""
        return iter(self.numbers)

    def __len__(self) -> int:
        """Return how many captures there are."""
        return len(self.numbers)


#: Captures by their names.
Captures = CapturedFolder | CapturedFrames


def find_captures(
    place: Path, sequence: PictureSequence, orientations: list[int] | None = None
) -> list[tuple[str, Captures]]:
    """Find the captures of a sequence, under its names or in order of time.

    Parameters
    ----------
    place : Path
        A folder of pictures, a recording, a folder with one, or a video.
    sequence : PictureSequence
        Pictures that were projected.
    orientations : list of int, optional
        See `CapturedFolder`.

    Returns
    -------
    list of (str, mapping)
        What to call them in messages, and captures by the pictures' names: of geometry for every pose, else once.

    Raises
    ------
    CalibrationError
        A capture is missing, or the footage does not show the sequence.
    FootageError
        It cannot be read.
    """
    if place.is_dir() and captured_files(place).keys() & set(sequence.names):
        return [(place.name, CapturedFolder(place, sequence.names, orientations))]
    try:
        source = open_footage(place / _RECORDING if (place / _RECORDING).is_dir() else place)
    except FootageError as error:
        if GREY not in str(error):
            raise
        raise FootageError(f"{place} holds grey pictures: convert mosaics to RGB, or record them as Zarr") from None
    found = match_pictures(source, sequence)
    if len(found) == 1:
        return [(place.name, found[0])]
    named: list[tuple[str, Captures]] = []
    for number, captures in enumerate(found, start=1):
        first, last = min(captures.numbers.values()), max(captures.numbers.values())
        named.append((f"pose {number} of {place.name} (frames {first} to {last})", captures))
    return named


def find_poses(place: Path, sequence: PictureSequence) -> Iterator[tuple[str, Captures]]:
    """Yield the captures of every pose with its name; see `find_captures`.

    Parameters
    ----------
    place : Path
        A folder with a folder, a recording or a video per pose, or footage with all of them.
    sequence : PictureSequence
        Pictures that were projected.
    """
    entries: list[Path] = []
    if place.is_dir() and not any((place / name).exists() for name in (_RECORDING, "zarr.json")):
        # A name that begins with a dot is a pose that is not complete.
        there = [entry for entry in place.iterdir() if not entry.name.startswith(".")]
        entries = [entry for entry in there if entry.is_dir() or entry.suffix.lower() in _VIDEOS]
    orientations: list[int] = []
    for entry in sorted(entries, key=lambda entry: natural_key(entry.name)) or [place]:
        yield from find_captures(entry, sequence, orientations)


def match_pictures(source: Footage, sequence: PictureSequence) -> list[CapturedFrames]:
    """Find the frames that show the pictures of a sequence; see `find_captures`."""
    count = len(sequence.names)
    changes = measure_changes(source)
    numbers = changes.numbers
    if len(numbers) == count or (sequence.kind == "geometry" and len(numbers) % count == 0):
        alone = [single_picture(source, number) for number in numbers]
        groups = [alone[k : k + count] for k in range(0, len(alone), count)]
        if all(_fits(source, sequence, group) for group in groups):
            return [_named(source, sequence, group) for group in groups]
    reason = ""
    best: list[list[Still]] = []
    for stills in find_stills(source, changes):
        try:
            best = max(best, _find_groups(source, sequence, stills), key=len)
        except CalibrationError as error:
            reason = reason or str(error)
    if not best:
        damaged = len(source) - len(numbers)
        frames = f"{len(numbers)} frames" + (f", {damaged} more cannot be used: {changes.bad}" if damaged else "")
        raise CalibrationError(f"{source.name} ({frames}): {reason}")
    return [_named(source, sequence, group) for group in best]


def _named(source: Footage, sequence: PictureSequence, group: list[Still]) -> CapturedFrames:
    return CapturedFrames(source, {name: still.middle for name, still in zip(sequence.names, group, strict=True)})


def _find_groups(source: Footage, sequence: PictureSequence, stills: list[Still]) -> list[list[Still]]:
    """Return the still pictures that are the sequence: of geometry those of every pose, else the first ones.

    Raises
    ------
    CalibrationError
        There are none, or a pose lacks some.
    """
    count = len(sequence.names)
    if sequence.kind != "geometry":
        for start in range(len(stills) - count + 1):
            if _fits(source, sequence, stills[start : start + count]):
                return [stills[start : start + count]]
        raise CalibrationError(
            f"{len(stills)} still pictures, but no {count} in a row that are black and then ramps of red, green and "
            f"blue, as the sequence: {_ADVICE}"
        )
    least = int(count * _MIN_POSE_PART)
    starts = [k for k in range(len(stills) - least + 1) if _is_pose(stills[k : k + least])]
    found = []
    for start, after in zip(starts, [*starts[1:], len(stills)], strict=False):
        group = stills[start : start + count]
        if after - start < count or not _fits(source, sequence, group):
            raise CalibrationError(
                f"the {min(count, after - start)} still pictures from frame {group[0].first} on begin with white and "
                f"black, but are not the {count} of a pose; one is missing, shown twice or out of order: {_ADVICE}"
            )
        found.append(group)
    if not found:
        raise CalibrationError(
            f"{len(stills)} still pictures, but none is white and followed by black and {count - 2} others, as in each "
            f"pose: {_ADVICE}"
        )
    return found


def _fits(source: Footage, sequence: PictureSequence, group: list[Still]) -> bool:
    """Return whether still pictures are the sequence."""
    if sequence.kind == "geometry":
        return _is_pose(group) and _steps_agree(_named(source, sequence, group))
    return _is_fields(np.stack([still.light for still in group]), 3 if sequence.kind == "chart" else 4)


def _is_pose(group: list[Still]) -> bool:
    """Return whether pictures are white, black, and others between the two."""
    light = np.stack([still.light.mean(axis=-1) for still in group])
    white = light[0] - light[1]
    brightest = float(np.percentile(white, 99))
    if brightest < _MIN_SIGNAL:
        return False
    lit = white > _LIT_PART * brightest
    shares = (light[2:, lit] - light[1, lit]) / white[lit]
    between = (shares > -_OUTSIDE) & (shares < 1 + _OUTSIDE)
    return bool((between.mean(axis=1) > _INSIDE_PART).all())


def _steps_agree(captures: Mapping[str, ImageArray]) -> bool:
    """Return whether the steps of each fringe add up to even light, as no other pictures of the sequence do."""
    white, black = (captures[name].mean(axis=-1, dtype=np.float64) for name in list(captures)[:2])
    lit = white - black > _LIT_PART * np.percentile(white - black, 99)
    for names in fringe_groups():
        mean = np.mean([captures[name].mean(axis=-1, dtype=np.float64) for name in names], axis=0)
        share = (mean - black)[lit] / (white - black)[lit]
        if np.percentile(np.abs(share - np.median(share)), 75) > _MAX_UNEVEN:
            return False
    return True


def _is_fields(light: FloatArray, n_ramps: int) -> bool:
    """Return whether pictures, (pictures, cells, 3), are black, and ramps of red, green, blue and grey that agree."""
    rise = light[1:] - light[0]
    brightest = rise.sum(axis=-1).max(axis=0)
    top = float(np.percentile(brightest, 99))
    if top < _MIN_SIGNAL:
        return False
    ramps = rise[:, brightest > _LIT_PART * top].mean(axis=1).reshape(n_ramps, -1, 3)
    tops = ramps[:, -1].sum(axis=-1)
    if tops.min() < _MIN_SIGNAL:
        return False
    steps = np.diff(ramps, axis=1, prepend=0.0) / tops[:, None, None]
    sizes = steps.sum(axis=-1)
    usual = np.median(sizes, axis=0)
    alike = np.abs(sizes - usual) <= np.maximum(_UNLIKE * usual, _UNLIKE_TOP)
    colored = all((steps[k, :, k] > _OWN_PART * sizes[k]).all() for k in range(3))
    return bool(alike.all() and (sizes > 0).all() and colored)
