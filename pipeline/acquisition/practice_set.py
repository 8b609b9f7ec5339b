"""A complete set of captures of a simulated rig, to practise calibration on; and the truth that it was made from."""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration.board import Board
from pipeline.calibration.model import DEFAULT_PROJECTOR_PX, Calibration
from pipeline.calibration.multishot import multishot_codes, multishot_sequence
from pipeline.calibration.radiometry import radiometry_codes, radiometry_sequence
from pipeline.calibration.simulated_board import BoardCaptures, CaptureLight, board_turns
from pipeline.errors import OutputError
from pipeline.files import explain
from pipeline.models import FloatArray
from pipeline.simulation import TYPICAL_CROSSTALK, WHITE, SimulationSettings, simulate_frame, simulated_truth
from tikernels import runtime

#: What lies in the folder.
LIGHT, POSES, SECOND_POSES = "light", "poses", "second-board"
BALL, PLANE, TRUTH, OBJECTS = "ball.png", "plane.png", "truth.json", "objects.json"
#: The two boards: every picture shows them whole, with squares of about 30 and 24 px.
BOARD = Board(kind="chessboard", squares=(10, 7), square_mm=22.0)
SECOND_BOARD = Board(kind="chessboard", squares=(10, 7), square_mm=18.0)
#: The ball that `simulate_frame` shows: its radius, and its middle in the camera's frame.
BALL_RADIUS_MM, BALL_MIDDLE_MM = 85.0, (0.0, 0.0, 880.0)
# Ten poses, two more than are needed, so that one may be left out; of the second board two.
_N_POSES, _N_SECOND = 10, 2
# The camera reads out the middle of its sensor of 640x480 px: that keeps 12 px per cycle, and saves half of the disk.
_CORNER_PX, _SIZE_PX = (80, 60), (480, 360)
# Each pose is off the axis in another direction than the ones before: by the golden angle, which fills a circle evenly.
_TURN_RAD = np.pi * (3 - np.sqrt(5))
# A board moves aside in such steps, mm, until its squares are so near to the picture's rim, px.
_STEP_MM, _RIM_PX = 2.0, 4.0
_GAMMA = 2.0
# With it white paper reaches 0.86 of full scale in green, the channel that the other primaries leak into most.
_EXPOSURE = 0.9
# Of 255 levels: what light's own noise makes at half of full scale, where a pixel holds 30,000 electrons.
_NOISE_LEVELS = 1.0
# One of 9: PNGs of noise are hardly smaller at a higher one, and take twice the time.
_COMPRESSION = 6


def write_practice(folder: Path, arch: str, notify: Callable[[str], None]) -> Calibration:
    """Write captures for every step of a rig's calibration, and its truth: all, or nothing.

    Parameters
    ----------
    folder : Path
        A folder that does not exist yet. It gets ``light`` (the captures of `radiometry_sequence`), ``poses`` and
        ``second-board`` (of `multishot_sequence`, a folder a pose), ``ball.png`` and ``plane.png`` under the coded
        pattern, ``truth.json`` (a calibration) and ``objects.json`` (where ball and plane are).
    arch : str
        Device that renders light and objects; boards are by NumPy.
    notify : callable
        Called with what is being done.

    Returns
    -------
    Calibration
        The truth.

    Raises
    ------
    OutputError
        The folder exists already, or cannot be written.
    DeviceNotReady
        The machine lacks the arch.
    """
    if folder.exists():
        raise OutputError(f"{folder} exists already: choose another name")
    runtime.init(arch)
    rig = practice_rig()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            _write_light(work / LIGHT, rig, notify)
            for name, board, count, seed in (
                (POSES, BOARD, _N_POSES, 1),
                (SECOND_POSES, SECOND_BOARD, _N_SECOND, 2),
            ):
                notify(f"{name}: pose 1 of {count}")
                for k, captures in enumerate(practice_poses(board, count, seed), start=1):
                    _write_captures(work / name / f"pose-{k:02d}", captures)
                    notify(f"{name}: pose {min(k + 1, count)} of {count}")
            notify("a ball and a plane under the pattern")
            _write_objects(work, rig)
            rig.write(work / TRUTH)
            work.chmod(0o755)
            work.replace(folder)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"cannot write {folder}: {explain(error)}") from None
    return rig


def practice_rig() -> Calibration:
    """Return the rig to practise on, its light included: an ordinary, imperfect one."""
    response = np.tile(np.linspace(0, 1, 256) ** _GAMMA, (3, 1))
    rig = simulated_truth().cropped(*_CORNER_PX, _SIZE_PX)
    return rig.replace(crosstalk_matrix=TYPICAL_CROSSTALK, response=response)


def practice_poses(board: Board, count: int, seed: int) -> Iterator[BoardCaptures]:
    """Yield the captures of a board in some poses before that rig, each tilted another way."""
    light = CaptureLight(gamma=_GAMMA, crosstalk=np.array(TYPICAL_CROSSTALK), noise=_NOISE_LEVELS)
    names, rig = multishot_sequence(DEFAULT_PROJECTOR_PX).names, practice_rig()

    def codes(name: str) -> FloatArray:
        return multishot_codes(name, DEFAULT_PROJECTOR_PX)

    for k, (turn, place) in enumerate(zip(*board_turns(count, seed), strict=True)):
        aside = _towards_rim(rig, board, turn, place[2], _TURN_RAD * k)
        yield BoardCaptures(rig, board, turn, aside, names, codes, light, seed=100 * seed + k)


def _towards_rim(rig: Calibration, board: Board, turn: FloatArray, depth_mm: float, direction_rad: float) -> FloatArray:
    """Return the place of a board, mm, that is as near to the picture's rim as it may be to be seen whole."""
    lens = rig.geometry().camera
    place = np.array([0.0, 0.0, depth_mm])
    step = _STEP_MM * np.array([np.cos(direction_rad), np.sin(direction_rad), 0.0])
    while True:
        pixels, _ = cv2.projectPoints(board.outline_mm(), turn, place + step, lens.matrix, lens.distortion)
        if (pixels < _RIM_PX).any() or (pixels > np.array(lens.size_px) - 1 - _RIM_PX).any():
            return place
        place = place + step


def _write_light(folder: Path, rig: Calibration, notify: Callable[[str], None]) -> None:
    """Write what the camera sees of a white plane under every plain field."""
    width, height = DEFAULT_PROJECTOR_PX
    names = radiometry_sequence(DEFAULT_PROJECTOR_PX).names
    folder.mkdir()
    for seed, name in enumerate(names):
        notify(f"{LIGHT}: field {seed + 1} of {len(names)}")
        field = np.broadcast_to(radiometry_codes(name).astype(np.float32), (height, width, 3))
        settings = _settings("plane", seed, exposure=_EXPOSURE)
        image = simulate_frame(rig, settings, np.ascontiguousarray(field)).image
        _write_png(folder / f"{name}.png", image)


def _write_captures(folder: Path, captures: Mapping[str, npt.NDArray[np.uint8]]) -> None:
    folder.mkdir(parents=True)
    for name, picture in captures.items():
        _write_png(folder / f"{name}.png", picture)


def _write_objects(folder: Path, rig: Calibration) -> None:
    """Write a frame of a ball and one of a plane, and where these are."""
    _write_png(folder / BALL, simulate_frame(rig, _settings("ball", 1)).image)
    plane = simulate_frame(rig, _settings("plane", 2))
    _write_png(folder / PLANE, plane.image)
    points = plane.points[np.isfinite(plane.points[..., 2])].astype(np.float64)
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal *= -np.sign(normal[2])
    known = {
        "ball": {"radius_mm": BALL_RADIUS_MM, "middle_mm": BALL_MIDDLE_MM},
        "plane": {"point_mm": middle.round(4).tolist(), "normal": normal.round(6).tolist()},
    }
    (folder / OBJECTS).write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


def _settings(scene: str, seed: int, exposure: float | None = None) -> SimulationSettings:
    """Return how a white thing is photographed."""
    return SimulationSettings.model_validate(
        {
            "scene": scene,
            "gamma": _GAMMA,
            "reflectance": WHITE,
            "texture": 0.0,
            "noise_levels": _NOISE_LEVELS,
            "exposure": exposure,
            "seed": seed,
        }
    )


def _write_png(path: Path, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> None:
    encoded = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION])[1]
    path.write_bytes(encoded.tobytes())
