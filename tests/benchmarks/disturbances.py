"""What disturbs the codes: the same scenes under both of them and under the plain pattern, disturbance by disturbance.

    python tests/benchmarks/disturbances.py [--scene pieces bust] [--frames 12] [--row "noise of 4 levels"]

Pieces are ten objects of 1.5 to 9 cycles before a wall; the bust is the simulator's, turned by seed. Skin, gamma 2,
640x480, 12 px per cycle, three by three rays per pixel. All rows judge the same pixels: those lit by the projector and
brighter than 20 levels in the undisturbed frame. Of these are absolute and right, and per 100,000 absolute and wrong;
of the objects more than half is right; the RMS of the phase is compared with the plain pattern's, on right pixels.
"""

import argparse
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import _tests_path  # noqa: F401 - puts support on the path
import cv2
import numpy as np
import numpy.typing as npt
from support.piled_objects import PLACES, SIZE, Floats, Rays, Surface, light_seen, pile, projected, ray_through, traced

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Calibration
from pipeline.errors import DecodeWarning
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.raw.demosaicing import demosaic
from tikernels.raw.linearization import srgb_values
from tikernels.raw.pixel_format import PixelFormat

Image = npt.NDArray[Any]

CODES = ("contrast", "contrast2")
_GAMMA = 2.0
_CAMERA_BLUR_PX, _NOISE_LEVELS = 0.5, 1.5
# Camera px per mm on the objects, 640 px wide pictures.
_PX_PER_MM = 1.45


# --- disturbances --------------------------------------------------------------------------------------------------


def blurred(light: Image, sigma_px: tuple[float, float, float], share: float = 1.0) -> Image:
    """Blur this share of the projector's red, green and blue light."""
    soft = [cv2.GaussianBlur(np.ascontiguousarray(light[..., j]), (0, 0), sigma) for j, sigma in enumerate(sigma_px)]
    return (1 - share) * light + share * np.stack(soft, axis=-1)


def letters(rng: np.random.Generator) -> Floats:
    """Return lines of black print, 3 to 9 mm high."""
    paper, y = np.full(SIZE[::-1], 255, np.uint8), 0
    while y < SIZE[1]:
        size = rng.uniform(0.2, 0.6)
        y += int(40 * size) + 3
        text = "".join(chr(code) for code in rng.integers(65, 91, 120))
        cv2.putText(paper, text, (int(rng.integers(-30, 0)), y), cv2.FONT_HERSHEY_SIMPLEX, size, 50, 1, cv2.LINE_AA)
    return paper[..., None] / 255


def checks(rng: np.random.Generator, size_mm: float, colored: bool = False) -> Floats:
    """Return squares printed in two shades, or in colours of their own."""
    y, x = (np.indices(SIZE[::-1]) / (size_mm * _PX_PER_MM)).astype(int)
    if colored:
        return np.asarray(rng.uniform(0.7, 1.0, (y.max() + 1, x.max() + 1, 3))[y, x])
    return np.where((x + y) % 2, 0.3, 1.0)[..., None]


def from_one_side(light: Floats, reflectance: Floats) -> Floats:
    """Add a room's light that rises from 4 levels of red on skin to 40, and expose for it."""
    room = np.linspace(4, 40, SIZE[0])[:, None] / 255 * reflectance / SKIN[0]
    return 0.85 * light + room


def eight_bits(light: Floats) -> Image:
    """Store linear levels of 8 bits."""
    return np.rint(255 * light).astype(np.uint8)


def jpeg(light: Floats, quality: int) -> Image:
    """Store an sRGB JPEG whose chroma is halved either way, and read it."""
    chosen = [cv2.IMWRITE_JPEG_QUALITY, quality]
    chosen += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    file = cv2.imencode(".jpg", eight_bits(srgb_values(light))[..., ::-1], chosen)[1]
    return np.ascontiguousarray(cv2.imdecode(file, cv2.IMREAD_COLOR)[..., ::-1])


def mosaic(light: Floats) -> Image:
    """Store a Bayer mosaic of 8 bits, and develop it."""
    levels = eight_bits(light)
    plane = levels[..., 1].copy()
    plane[::2, ::2], plane[1::2, 1::2] = levels[::2, ::2, 0], levels[1::2, 1::2, 2]
    return np.array(runtime.to_host(demosaic(plane, PixelFormat("bayer"))))


def kept(values: Any, *_: Any) -> Any:
    """Disturb nothing."""
    return values


@dataclass(frozen=True)
class Disturbance:
    """What happens to a frame between projector and decoder."""

    projected: Callable[[Image], Image] = kept  # the projector's light, (Hp, Wp, 3)
    # During the exposure: by how many px to the right and down the objects lie off, and how bright the colours are.
    exposure: tuple[tuple[float, tuple[float, float, float]], ...] = ((0.0, (1.0, 1.0, 1.0)),)
    printed: Callable[[np.random.Generator], Floats | float] = lambda rng: 1.0
    exposed: Callable[[Floats, Floats], Floats] = kept  # light of full scale 1, by reflectance
    noise_levels: float = _NOISE_LEVELS
    stored: Callable[[Floats], Image] = eight_bits
    transfer: str = "linear"
    columns_px: float = 0.0  # by how much the calibration takes the projector's columns wrong


ROWS = {
    "nothing": Disturbance(),
    "projector out of focus, 2 px": Disturbance(partial(blurred, sigma_px=(2, 2, 2))),
    "projector out of focus, 4 px": Disturbance(partial(blurred, sigma_px=(4, 4, 4))),
    "light scatters in skin": Disturbance(partial(blurred, sigma_px=(3, 1.6, 0.8), share=0.5)),
    "noise of 4 levels": Disturbance(noise_levels=4.0),
    "a third of the light": Disturbance(exposed=lambda light, _: light / 3),
    "print, letters": Disturbance(printed=letters),
    "print, checks of 6 mm": Disturbance(printed=partial(checks, size_mm=6)),
    "print, checks of 12 mm": Disturbance(printed=partial(checks, size_mm=12)),
    "print, colours of 12 mm": Disturbance(printed=partial(checks, size_mm=12, colored=True)),
    "room light from one side": Disturbance(exposed=from_one_side),
    "clipped highlights": Disturbance(exposed=lambda light, _: 1.4 * light),
    "JPEG 4:2:0, quality 90": Disturbance(stored=partial(jpeg, quality=90), transfer="srgb"),
    "JPEG 4:2:0, quality 75": Disturbance(stored=partial(jpeg, quality=75), transfer="srgb"),
    "Bayer mosaic": Disturbance(stored=mosaic),
    "objects move 3 px": Disturbance(exposure=tuple((at, (1.0, 1.0, 1.0)) for at in (-0.85, -0.42, 0, 0.42, 0.85))),
    "colours in turn, 1 px apart": Disturbance(exposure=((-0.7, (3, 0, 0)), (0.0, (0, 3, 0)), (0.7, (0, 0, 3)))),
    "calibration 1 px off": Disturbance(columns_px=1.0),
}


# --- scenes --------------------------------------------------------------------------------------------------------


def moved(surface: Surface, rig: Calibration, px: float) -> Surface:
    """Return an object that lies so many px further to the right and down; the wall stays."""
    focal = rig.camera.matrix[0, 0]
    if surface.middle is not None:
        return replace(surface, middle=surface.middle + px * surface.middle[2] / focal * np.array([1, 1, 0]))
    if surface.outline is None:
        return surface
    ellipse, x, y, *half = surface.outline
    depth = surface.distance_mm / (ray_through(rig, x, y) @ surface.normal)
    ahead = float(px * depth / focal * surface.normal[:2].sum())
    return replace(surface, distance_mm=surface.distance_mm + ahead, outline=(ellipse, x + px, y + px, *half))


def pieces(rig: Calibration, seed: int, px: float) -> list[Rays]:
    """Return what is seen of ten objects before a wall."""
    rng = np.random.default_rng(seed)
    return traced(rig, [moved(surface, rig, px) for surface in pile(rng, rig, objects=10, cycles=(1.5, 9))])


def bust(rig: Calibration, seed: int, px: float) -> list[Rays]:
    """Return what is seen of the bust, turned by seed."""
    white = np.ones((*rig.projector.size_px[::-1], 3), np.float32)
    seen = []
    for place in PLACES:
        settings = SimulationSettings(
            crosstalk_matrix=np.eye(3),
            ambient=0.0,
            exposure=0.4,  # nothing is clipped
            noise_levels=0.0,
            bits=16,
            camera_shift_px=np.tile(-np.array(place), (3, 1)),
            object_motion_mm=(px * 0.65, px * 0.65, 0.0),
            object_turn_deg=-30.0 + 60.0 * np.random.default_rng(seed).random(),
        )
        frame = simulate_frame(rig, settings, white)
        column_row = rig.geometry().projector_px(np.nan_to_num(frame.points).reshape(-1, 3).astype(np.float64))
        strength = np.where(frame.mask, frame.image[..., 0] / 65535 / 0.4 / frame.reflectance[..., 0], 0)
        lit = column_row.reshape(*strength.shape, 2).astype(np.float32)
        seen.append(Rays(frame.points, lit, strength, np.nan_to_num(frame.reflectance), np.zeros(strength.shape, int)))
    return seen


SCENES = {"pieces": pieces, "bust": bust}


# --- figures -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Taken:
    """A frame under each pattern, and what is true of it."""

    images: dict[str | None, Image]
    phase: Floats  # (H, W) rad
    lit: npt.NDArray[np.bool_]  # what is judged
    number: npt.NDArray[np.int64]  # of the surface


def taken(scene: str, seed: int, rows: list[str]) -> Iterator[tuple[str, Taken]]:
    """Take one scene in each of the rows."""
    rigs = {code: simulated_rig(SIZE, code=code) for code in (None, *CODES)}
    light = {code: projected(rig, _GAMMA) for code, rig in rigs.items()}
    still = SCENES[scene](rigs[None], seed, 0.0)
    middle = still[len(still) // 2]
    undisturbed = light_seen(still, light[None])
    bright = 0.9 * undisturbed.mean(axis=2) > 20 / 255 * np.quantile(undisturbed, 0.995)
    lit = (middle.strength > 0) & bright
    phase = 2 * np.pi / rigs[None].pattern.period_px * middle.projector_px[..., 1].astype(np.float64)
    for row in rows:
        disturbance, images = ROWS[row], {}
        seen = dict.fromkeys(rigs, 0.0)
        for px, brightness in disturbance.exposure:
            rays = still if px == 0 else SCENES[scene](rigs[None], seed, px)
            for code in rigs:
                shown = disturbance.projected(light[code]) * np.array(brightness, np.float32)
                seen[code] = seen[code] + light_seen(rays, shown) / len(disturbance.exposure)
        for code in rigs:
            rng = np.random.default_rng(seed)
            image = 0.9 * seen[code] / np.quantile(seen[code], 0.995) * disturbance.printed(rng)
            image = cv2.GaussianBlur(disturbance.exposed(image, middle.reflectance), (0, 0), _CAMERA_BLUR_PX)
            noise = np.random.default_rng(seed).standard_normal(image.shape)
            images[code] = disturbance.stored(np.clip(image + disturbance.noise_levels / 255 * noise, 0, 1))
        yield row, Taken(images, phase, lit, middle.number)


def decoded(frame: Taken, row: str) -> dict[str | None, Any]:
    """Decode the frame of each pattern."""
    result = {}
    for code, image in frame.images.items():
        rig = simulated_rig(SIZE, code=code)
        projector = rig.projector.model_copy(update={"matrix": rig.projector.matrix.copy()})
        projector.matrix[0, 2] += ROWS[row].columns_px
        calibration = rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK), "projector": projector})
        result[code] = Decoder(DecodeSettings(transfer=ROWS[row].transfer), calibration).decode(image)
    return result


def counts(frame: Taken, results: dict[str | None, Any]) -> Counter:
    """Return what the figures are made of."""
    number: Counter = Counter(lit=frame.lit.sum())
    off = {code: np.nan_to_num(result.unwrapped_phase) - frame.phase for code, result in results.items()}
    for code in CODES:
        known = results[code].absolute & frame.lit
        wrong = known & (np.abs(off[code]) > np.pi)
        right = known & ~wrong
        number[code, "right"], number[code, "wrong"] = right.sum(), wrong.sum()
        both = right & results[None].mask
        number[code, "square"] = (off[code][both] ** 2).sum()
        number[code, "plain"] = (np.angle(np.exp(1j * off[None][both])) ** 2).sum()
        for surface in range(1, frame.number.max() + 1):
            own = frame.lit & (frame.number == surface)
            if own.sum() >= 60:
                number[code, "objects"] += 1
                number[code, "found"] += bool((right & own).sum() > 0.5 * own.sum())
    return number


def main() -> None:
    """Print a row per disturbance: contrast / contrast2."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="*", choices=SCENES, default=list(SCENES))
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--row", nargs="*", choices=ROWS, default=list(ROWS))
    chosen = parser.parse_args()
    runtime.init("cpu")
    warnings.simplefilter("ignore", DecodeWarning)
    totals: dict[str, dict[str, Counter]] = {row: {scene: Counter() for scene in chosen.scene} for row in chosen.row}
    for scene in chosen.scene:
        for seed in range(chosen.frames):
            for row, frame in taken(scene, seed, chosen.row):
                totals[row][scene].update(counts(frame, decoded(frame, row)))
    print_table(totals)


def print_table(totals: dict[str, dict[str, Counter]]) -> None:
    """Print the figures of each row and scene."""
    for row, scenes in totals.items():
        cells = {f"{scene}: {name}": both for scene, number in scenes.items() for name, both in figures(number)}
        if row == next(iter(totals)):
            print("| disturbance | " + " | ".join(cells) + " |\n|---|" + "---|" * len(cells))
        print(f"| {row} | " + " | ".join(cells.values()) + " |")


def figures(number: Counter) -> Iterator[tuple[str, str]]:
    """Yield the share of pixels right, pixels wrong, the share of objects, and phase error over the plain pattern's."""

    def both(value: Callable[[str], float], form: str) -> str:
        return " / ".join(f"{value(code):{form}}" for code in CODES)

    yield "right", both(lambda code: number[code, "right"] / number["lit"], ".4f")
    yield "wrong", both(lambda code: 1e5 * number[code, "wrong"] / number["lit"], ".0f")
    if number[CODES[0], "objects"]:
        yield "objects", both(lambda code: number[code, "found"] / number[code, "objects"], ".2f")
    yield "phase", both(lambda code: np.sqrt(number[code, "square"] / number[code, "plain"]), ".2f")


if __name__ == "__main__":
    main()
