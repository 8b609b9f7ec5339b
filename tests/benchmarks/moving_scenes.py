"""The study of video: objects that swing and turn, frame after frame, their orders measured against the truth.

python tests/benchmarks/moving_scenes.py [--frames 300] [--seed 0] [--speed 1] [--scenes bust ball objects] [--arch cpu]

The order error of a pixel is its unwrapped phase less the true one, in whole cycles. A surface of the truth is a
connected set of lit pixels whose neighbours lie less than 4 mm apart; it goes on in the frame after as the surface
there that covers most of it at nearly the same depth. Its reference is the commonest error when it first appears, and 0
where a code tells the orders. A flip is 20 or more connected pixels of one surface with another error than its
reference. Three patterns: the plain one, the coded one, and the plain one after a first frame with the code.
"""

import argparse
import time
import warnings
from collections.abc import Iterator

import cv2
import numpy as np
import numpy.typing as npt

from pipeline import DecodedFrame, Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.simulation import SimulatedFrame, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

PATTERNS = ("plain", "coded", "coded once")
# What makes a flip, px; how far apart neighbours on a surface may lie, and how far it moves in a frame, mm.
_FLIP_PX, _STEP_MM, _SAME_MM = 20, 4.0, 15.0
_LIT_LEVELS, _RIM_PX = 20, 4


def main() -> None:
    """Print one row a scene and pattern."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0, help="another one: another path and noise")
    parser.add_argument("--speed", type=float, default=1.0, help="how many times as fast everything moves")
    parser.add_argument("--scenes", nargs="+", default=["bust", "ball", "objects"])
    parser.add_argument("--patterns", nargs="+", default=list(PATTERNS), choices=PATTERNS)
    parser.add_argument("--arch", default="cpu")
    arguments = parser.parse_args()
    runtime.init(arguments.arch)
    warnings.simplefilter("ignore", DecodeWarning)
    print(
        "| scene | pattern | frames with a flip | largest, px | all, px | 4 px inside: frames, largest, all "
        "| coverage, least | absolute | absolute but wrong, px | cost |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for scene in arguments.scenes:
        for pattern in arguments.patterns:
            print(row(scene, pattern, arguments.frames, arguments.seed, DecodeSettings(), arguments.speed), flush=True)


def row(scene: str, pattern: str, frames: int, seed: int, settings: DecodeSettings, speed: float) -> str:
    """Return what one scene under one pattern comes to."""
    flips = Flips(known=pattern != "plain")
    coverage, absolute, wrong = [], [], 0
    for frame, truth in decoded(scene, pattern, frames, seed, settings, speed):
        lit = flips.add(frame, truth)
        coverage.append(frame.mask[lit].mean())
        absolute.append(frame.absolute[frame.mask].mean())
        error = np.abs(np.where(frame.absolute & truth.mask, frame.unwrapped_phase - truth.phase, 0))
        wrong += int((error > np.pi).sum())
    cells = [scene, pattern, *flips.summary(), f"{np.mean(coverage):.4f}, {np.min(coverage):.4f}"]
    cells += [f"{np.mean(absolute):.3f}", f"{wrong}", f"{cost(scene, pattern, settings, seed):.2f}"]
    return "| " + " | ".join(cells) + " |"


def moved(scene: str, number: int, seed: int, speed: float) -> SimulationSettings:
    """Return the settings of one frame of objects that swing along three axes and turn, each at its own pace."""
    random = np.random.default_rng(seed)
    pace, start = random.uniform(40, 80, 4) / speed, random.uniform(0, 2 * np.pi, 4)
    swing = np.sin(2 * np.pi * number / pace + start)
    return SimulationSettings(
        scene=scene,
        object_motion_mm=(30 * swing[0], 8 * swing[1], 25 * swing[2] - 15),
        object_turn_deg=20 * swing[3],
        seed=1000 * seed + number,
    )


def decoded(
    scene: str, pattern: str, frames: int, seed: int, settings: DecodeSettings, speed: float = 1.0
) -> Iterator[tuple[DecodedFrame, SimulatedFrame]]:
    """Decode a video, every frame with the one before."""
    code = None if pattern == "plain" else "contrast"
    frame = None
    for number in range(frames):
        if number == 0 or (number == 1 and pattern == "coded once"):
            rig = simulated_rig(code=code if number == 0 else None)
            light = SimulationSettings().crosstalk_matrix
            decoder = Decoder(settings, rig.model_copy(update={"crosstalk_matrix": light}))
        truth = simulate_frame(rig, moved(scene, number, seed, speed))
        frame = decoder.decode(truth.image, previous=frame)
        yield frame, truth


class Flips:
    """Count the flips of a video.

    Parameters
    ----------
    known : bool
        Whether every surface's reference is 0, or its commonest error when it first appears.
    """

    def __init__(self, known: bool) -> None:
        self.known = known
        self.references: list[int] = []  # by identity
        self.before: tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]] | None = None
        self.flips: list[list[tuple[int, ...]]] = []  # of every frame, its blobs' pixels: everywhere, and inside
        self.last: npt.NDArray[np.bool_] = np.zeros(0, np.bool_)  # (H, W) the last frame's flips

    def add(self, frame: DecodedFrame, truth: SimulatedFrame) -> npt.NDArray[np.bool_]:
        """Count one frame's flips, and return its lit pixels."""
        bright = truth.mask & (truth.image.mean(axis=2) > _LIT_LEVELS)
        square = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)
        inside = cv2.erode(truth.mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0) != 0
        error = np.rint(np.where(frame.mask & truth.mask, frame.unwrapped_phase - truth.phase, 0) / (2 * np.pi))
        surface = surfaces(truth, truth.mask)
        identity = self._follow(surface, truth, np.where(frame.mask & bright, error, np.nan))
        reference = np.array([0, *self.references])[identity]
        self.last = frame.mask & bright & (identity > 0) & (error != reference)
        blobs = []
        for within in (self.last, self.last & inside):
            sizes = np.bincount(surfaces(truth, within).ravel())[1:]
            blobs.append(tuple(int(size) for size in sizes[sizes >= _FLIP_PX]))
        self.flips.append(blobs)
        return bright & inside

    def _follow(
        self, surface: npt.NDArray[np.int32], truth: SimulatedFrame, error: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.int32]:
        """Return the identity of every pixel's surface, 0 where there is none yet."""
        depth = truth.points[..., 2]
        identities = np.zeros(surface.max() + 1, np.int32)
        count = len(self.references) + 1
        if self.before is not None:
            before, depth_before = self.before
            same = (surface > 0) & (before > 0) & (np.abs(depth - depth_before) < _SAME_MM)
            shared = np.bincount(surface[same] * count + before[same], minlength=len(identities) * count)
            shared = shared.reshape(-1, count)
            identities = np.where(shared.max(axis=1) > 0, shared.argmax(axis=1), 0).astype(np.int32)
        for number in range(1, len(identities)):
            seen = error[(surface == number) & np.isfinite(error)]
            if identities[number] == 0 and len(seen) >= _FLIP_PX:
                values, votes = np.unique(seen, return_counts=True)
                self.references.append(0 if self.known else int(values[votes.argmax()]))
                identities[number] = len(self.references)
        identity: npt.NDArray[np.int32] = identities[surface]
        self.before = identity, depth
        return identity

    def summary(self) -> list[str]:
        """Return frames with a flip, largest flip and all flipped pixels; and the same 4 px inside the lit area."""
        columns = []
        for place in range(2):
            blobs = [frame[place] for frame in self.flips]
            sizes = [size for frame in blobs for size in frame]
            columns.append((sum(map(bool, blobs)), max(sizes, default=0), sum(sizes)))
        return [*(str(value) for value in columns[0]), ", ".join(str(value) for value in columns[1])]


def surfaces(truth: SimulatedFrame, within: npt.NDArray[np.bool_]) -> npt.NDArray[np.int32]:
    """(H, W) int32: number of the connected part of a true surface that each of these pixels lies on; 0 elsewhere."""
    height, width = within.shape
    # On a grid twice as fine the places between two pixels say whether they are joined.
    grid = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)
    grid[::2, ::2] = within
    with np.errstate(invalid="ignore"):
        joined_down = np.linalg.norm(np.diff(truth.points, axis=0), axis=-1) < _STEP_MM
        joined_right = np.linalg.norm(np.diff(truth.points, axis=1), axis=-1) < _STEP_MM
    grid[1::2, ::2] = joined_down & within[1:] & within[:-1]
    grid[::2, 1::2] = joined_right & within[:, 1:] & within[:, :-1]
    labels: npt.NDArray[np.int32] = cv2.connectedComponents(grid, connectivity=4)[1][::2, ::2]
    return labels


def cost(scene: str, pattern: str, settings: DecodeSettings, seed: int) -> float:
    """Return CPU time with the frame before over that without."""
    frames = [truth for _, truth in decoded(scene, pattern, 2, seed, settings)]
    rig = frames[1].rig.model_copy(update={"crosstalk_matrix": SimulationSettings().crosstalk_matrix})
    decoder = Decoder(settings, rig)
    before = decoder.decode(frames[0].image)
    spent = np.zeros((2, 15))
    for turn in range(-2, spent.shape[1]):  # the first two warm up
        for use in range(2):
            start = time.process_time()
            decoder.decode(frames[1].image, previous=before if use else None)
            runtime.synchronize()
            if turn >= 0:
                spent[use, turn] = time.process_time() - start
    without, used = np.median(spent, axis=1)
    return float(used / without)


if __name__ == "__main__":
    main()
