"""Take the pictures of a calibration: show each, wait until it is on the screen, photograph, check and keep it.

A picture is kept under its name as soon as it is checked, so a capture that is stopped at any time continues where it
was. The pictures of the light, and of each pose, are in a folder whose name begins with a dot until all of them are
there and show that nothing changed meanwhile.
"""

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.acquisition.rig_faults import LIT, RigProbe, rms, shares
from pipeline.acquisition.studio import Guidance, Studio
from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import measure_pose
from pipeline.calibration.captures import SENSOR, SESSION, CapturedFolder, captured_files
from pipeline.calibration.multishot import BLACK, WHITE, multishot_codes, multishot_sequence
from pipeline.calibration.pose_guide import BentBoardError, PoseGuide
from pipeline.calibration.radiometry import radiometry_codes, radiometry_sequence
from pipeline.diagnosis.artefacts import Position
from pipeline.errors import CalibrationError, OutputError
from pipeline.files import explain, write_atomically
from pipeline.limits import read_text
from pipeline.models import FloatArray, ImageArray

#: The folders of the captures.
LIGHT, POSES = "light", "poses"
# How often a picture is taken, and a pose or the light from the start, before it is given up.
_TRIES = 3
# Two frames of one picture differ by their noise; by this many times as much where the picture was changing.
_NOISE_TIMES = 2.0
# Cells of a frame whose means are compared, too: they show what is less than a pixel's noise. Between two frames of one
# picture they differ by less than this part of full scale, and so many times as much as white flickers.
_CELLS, _CELL_DIFFERS, _FLICKER_TIMES = (8, 6), 0.5 / 255, 4.0
# Pictures whose light differs by less in every channel's mean may look alike, given a gamma of 2: the least steps of
# the ramps are .016, from black, and .047.
_OTHER_LIGHT = 0.03
#: The first bright picture of the light: what it has changed by at the end, everything may have.
_EARLY_BRIGHT = "08-red-255"
# The light of it and of black may change by this part of the projector's from the first picture to the last.
_MAX_CHANGE = 0.01
# What even a frame without noise may differ by, of full scale: a level of 8 bits in every other pixel.
_LEAST_NOISE = 0.7 / 255
# A white sheet is lit in this part of the picture, and its colour's shares differ by less in 95 % of its pixels.
_SHEET, _ONE_COLOR = 0.3, 0.03
# A board that is held still for this time is taken, s; it is still while corners move by less, px of 640 in a row.
_STILL_S, _STILL_PX = 2.0, 0.3
# Time between two looks at it, s.
_LOOK_S = 0.2
# A board has moved since the pose before if a corner is further away than this part of the picture's width.
_OTHER_PLACE = 0.02
# Time that somebody has to bring the board, s.
_PATIENCE_S = 900.0


# Places in the picture, px, of a board's corners by x and y on it, mm.
_Corners = dict[tuple[float, float], FloatArray]


@dataclass(frozen=True)
class _Shown:
    """A picture that is on the screen, and the frame that shows it."""

    codes: npt.NDArray[np.floating]
    frame: ImageArray


class NobodyCameError(CalibrationError):
    """Nothing was held before the rig in time."""


class GuidedCapture:
    """Takes the pictures of a calibration with a projector and a camera.

    Parameters
    ----------
    studio : Studio
        Projector, camera and operator.
    folder : Path
        Folder of the pictures; what an earlier capture left there is continued.
    identity : dict
        Must be the same when a capture is continued: the camera's settings, for instance. Plain JSON values.
    notify : callable
        Called with what is being done.
    report : callable
        Hears what has come of it: a pose that was taken, or why one is taken again.

    Raises
    ------
    OutputError
        The folder belongs to a capture with another identity, or cannot be written.
    """

    def __init__(
        self,
        studio: Studio,
        folder: Path,
        identity: dict[str, Any],
        notify: Callable[[str], None],
        report: Callable[[str], None],
    ) -> None:
        self._studio, self._folder, self._notify, self._report = studio, folder, notify, report
        self._shown: _Shown | None = None
        self._probe = RigProbe(studio)
        _continue_session(folder, identity | {"size of the projector's pictures": "{}x{}".format(*studio.projector_px)})

    def check_rig(self) -> None:
        """Measure the delay of a picture, and look for faults that spoil every capture.

        Raises
        ------
        CalibrationError
            A fault is found; the message names it.
        OutputError
            The folder's pictures have another size than the camera's frames.
        """
        self._notify("looking for faults of the rig")
        for fault in self._probe.faults():
            raise CalibrationError(fault.words)
        # A camera that is cropped or binned since then takes other frames.
        frames: dict[str, Any] = {"size of frames": "{}x{}".format(*self.camera_px)}
        if self._studio.sensor is not None:
            frames[SENSOR] = self._studio.sensor.model_dump(mode="json")
        _continue_session(self._folder, frames)

    @property
    def camera_px(self) -> tuple[int, int]:
        """Width and height of the camera's frames, once the rig was looked at."""
        height, width = self._probe.white.shape[:2]
        return width, height

    def _show(self, codes: npt.NDArray[np.floating]) -> None:
        self._studio.show(np.rint(255 * codes).astype(np.uint8))
        self._shown = None

    def _settled(self, code: float) -> FloatArray:
        """Return the frame of a plain picture, 0..1, when it is on the screen for certain."""
        self._shown = None
        return self._probe.settled(code)

    def photograph(self, name: str, codes: npt.NDArray[np.floating]) -> ImageArray:
        """Return the frame of a picture that is checked to be on the screen, and still.

        Parameters
        ----------
        name : str
            The picture's, for messages.
        codes : (height, width, 3)
            The projector's, 0..1.

        Raises
        ------
        CalibrationError
            It is not on the screen, or not still.
        """
        before = self._shown
        for _ in range(_TRIES):
            self._show(codes)
            self._studio.sleep(self._probe.delay_s)
            first, *_, frame = self._studio.take()
            if self._differs(shares(first), shares(frame)):
                reason = "two frames of it differ: something moves, or the light flickers"
            elif (
                before is not None
                and np.abs(before.codes**2 - codes**2).mean(axis=(0, 1)).max() > _OTHER_LIGHT
                and not self._differs(shares(before.frame), shares(frame))
            ):
                reason = "the camera still sees the picture before it: nothing may cover the projector's picture"
            else:
                self._shown = _Shown(codes, frame)
                return frame
        raise CalibrationError(f"{name}: {reason}")

    def take_light(self) -> Path:
        """Take the pictures of the light, of a white sheet; return their folder.

        Raises
        ------
        CalibrationError
            The sheet is not held still, or the light changes.
        OutputError
            A picture cannot be written.
        """
        done = self._folder / LIGHT
        if done.exists():
            return done
        work = self._folder / f".{LIGHT}"
        names = radiometry_sequence(self._studio.projector_px).names

        def codes(name: str) -> npt.NDArray[np.floating]:
            return self._probe.field(radiometry_codes(name))

        self._wait_for_sheet()
        self._discard_unless_alike(work, names[0], codes(names[0]), "the sheet or the room's light")
        for _ in range(_TRIES):
            captures = self._take_missing(work, names, codes)
            reason = self._change(captures, {name: codes(name) for name in (_EARLY_BRIGHT, names[0])})
            if reason is None:
                return _finish(work, done)
            _discard(work)
            self._report(f"{reason}: all pictures of the light are taken again")
        raise CalibrationError(
            f"{reason}: let the projector warm up for a quarter of an hour, keep the room's light as it is, and switch "
            "off the camera's automatic exposure"
        )

    def take_poses(self, board: Board, guide: PoseGuide) -> Path:
        """Take the pictures of a board in as many poses as are needed; return their folder.

        Raises
        ------
        CalibrationError
            The board is bent, a lens has moved, or a pose cannot be taken.
        OutputError
            A picture cannot be written.
        """
        folder, size_px = self._folder / POSES, self._studio.projector_px
        for place in sorted(folder.glob("pose-*")):
            self._notify(f"reading {place.name}")
            captures = CapturedFolder(place, multishot_sequence(size_px).names)
            guide.add(measure_pose(place.name, captures, board, size_px))
        failures = 0
        while not guide.enough:
            try:
                self._take_pose(folder / f"pose-{len(guide.poses) + 1:02d}", board, guide)
                failures = 0
            except (BentBoardError, NobodyCameError):
                raise
            except CalibrationError as error:
                failures += 1
                if failures == _TRIES:
                    raise
                self._report(f"again: {error}")
        return folder

    def take_positions(
        self,
        positions: Sequence[Position],
        codes: npt.NDArray[np.floating],
        check: Callable[[Position, Path], None] = lambda position, picture: None,
    ) -> None:
        """Take a picture of an artefact in each of its positions, under the pattern; those that are there stay.

        A picture that `check` refuses, by a `CalibrationError`, is taken again, up to three times.

        Raises
        ------
        CalibrationError
            It is not held still, nobody comes, or no picture of it passes the check.
        OutputError
            A picture cannot be written.
        """
        there, before = captured_files(self._folder), None
        for position in positions:
            if position.name in there:
                continue
            picture, failures = self._folder / f"{position.name}.png", 0
            is_right = partial(self._has_moved, before)
            while not picture.exists():
                # Under the pattern a white plate that moves looks another, too.
                self._show(codes)
                self._studio.sleep(self._probe.delay_s)
                before = self._wait_until_still(f"{position.name}: {position.line}", is_right, position.outline_px)
                _write_picture(picture, self.photograph(position.name, codes))
                try:
                    check(position, picture)
                except CalibrationError as error:
                    picture.unlink()
                    failures += 1
                    if failures == _TRIES:
                        raise CalibrationError(f"{position.name}: {error}") from None
                    self._report(f"again: {position.name}: {error}")
                    is_right = partial(self._has_moved, None)
            self._report(f"{position.name} is taken")

    def _has_moved(self, before: FloatArray | None, now: FloatArray) -> bool:
        return before is None or not self._alike(before, now)

    def _take_pose(self, done: Path, board: Board, guide: PoseGuide) -> None:
        size_px = self._studio.projector_px
        work = done.with_name(f".{done.name}")
        names = multishot_sequence(size_px).names

        def codes(name: str) -> npt.NDArray[np.floating]:
            return multishot_codes(name, size_px)

        self._hold_board(done.name, board, guide)
        self._discard_unless_alike(work, WHITE, codes(WHITE), "the board")
        try:
            captures = self._take_missing(work, names, codes)
            reason = self._change(captures, {name: codes(name) for name in (WHITE, BLACK)})
            if reason is not None:
                raise CalibrationError(f"{done.name}: {reason}: hold the board still, and keep the light as it is")
            guide.add(measure_pose(done.name, captures, board, size_px))
        except CalibrationError:
            _discard(work)
            raise
        _finish(work, done)
        depth = f"; the calibration leaves depth off by {guide.depth_mm[-1]:.2f} mm so far" if guide.depth_mm else ""
        self._report(f"{done.name} is taken{depth}")

    def _wait_for_sheet(self) -> None:
        """Wait until the camera sees an even sheet that is still, or a key is pressed."""
        black = self._settled(0.0)
        self._settled(1.0)
        self._wait_until_still("put up a white sheet that fills the picture", lambda now: _is_sheet(now - black))

    def _wait_until_still(
        self, line: str, is_right: Callable[[FloatArray], bool], outline_px: FloatArray | None = None
    ) -> FloatArray:
        """Wait until the camera sees what is right, and still, or a key is pressed; return what it sees."""
        last, since_s = None, self._studio.now_s()
        for frame in self._looks(line):
            now = shares(frame)
            if last is None or not self._alike(last, now) or not is_right(now):
                since_s = self._studio.now_s()
            last = now
            self._studio.guide(Guidance(line, frame, outline_px))
            if self._studio.key_pressed() or self._studio.now_s() - since_s >= _STILL_S:
                break
        return now

    def _hold_board(self, name: str, board: Board, guide: PoseGuide) -> None:
        """Wait until the board is held still at another place than before, or a key is pressed."""
        suggestion = guide.suggest()
        before = _by_corner(board, guide.poses[-1].corners_mm, guide.poses[-1].camera_px) if guide.poses else {}
        covered = np.concatenate([pose.camera_px for pose in guide.poses]) if guide.poses else None
        line = f"{name}: {suggestion.words}"
        self._settled(1.0)
        last: _Corners = {}
        since_s = self._studio.now_s()
        for frame in self._looks(line):
            width = frame.shape[1]
            try:
                numbers, found = board.find(shares(frame).mean(axis=-1))
                seen, problem = _by_corner(board, board.corners_mm()[numbers], found), ""
            except CalibrationError as error:
                seen, problem = {}, f" ({error})"
            moves = np.median(_ways_px(last, seen)) > _STILL_PX * width / 640
            if _ways_px(before, seen).max() < _OTHER_PLACE * width:
                problem = " (it has not moved since the pose before)"
            if moves or problem:
                since_s = self._studio.now_s()
            last = seen
            places = np.array(list(seen.values())) if seen else None
            self._studio.guide(Guidance(line + problem, frame, suggestion.outline_px, places, covered))
            pressed = self._studio.key_pressed()
            if seen and (pressed or self._studio.now_s() - since_s >= _STILL_S):
                return

    def _looks(self, line: str) -> Iterator[ImageArray]:
        """Yield what the camera sees, now and then."""
        self._notify(line)
        start_s = self._studio.now_s()
        while self._studio.now_s() - start_s < _PATIENCE_S:
            yield self._studio.take()[-1]
            self._studio.sleep(_LOOK_S)
        raise NobodyCameError(f"nothing came for {_PATIENCE_S / 60:.0f} minutes: run the command again to go on")

    def _discard_unless_alike(self, work: Path, name: str, codes: npt.NDArray[np.floating], what: str) -> None:
        """Take the pictures from the start where an earlier capture's first one shows another scene than now."""
        stored = captured_files(work)
        if not stored:
            return
        if name in stored:
            before = shares(CapturedFolder(work, (name,))[name])
            now = shares(self.photograph(name, codes))
            if before.shape == now.shape and self._alike(before, now):
                return
        self._report(f"{what} is not as it was: the pictures are taken from the start")
        _discard(work)

    def _take_missing(
        self, work: Path, names: tuple[str, ...], codes: Callable[[str], npt.NDArray[np.floating]]
    ) -> CapturedFolder:
        """Take those of the pictures that are not there yet."""
        _make_folder(work)
        there = captured_files(work)
        for number, name in enumerate(names, start=1):
            if name not in there:
                self._notify(f"picture {number} of {len(names)}: {name}")
                _write_picture(work / f"{name}.png", self.photograph(name, codes(name)))
        return CapturedFolder(work, names)

    def _change(self, captures: CapturedFolder, pictures: dict[str, npt.NDArray[np.floating]]) -> str | None:
        """Say what has changed since a bright picture and black were taken; None: nothing."""
        bright = shares(captures[next(iter(pictures))]).mean()
        for name, codes in pictures.items():
            before, now = shares(captures[name]), shares(self.photograph(name, codes))
            change = float((now - before).mean() / bright)
            if abs(change) > _MAX_CHANGE:
                return f"the light of {name} changed by {change:+.1%} of the projector's while the pictures were taken"
            if not self._alike(before, now):
                return f"something moved while the pictures were taken: {name} is another one at their end"
        return None

    def _alike(self, before: FloatArray, now: FloatArray) -> bool:
        """Return whether the pixels of two frames of one picture differ by noise only."""
        return rms(before - now) <= _NOISE_TIMES * max(self._probe.noise, _LEAST_NOISE)

    def _differs(self, before: FloatArray, now: FloatArray) -> bool:
        """Return whether two frames show different pictures: in their pixels, or in the means of cells."""
        cells = [cv2.resize(frame, _CELLS, interpolation=cv2.INTER_AREA) for frame in (before, now)]
        allowed = _CELL_DIFFERS + _FLICKER_TIMES * self._probe.variation * np.asarray(cells[0])
        return not self._alike(before, now) or rms((np.asarray(cells[1]) - cells[0]) / allowed) > 1


def _continue_session(folder: Path, identity: dict[str, Any]) -> None:
    """Make the folder of a capture, or refuse one whose pictures were taken otherwise."""
    _make_folder(folder)
    file = folder / SESSION
    before: dict[str, Any] = {}
    if file.exists():
        try:
            before = dict(json.loads(read_text(file)))
        except (OSError, ValueError, TypeError, RecursionError):
            raise OutputError(f"{file} cannot be read: choose another folder") from None
    changed = [key for key, value in identity.items() if before.get(key, value) != value]
    if changed:
        raise OutputError(
            f"{folder} holds captures with another {changed[0]} ({before[changed[0]]}, now {identity[changed[0]]}): "
            "choose another folder, or set it as it was"
        )
    if before.keys() != before.keys() | identity.keys():
        write_atomically(file, (json.dumps(before | identity, indent=1) + "\n").encode())


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {explain(error)}") from None


def _finish(work: Path, done: Path) -> Path:
    """Give a folder whose pictures are complete its name."""
    try:
        return work.replace(done)
    except OSError as error:
        raise OutputError(f"cannot write {done}: {explain(error)}") from None


def _discard(work: Path) -> None:
    shutil.rmtree(work, ignore_errors=True)


def _write_picture(path: Path, frame: ImageArray) -> None:
    write_atomically(path, cv2.imencode(".png", frame[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def _is_sheet(gain: FloatArray) -> bool:
    """Return whether the light that the projector adds falls on one even colour in most of the picture."""
    total = gain.sum(axis=-1)
    lit = total > LIT * np.percentile(total, 99)
    colors = gain[lit] / total[lit][:, None]
    return bool(lit.mean() > _SHEET and np.percentile(np.abs(colors - np.median(colors, axis=0)), 95) < _ONE_COLOR)


def _by_corner(board: Board, corners_mm: FloatArray, places_px: FloatArray) -> _Corners:
    """Return a board's corners by their place on it; those of a chessboard, which has two ends, from the upper left."""
    x, y, _ = corners_mm.T
    begin, end = places_px[np.argmin(x + y)], places_px[np.argmax(x + y)]
    if board.kind == "chessboard" and end.sum() < begin.sum():
        x, y = board.squares[0] * board.square_mm - x, board.squares[1] * board.square_mm - y
    return dict(zip(zip(x.tolist(), y.tolist(), strict=True), places_px, strict=True))


def _ways_px(before: _Corners, now: _Corners) -> FloatArray:
    """Return how far corners have moved that are seen twice, px; infinite where none are."""
    both = before.keys() & now.keys()
    return np.array([np.hypot(*(now[k] - before[k])) for k in both]) if both else np.array([np.inf])
