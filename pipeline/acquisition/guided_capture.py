"""Take the pictures of a calibration: show each, wait until it is on the screen, photograph, check and keep it.

A picture is kept under its name as soon as it is checked, so a capture that is stopped at any time goes on where it
was. The pictures of the light, and of each pose, are in a folder whose name begins with a dot until all of them are
there and show that nothing changed meanwhile.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.acquisition.studio import Guidance, Studio
from pipeline.calibration.board import Board
from pipeline.calibration.board_poses import measure_pose
from pipeline.calibration.captures import CapturedFolder, captured_files
from pipeline.calibration.multishot import BLACK, WHITE, multishot_codes, multishot_sequence
from pipeline.calibration.pose_guide import BentBoardError, PoseGuide
from pipeline.calibration.radiometry import radiometry_codes, radiometry_sequence
from pipeline.errors import CalibrationError, OutputError
from pipeline.files import explain, write_atomically
from pipeline.models import FloatArray, ImageArray
from tikernels.raw.linearization import WHITE_LEVELS

#: The folders of the captures.
LIGHT, POSES, SESSION = "light", "poses", "session.json"
# How often a picture is taken, and a pose or the light from the start, before it is given up.
_TRIES = 3
# Time in which every projector and camera shows and sees a picture, s; and flashes by which the true time is measured.
_SURE_S, _FLASHES = 1.0, 4
# A flash is on the screen when a frame has this part of its light.
_ON = 0.98
# White must be brighter than black by this part of full scale; and in no more pixels than this part be saturated.
_MIN_LIGHT, _SATURATED, _MAX_SATURATED = 0.06, 0.99, 0.02
# Pixels count that are this part as bright as the brightest: the projector lights them fully.
_LIT = 0.3
# Frames of white by which flicker is seen, in bands of so many rows, and how much of it a phase bears: a channel off by
# a hundredth makes .013 rad (verdict.py), as much as a frame's noise.
_FLICKER_TAKES, _BAND_PX, _MAX_FLICKER = 12, 32, 0.01
# Stripes of one px are this part darker than those of two where a picture is resampled: interpolation mixes codes, and
# light is a power of them.
_MAX_RESAMPLED = 0.04
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
# A board is at another place where a corner is further than this part of the picture's width from all before.
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


class GuidedCapture:
    """Takes the pictures of a calibration with a projector and a camera.

    Parameters
    ----------
    studio : Studio
        Projector, camera and operator.
    folder : Path
        Where the pictures go; what an earlier capture left there is gone on with.
    identity : dict
        What must be the same when a capture is gone on with: the camera's settings, for instance. Plain JSON values.
    tell : callable
        Hears what is being done.
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
        tell: Callable[[str], None],
        report: Callable[[str], None],
    ) -> None:
        self._studio, self._folder, self._tell, self._report = studio, folder, tell, report
        self._shown: _Shown | None = None
        self._camera_px = (0, 0)
        self._delay_s = _SURE_S
        self._noise = 0.0  # RMS difference of two frames of one picture, of full scale
        self._flicker = 0.0  # of bands of white, as a part of them
        _continue_session(folder, identity | {"projector_px": list(studio.projector_px)})

    def check_rig(self) -> None:
        """Measure the delay of a picture, and look for faults that spoil every capture.

        Raises
        ------
        CalibrationError
            A fault is found; the message names it.
        """
        self._tell("looking for faults of the rig")
        black, white = self._settled(0.0), self._settled(1.0)
        self._camera_px = (white.shape[1], white.shape[0])
        gain = white.mean(axis=-1) - black.mean(axis=-1)
        brightest = float(np.percentile(gain, 99))
        if brightest < _MIN_LIGHT:
            raise CalibrationError(
                f"the camera sees hardly any light of the projector: white is {brightest:.1%} of full scale brighter "
                "than black. Look whether the projector shows it, and expose longer"
            )
        lit = gain > _LIT * brightest
        self._measure_delay(lit, float(gain[lit].mean()), float(black.mean(axis=-1)[lit].mean()))
        self._check_flicker(lit)
        saturated = float((white[lit] >= _SATURATED).any(axis=-1).mean())
        if saturated > _MAX_SATURATED:
            raise CalibrationError(f"{saturated:.0%} of the lit pixels are saturated by white: expose shorter")
        self._check_colors(black, lit)
        self._check_resampling(black, lit)
        self._check_mirrored(black, white, lit)

    @property
    def camera_px(self) -> tuple[int, int]:
        """Width and height of the camera's frames, once the rig was looked at."""
        return self._camera_px

    def _settled(self, code: float | FloatArray) -> FloatArray:
        """Return the frame of a plain picture, 0..1, when it is on the screen for certain."""
        self._show(self._field(code))
        self._studio.sleep(_SURE_S)
        return _shares(self._studio.take()[-1])

    def _field(self, code: float | FloatArray) -> npt.NDArray[np.floating]:
        width, height = self._studio.projector_px
        return np.broadcast_to(np.asarray(code, np.float64) * np.ones(3), (height, width, 3))

    def _show(self, codes: npt.NDArray[np.floating]) -> None:
        self._studio.show(np.rint(255 * codes).astype(np.uint8))
        self._shown = None

    def _measure_delay(self, lit: npt.NDArray[np.bool_], gain: float, dark: float) -> None:
        """Find by flashes how long a picture takes to the screen: the longest of some, and one frame more."""
        longest = 0.0
        for _ in range(_FLASHES):
            self._settled(0.0)
            start_s = self._studio.now_s()
            self._show(self._field(1.0))
            while True:
                began_s = self._studio.now_s()
                frames = self._studio.take()
                level = _shares(frames[0]).mean(axis=-1)[lit].mean()
                if level > dark + _ON * gain:
                    break
                if began_s - start_s > 3 * _SURE_S:
                    raise CalibrationError(
                        "white took longer than 3 s to the screen, or shows for a moment only: switch off what the "
                        "projector does to its picture (dynamic iris, eco blanking, signal search)"
                    )
            longest = max(longest, began_s - start_s)
            frame_s = (self._studio.now_s() - began_s) / len(frames)
        self._delay_s = longest + frame_s

    def _check_flicker(self, lit: npt.NDArray[np.bool_]) -> None:
        means, noise = [], []
        for _ in range(_FLICKER_TAKES):
            frames = [_shares(frame) for frame in self._studio.take()]
            means += [_band_means(frame, lit) for frame in frames]
            noise.append(_rms(frames[0] - frames[-1]))
        self._noise = float(np.median(noise))
        series = np.array(means)
        self._flicker = float(np.nanmax(series.std(axis=0) / series.mean(axis=0)))
        if self._flicker > _MAX_FLICKER:
            raise CalibrationError(
                f"white flickers by {self._flicker:.1%} from frame to frame: the exposure is no whole number of the "
                "projector's cycles (1/60 s or 1/50 s, or the colour wheel's), or the camera's exposure is automatic"
            )

    def _check_colors(self, black: FloatArray, lit: npt.NDArray[np.bool_]) -> None:
        seen = np.array([(self._settled(color) - black)[lit].mean(axis=0) for color in np.eye(3)])
        shares = seen / np.maximum(seen.sum(axis=0), 1e-9)  # [primary, channel]
        most = shares.argmax(axis=0)
        if tuple(most) == (2, 1, 0):
            raise CalibrationError("the camera's frames are B, G, R instead of R, G, B: set its pixel format")
        if tuple(most) != (0, 1, 2):
            raise CalibrationError(
                "the camera's channels see other colours of the projector more than their own: switch off the "
                "projector's colour modes and the camera's colour effects, and correct its white balance"
            )

    def _check_resampling(self, black: FloatArray, lit: npt.NDArray[np.bool_]) -> None:
        width, height = self._studio.projector_px
        for axis, positions in (("columns", np.arange(width)[None]), ("rows", np.arange(height)[:, None])):
            light = []
            for wide in (1, 2):
                stripes = np.broadcast_to((positions // wide % 2)[..., None], (height, width, 3))
                self._show(stripes.astype(np.float64))
                self._studio.sleep(self._delay_s)
                light.append(float((_shares(self._studio.take()[-1]) - black)[lit].mean()))
            darker = 1 - light[0] / light[1]
            if darker > _MAX_RESAMPLED:
                raise CalibrationError(
                    f"the projector does not show the picture pixel for pixel: {axis} of one px are {darker:.0%} "
                    "darker than those of two. Switch off keystone, zoom, overscan and sharpness, set its own "
                    "resolution, and do not mirror it to a display of another size"
                )

    def _check_mirrored(self, black: FloatArray, white: FloatArray, lit: npt.NDArray[np.bool_]) -> None:
        width, height = self._studio.projector_px
        y, x = np.nonzero(lit)
        places = np.column_stack([np.ones(len(x)), x, y])
        slopes = []
        for ramp in (np.linspace(0, 1, width)[None], np.linspace(0, 1, height)[:, None]):
            self._show(np.broadcast_to(ramp[..., None], (height, width, 3)))
            self._studio.sleep(self._delay_s)
            seen = (_shares(self._studio.take()[-1]) - black)[lit].mean(axis=-1)
            share = seen / (white - black)[lit].mean(axis=-1)
            slopes.append(np.linalg.lstsq(places, share, rcond=None)[0][1:])
        if np.linalg.det(np.array(slopes)) < 0:
            raise CalibrationError(
                "the picture is mirrored: switch off the projector's rear projection or ceiling mode, or the camera's "
                "mirroring, whichever is on"
            )

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
            self._studio.sleep(self._delay_s)
            first, *_, frame = self._studio.take()
            if self._differs(_shares(first), _shares(frame)):
                reason = "two frames of it differ: something moves, or the light flickers"
            elif (
                before is not None
                and np.abs(before.codes**2 - codes**2).mean(axis=(0, 1)).max() > _OTHER_LIGHT
                and not self._differs(_shares(before.frame), _shares(frame))
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
            return self._field(radiometry_codes(name))

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
            self._tell(f"reading {place.name}")
            captures = CapturedFolder(place, multishot_sequence(size_px).names)
            guide.add(measure_pose(place.name, captures, board, size_px))
        failures = 0
        while not guide.enough:
            try:
                self._take_pose(folder / f"pose-{len(guide.poses) + 1:02d}", board, guide)
                failures = 0
            except BentBoardError:
                raise
            except CalibrationError as error:
                failures += 1
                if failures == _TRIES:
                    raise
                self._report(f"again: {error}")
        return folder

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
        line = "put up a white sheet that fills the picture"
        last, since_s = None, self._studio.now_s()
        for frame in self._looks(line):
            now = _shares(frame)
            if last is None or not self._alike(last, now) or not _is_sheet(now - black):
                since_s = self._studio.now_s()
            last = now
            self._studio.guide(Guidance(line, frame))
            if self._studio.key_pressed() or self._studio.now_s() - since_s >= _STILL_S:
                return

    def _hold_board(self, name: str, board: Board, guide: PoseGuide) -> None:
        """Wait until the board is held still at another place than before, or a key is pressed."""
        suggestion = guide.suggest()
        before = [_by_corner(board, pose.corners_mm, pose.camera_px) for pose in guide.poses]
        covered = np.concatenate([pose.camera_px for pose in guide.poses]) if guide.poses else None
        line = f"{name}: {suggestion.words}"
        self._settled(1.0)
        last: _Corners = {}
        since_s = self._studio.now_s()
        for frame in self._looks(line):
            width = frame.shape[1]
            try:
                numbers, found = board.find(_shares(frame).mean(axis=-1))
                seen, problem = _by_corner(board, board.corners_mm()[numbers], found), ""
            except CalibrationError as error:
                seen, problem = {}, f" ({error})"
            moves = np.median(_ways_px(last, seen)) > _STILL_PX * width / 640
            again = any(_ways_px(pose, seen).max() < _OTHER_PLACE * width for pose in before)
            if moves or again:
                since_s = self._studio.now_s()
            last = seen
            places = np.array(list(seen.values())) if seen else None
            self._studio.guide(Guidance(line + problem, frame, suggestion.outline_px, places, covered))
            pressed = self._studio.key_pressed()
            if seen and (pressed or self._studio.now_s() - since_s >= _STILL_S):
                return

    def _looks(self, line: str) -> Iterator[ImageArray]:
        """Yield what the camera sees, now and then."""
        self._tell(line)
        start_s = self._studio.now_s()
        while self._studio.now_s() - start_s < _PATIENCE_S:
            yield self._studio.take()[-1]
            self._studio.sleep(_LOOK_S)
        raise CalibrationError(f"nothing came for {_PATIENCE_S / 60:.0f} minutes: run the command again to go on")

    def _discard_unless_alike(self, work: Path, name: str, codes: npt.NDArray[np.floating], what: str) -> None:
        """Take the pictures from the start where an earlier capture's first one shows another scene than now."""
        stored = captured_files(work)
        if not stored:
            return
        if name in stored:
            before = _shares(CapturedFolder(work, (name,))[name])
            now = _shares(self.photograph(name, codes))
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
                self._tell(f"picture {number} of {len(names)}: {name}")
                _write_picture(work / f"{name}.png", self.photograph(name, codes(name)))
        return CapturedFolder(work, names)

    def _change(self, captures: CapturedFolder, pictures: dict[str, npt.NDArray[np.floating]]) -> str | None:
        """Say what has changed since a bright picture and black were taken; None: nothing."""
        bright = _shares(captures[next(iter(pictures))]).mean()
        for name, codes in pictures.items():
            before, now = _shares(captures[name]), _shares(self.photograph(name, codes))
            change = float((now - before).mean() / bright)
            if abs(change) > _MAX_CHANGE:
                return f"the light of {name} changed by {change:+.1%} of the projector's while the pictures were taken"
            if not self._alike(before, now):
                return f"something moved while the pictures were taken: {name} is another one at their end"
        return None

    def _alike(self, before: FloatArray, now: FloatArray) -> bool:
        """Whether the pixels of two frames of one picture differ by noise only."""
        return _rms(before - now) <= _NOISE_TIMES * max(self._noise, _LEAST_NOISE)

    def _differs(self, before: FloatArray, now: FloatArray) -> bool:
        """Whether two frames show different pictures: in their pixels, or in the means of cells."""
        cells = [cv2.resize(frame, _CELLS, interpolation=cv2.INTER_AREA) for frame in (before, now)]
        allowed = _CELL_DIFFERS + _FLICKER_TIMES * self._flicker * np.asarray(cells[0])
        return not self._alike(before, now) or _rms((np.asarray(cells[1]) - cells[0]) / allowed) > 1


def _continue_session(folder: Path, identity: dict[str, Any]) -> None:
    """Make the folder of a capture, or refuse one whose pictures were taken otherwise."""
    _make_folder(folder)
    file = folder / SESSION
    before: dict[str, Any] = {}
    if file.exists():
        try:
            before = dict(json.loads(file.read_bytes()))
        except (OSError, ValueError, TypeError):
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


def _shares(frame: ImageArray) -> FloatArray:
    """Return a frame as shares of full scale."""
    return np.asarray(frame / np.float32(WHITE_LEVELS[frame.dtype.name]), np.float64)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def _band_means(frame: FloatArray, lit: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the mean of the lit pixels of bands of rows, (bands, 3); NaN where a band has few."""
    starts = np.arange(0, len(frame), _BAND_PX)
    counts = np.add.reduceat(lit.sum(axis=1), starts)
    sums = np.add.reduceat((frame * lit[..., None]).sum(axis=1), starts)
    return np.where(counts[:, None] < _BAND_PX**2, np.nan, sums / np.maximum(counts, 1)[:, None])


def _is_sheet(gain: FloatArray) -> bool:
    """Whether the light that the projector adds falls on one even colour in most of the picture."""
    total = gain.sum(axis=-1)
    lit = total > _LIT * np.percentile(total, 99)
    shares = gain[lit] / total[lit][:, None]
    return bool(lit.mean() > _SHEET and np.percentile(np.abs(shares - np.median(shares, axis=0)), 95) < _ONE_COLOR)


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
