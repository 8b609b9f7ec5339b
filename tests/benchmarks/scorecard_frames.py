"""The frames of the scorecard, each with its truth: simulated, rendered, piled up, filmed, and captures where they are.

Rendered scenes are kept in `frames/` as noise-free light of 12 bits and the projector's row at every pixel; noise is
added by seed. This makes them again, with the extra `rendered` and libLLVM:

    python tests/benchmarks/scorecard_frames.py
"""

import io
import json
import lzma
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import _tests_path  # noqa: F401 - puts support on the path
import cv2
import numpy as np
import numpy.typing as npt
from moving_scenes import moved
from support.exposures_off_cycle import FIELDS
from support.piled_objects import piled_objects

from pipeline.calibration import Calibration
from pipeline.simulation import (
    SKIN,
    TYPICAL_CROSSTALK,
    WHITE,
    SimulatedFrame,
    SimulationSettings,
    simulate_frame,
    simulated_rig,
)

sys.path.insert(0, str(Path(__file__).parent / "rendered"))

_FOLDER = Path(__file__).parent / "frames"
#: Captures and frames of other renderers; see the README there. Frames that are made of them are left out without it.
CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "data"
# Neighbours on one surface are less than this apart, mm.
_STEP_MM = 4.0
# Steps of the kept light, and of the kept rows per px: a tenth of what noise and 8 bits leave.
_LEVELS, _ROWS = 4095, 512
#: Rendered scenes, and the patterns that they are kept under.
RENDERED = {
    "plane": ("plain",),
    "face": ("plain", "coded", "compensated"),
    "objects": ("plain", "coded"),
    "grey_objects": ("coded",),
    "board": ("plain",),
    "corner": ("plain",),
    "dark_beside_bright": ("plain",),
    "deep_out_of_focus": ("plain",),
}


@dataclass(frozen=True)
class Truth:
    """What is true of a frame, (H, W) each."""

    phase: npt.NDArray[np.float64]  # rad, absolute; nonsense outside `lit`
    lit: npt.NDArray[np.bool_]
    surface: npt.NDArray[np.int32]  # connected surfaces of one paint from 1; 0: none
    mm_per_rad: npt.NDArray[np.float32]  # by how much the depth grows with the phase; NaN: not known
    orders_only: bool = False  # whether the phase is known to whole cycles only


@dataclass(frozen=True)
class Taken:
    """Images one after another, what each is decoded with, and the truth of the last."""

    images: list[npt.NDArray[Any]]
    calibrations: list[Calibration | None]
    truth: Truth
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Frame:
    """A frame of the scorecard."""

    name: str
    take: Callable[[int], Taken]  # by seed
    seeds: int = 8  # of captures there is one
    own_truth: bool = False  # whether each seed is another scene, and not only other noise


# --- simulated -----------------------------------------------------------------------------------------------------


def known_light(
    rig: Calibration, known: str, code: str | None, gamma: float = 2.0
) -> tuple[Calibration | None, dict[str, Any]]:
    """Return the calibration and the settings of a rig of which "nothing", the "matrix" or "all" is known."""
    if known == "nothing":
        return None, {"stripes": rig.pattern.stripes} | ({"code": code} if code else {})
    update: dict[str, Any] = {"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)}
    if known == "all":
        update["response"] = np.tile(np.linspace(0, 1, 256) ** gamma, (3, 1))
    return rig.model_copy(update=update), {}


def simulated(
    scene: str, gamma: float, color: tuple[float, ...], code: str | None, known: str, more: dict[str, Any], seed: int
) -> Taken:
    """Return a simulated frame."""
    rig = simulated_rig(code=code)
    settings = SimulationSettings(scene=scene, gamma=gamma, reflectance=color, seed=seed, **more)
    frame = simulate_frame(rig, settings)
    calibration, decoding = known_light(rig, known, code, gamma)
    return Taken([frame.image], [calibration], simulated_truth(frame), decoding)


def simulated_truth(frame: SimulatedFrame, paint: npt.NDArray[Any] | None = None) -> Truth:
    """Return the truth of a simulated frame."""
    return Truth(
        frame.phase,
        frame.mask,
        connected(frame.points, frame.mask, paint),
        depth_change(frame.rig, frame.points, frame.mask),
    )


def pile(kind: dict[str, Any], seed: int) -> Taken:
    """Return a pile of objects before a wall."""
    frame, which = piled_objects(seed + 1, **kind)
    return Taken([frame.image], [known_light(frame.rig, "matrix", None)[0]], simulated_truth(frame, which))


def film(scene: str, pattern: str, frames: int, seed: int) -> Taken:
    """Return the frames of a film, of which the last is judged; "coded once": only the first shows the code."""
    images, calibrations = [], []
    for number in range(frames):
        rig = simulated_rig(code="contrast" if pattern == "coded once" and number == 0 else None)
        taken = simulate_frame(rig, moved(scene, number, seed, 1.0))
        images.append(taken.image)
        calibrations.append(known_light(rig, "matrix", None)[0])
    return Taken(images, calibrations, simulated_truth(taken))


def in_turns(seed: int) -> Taken:
    """Return two frames of a ball that comes nearer while colours are shown one after another, the second at rest."""
    rig, step_mm = simulated_rig(), -0.7
    calibration, settings = known_light(rig, "matrix", None)[0], FIELDS

    def taken(steps: int, moving_mm: float) -> SimulatedFrame:
        moved = {"object_motion_mm": (0, 0, steps * step_mm), "field_motion_mm": (0, 0, moving_mm)}
        return simulate_frame(rig, SimulationSettings(scene="ball", seed=10 * seed + steps, **moved))

    images = [taken(3 * number, step_mm).image for number in range(2)]
    return Taken(images, [calibration] * 2, simulated_truth(taken(4, 0.0)), settings)


def connected(
    points: npt.NDArray[np.floating], lit: npt.NDArray[np.bool_], paint: npt.NDArray[Any] | None = None
) -> npt.NDArray[np.int32]:
    """Return the number of each pixel's surface, (H, W) int32: lit pixels of one paint whose neighbours are near."""
    height, width = lit.shape
    # On a grid twice as fine the places between two pixels say whether they are joined.
    grid = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)
    grid[::2, ::2] = lit
    for axis, between in ((0, grid[1::2, ::2]), (1, grid[::2, 1::2])):
        with np.errstate(invalid="ignore"):
            joined = np.linalg.norm(np.diff(points, axis=axis), axis=-1) < _STEP_MM
        if paint is not None:
            joined &= np.diff(paint.astype(np.int64), axis=axis) == 0
        here, there = (lit[:-1], lit[1:]) if axis == 0 else (lit[:, :-1], lit[:, 1:])
        between[...] = joined & here & there
    return np.ascontiguousarray(cv2.connectedComponents(grid, connectivity=4)[1][::2, ::2]).astype(np.int32)


def depth_change(
    rig: Calibration, points: npt.NDArray[np.floating], lit: npt.NDArray[np.bool_]
) -> npt.NDArray[np.float32]:
    """Return by how much a pixel's depth changes with its phase, (H, W) float32, mm per rad."""
    geometry, change = rig.geometry(), np.full(lit.shape, np.nan, np.float32)
    seen = points[lit].astype(np.float64)
    nearer, farther = (geometry.pattern_cycles(seen * (1 + step / seen[:, 2:])) for step in (-0.5, 0.5))
    change[lit] = 1 / (2 * np.pi * (farther - nearer))
    return change


# --- rendered ------------------------------------------------------------------------------------------------------


def rendered(scene: str, pattern: str, known: str, seed: int) -> Taken:
    """Return a rendered frame, kept in `frames/`."""
    from camera_film import Sensor

    kept = read_kept(scene)
    calibration = Calibration.read(_FOLDER / "calibration.json")
    rows = np.cumsum(np.cumsum(kept["row"].astype(np.int64), axis=1), axis=0) / _ROWS
    phase, surface = 2 * np.pi / calibration.pattern.period_px * rows, kept["surface"]
    lit = np.unpackbits(kept["lit"]).reshape(surface.shape).astype(bool)
    points = points_of_rows(calibration, rows)
    truth = Truth(phase, lit, connected(points, lit, surface), depth_change(calibration, points, lit))
    update: dict[str, Any] = {"code": "contrast" if pattern == "coded" else None}
    if pattern == "compensated":
        update["compensated"] = True
    elif known == "all":
        update["compensated"] = False
    changed: dict[str, Any] = {"pattern": calibration.pattern.model_copy(update=update), "capture": None}
    if known != "all":
        changed |= {"response": None}
    if known == "nothing":
        changed |= {"crosstalk_matrix": None}
    calibration = calibration.model_copy(update=changed)
    light = np.cumsum(kept[pattern].astype(np.int64), axis=1).astype(np.float32) / _LEVELS
    return Taken([Sensor().expose(light, 1.0, seed)], [calibration], truth)


def read_kept(scene: str) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays that are kept of a scene."""
    with np.load(io.BytesIO(lzma.decompress((_FOLDER / f"{scene}.npz.xz").read_bytes()))) as kept:
        return dict(kept)


def points_of_rows(rig: Calibration, rows: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return the places (H, W, 3), mm, where rays of a camera and planes of a projector without distortion meet."""
    geometry = rig.geometry()
    projector, t = geometry.projector.matrix, geometry.translation_mm
    rays = geometry.camera.rays().astype(np.float64)
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
    turned, place = rays @ geometry.rotation.T, rows - projector[1, 2]
    depth = (projector[1, 1] * t[1] - place * t[2]) / (place * turned[..., 2] - projector[1, 1] * turned[..., 1])
    return rays * depth[..., None]


def write_kept(cache: Path | None = None) -> None:
    """Render all scenes, and keep them in `frames/`."""
    from camera_film import Sensor  # noqa: F401 - fails here where the folder is not on the path
    from studio import Rig, Studio

    from tikernels import runtime

    runtime.init("cpu")
    studio = Studio(cache)
    _FOLDER.mkdir(exist_ok=True)
    studio.calibration(Rig()).write(_FOLDER / "calibration.json")
    for scene, patterns in RENDERED.items():
        truth = studio.truth(scene)
        rows = np.rint(_ROWS * np.where(truth.lit, truth.projector_row, 0)).astype(np.int32)
        # Differences along the stripes, and down as well where the rows grow, compress to a tenth.
        down = np.diff(rows, axis=0, prepend=np.int32(0))
        arrays = {
            "row": np.diff(down, axis=1, prepend=np.int32(0)),
            "lit": np.packbits(truth.lit),
            "surface": truth.surface,
        }
        for pattern in patterns:
            light = np.rint(_LEVELS * studio.exposure(scene) * studio.light(scene, pattern)).astype(np.int32)
            arrays[pattern] = np.diff(light, axis=1, prepend=np.int32(0)).astype(np.int16)
        memory = io.BytesIO()
        np.savez(memory, **arrays)
        (_FOLDER / f"{scene}.npz.xz").write_bytes(lzma.compress(memory.getvalue(), preset=9))
        print(scene, (_FOLDER / f"{scene}.npz.xz").stat().st_size, flush=True)


# --- captures ------------------------------------------------------------------------------------------------------


def captured_plane(name: str, times: int, seed: int) -> Taken:
    """Return a monochrome capture of a plane under stripes, shrunk."""
    image = read_rgb(CAPTURES / "kamino_plane" / f"{name}.png")
    with np.load(CAPTURES / "kamino_plane" / "plane_truth.npz") as known:
        phase, lit = known["phase_abs"].astype(np.float64), known["mask"]
    return shrunk(image, phase, lit, times)


def captured_object(axis: str, times: int, seed: int) -> Taken:
    """Return a monochrome capture of an object under stripes, shrunk; only the orders of its truth are independent."""
    image = read_rgb(CAPTURES / "kamino_object1" / f"object1_{axis}_rgb.png")
    with np.load(CAPTURES / "kamino_object1" / f"object1_{axis}_truth.npz") as known:
        phase, lit = known["phase_abs"].astype(np.float64), known["mask"] & ~known["saturated"]
    taken = shrunk(image, phase, lit, times, "vertical" if axis == "x" else "horizontal")
    return replace(taken, truth=replace(taken.truth, orders_only=True))


def shrunk(
    image: npt.NDArray[Any],
    phase: npt.NDArray[np.float64],
    lit: npt.NDArray[np.bool_],
    times: int,
    stripes: str = "vertical",
) -> Taken:
    """Return a capture whose pixels are means of squares."""
    height, width = (n // times * times for n in lit.shape)

    def squares(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        parts = values[:height, :width].astype(np.float64).reshape(height // times, times, width // times, times, -1)
        return parts.mean(axis=(1, 3)).squeeze()

    lit, phase = squares(lit) == 1, squares(np.where(lit, phase, 0))
    far = np.stack([phase, 0 * phase, 0 * phase], axis=-1) * (_STEP_MM / np.pi)  # surfaces end where phases step by pi
    truth = Truth(phase, lit, connected(far, lit), np.full(lit.shape, np.nan, np.float32))
    small = np.rint(squares(image)).astype(np.uint8)
    return Taken([small], [None], truth, {"stripes": stripes, "crosstalk_matrix": np.eye(3).tolist()})


def captured_parcel(pattern: str, seed: int) -> Taken:
    """Return another renderer's parcel before a wall, under vertical stripes and lenses that distort."""
    folder = CAPTURES / "rendered2"
    calibration = calibrated(folder, pattern)
    with np.load(folder / "parcel_truth.npz") as known:
        column, depth, lit, paint = (known[name] for name in ("projector_column", "depth_mm", "lit", "surface"))
    rays = calibration.geometry().camera.rays().astype(np.float64)
    points = np.concatenate([rays, np.ones((*lit.shape, 1))], axis=-1) * depth[..., None]
    phase = 2 * np.pi / calibration.pattern.period_px * np.nan_to_num(column.astype(np.float64))
    truth = Truth(phase, lit, connected(points, lit, paint), depth_change(calibration, points, lit))
    return Taken([read_rgb(folder / f"parcel_{pattern}.png")], [calibration], truth, {"stripes": "vertical"})


def captured_ball(seed: int) -> Taken:
    """Return the matt painted ball under the coded pattern with the response undone."""
    folder = CAPTURES / "rendered"
    calibration = calibrated(folder, "compcoded")
    with np.load(folder / "matt_truth.npz") as known:
        row, lit, paint = (known[name] for name in ("projector_row", "lit", "surface"))
    rows = np.nan_to_num(row.astype(np.float64))
    points = points_of_rows(calibration, rows)
    phase = 2 * np.pi / calibration.pattern.period_px * rows
    truth = Truth(phase, lit, connected(points, lit, paint), depth_change(calibration, points, lit))
    return Taken([read_rgb(folder / "matt_compcoded.png")], [calibration], truth)


def calibrated(folder: Path, pattern: str) -> Calibration:
    """Return a folder's calibration with one of its patterns."""
    values = json.loads((folder / "calibration.json").read_text(encoding="utf-8"))
    values["pattern"] = json.loads((folder / f"{pattern}.json").read_text(encoding="utf-8"))
    return Calibration.model_validate_json(json.dumps(values))


def read_rgb(path: Path) -> npt.NDArray[Any]:
    """Return a picture's levels, (H, W, 3)."""
    return np.ascontiguousarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1])


# --- all of them ---------------------------------------------------------------------------------------------------


def _simulated(
    name: str, scene: str, gamma: float, color: tuple[float, ...], code: str | None, known: str, **more: Any
) -> Frame:
    return Frame(name, partial(simulated, scene, gamma, color, code, known, more))


def _rendered(name: str, scene: str, pattern: str, known: str) -> Frame:
    return Frame(name, partial(rendered, scene, pattern, known))


_BLURRED = {"projector_blur_px": (1.0,) * 3, "camera_blur_px": (0.7,) * 3}
_PAINTED = {"gamma": 2.0, "painted": True}


def frames() -> dict[str, Frame]:
    """Return all frames by name; those of captures only where these are."""
    found = [
        _simulated("plane-white-1", "plane", 1.0, WHITE, None, "matrix"),
        _simulated("plane-skin-2", "plane", 2.0, SKIN, None, "nothing"),
        _simulated("waves-white-1.4-coded", "waves", 1.4, WHITE, "contrast", "matrix"),
        _simulated("waves-skin-2.4", "waves", 2.4, SKIN, None, "nothing"),
        _simulated("bust-white-1", "bust", 1.0, WHITE, None, "matrix"),
        _simulated("bust-white-2.4", "bust", 2.4, WHITE, None, "nothing"),
        _simulated("bust-skin-1.8", "bust", 1.8, SKIN, None, "matrix"),
        _simulated("bust-skin-2-all", "bust", 2.0, SKIN, None, "all"),
        _simulated("bust-skin-2-coded", "bust", 2.0, SKIN, "contrast", "matrix"),
        _simulated("bust-skin-2-blurred", "bust", 2.0, SKIN, "contrast", "nothing", **_BLURRED),
        _simulated("objects-white-1", "objects", 1.0, WHITE, None, "matrix"),
        _simulated("objects-skin-2", "objects", 2.0, SKIN, None, "matrix"),
        _simulated("objects-skin-2-coded", "objects", 2.0, SKIN, "contrast", "matrix"),
        _simulated("ball-white-1.4-coded", "ball", 1.4, WHITE, "contrast", "matrix"),
        _simulated("ball-skin-2", "ball", 2.0, SKIN, None, "nothing"),
        _rendered("r-plane", "plane", "plain", "nothing"),
        _rendered("r-face", "face", "plain", "nothing"),
        _rendered("r-face-coded", "face", "coded", "matrix"),
        _rendered("r-face-compensated", "face", "compensated", "all"),
        _rendered("r-objects", "objects", "plain", "all"),
        _rendered("r-objects-coded", "objects", "coded", "nothing"),
        _rendered("r-grey-objects-coded", "grey_objects", "coded", "matrix"),
        _rendered("r-board", "board", "plain", "matrix"),
        _rendered("r-corner", "corner", "plain", "nothing"),
        _rendered("r-dark-beside-bright", "dark_beside_bright", "plain", "matrix"),
        _rendered("r-deep-out-of-focus", "deep_out_of_focus", "plain", "matrix"),
        Frame("pile-small-coded", partial(pile, {"objects": 10, "cycles": (5, 8), "gamma": 2.0}), own_truth=True),
        Frame("pile-painted-coded", partial(pile, {"objects": 4, "cycles": (10, 20), **_PAINTED}), own_truth=True),
        Frame(
            "touching-coded",
            partial(pile, {"objects": 5, "cycles": (6, 14), **_PAINTED, "touching": True}),
            own_truth=True,
        ),
        Frame(
            "touching",
            partial(pile, {"objects": 5, "cycles": (6, 14), **_PAINTED, "touching": True, "code": None}),
            own_truth=True,
        ),
        Frame("film", partial(film, "objects", "plain", 6), own_truth=True),
        Frame("film-in-turns", in_turns),
        Frame("film-coded-once", partial(film, "bust", "coded once", 6), own_truth=True),
    ]
    if CAPTURES.is_dir():
        found += [
            Frame("capture-plane-0.75", partial(captured_plane, "plane_gp075_rgb", 8), 1),
            Frame("capture-plane-1.25", partial(captured_plane, "plane_gp125_rgb", 8), 1),
            Frame("capture-object-x", partial(captured_object, "x", 4), 1),
            Frame("capture-object-y", partial(captured_object, "y", 4), 1),
            Frame("capture-parcel", partial(captured_parcel, "plain"), 1),
            Frame("capture-parcel-coded", partial(captured_parcel, "coded"), 1),
            Frame("capture-ball-coded", captured_ball, 1),
        ]
    return {frame.name: frame for frame in found}


if __name__ == "__main__":
    write_kept(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
