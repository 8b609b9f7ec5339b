"""How good a frame's texture is: how it goes with reflectance times shading, and what is left of the fringe.

python tests/benchmarks/texture_quality.py

The truth is the same scene under the projector's white, without noise. Correlation over the lit pixels of the mask, the
least of the three channels; the fringe's energy, harmonics 1 to 3, over the frame's, dB (`tests/support/textures.py`);
the relative error, RMS. Painted surfaces are pictures that multiply the frame, so that they act after the crosstalk.
Last, the time that a texture takes.
"""

import time
import warnings
from collections.abc import Iterator
from dataclasses import replace

import _tests_path  # noqa: F401 - puts support on the path
import cv2
import numpy as np
import numpy.typing as npt
from support.textures import linear_light, ripple_below_frame_db, white_frame

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Calibration
from pipeline.simulation import SimulatedFrame, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.phase.texture import measure_texture

PAINTS = np.array([[0.75, 0.52, 0.42], [0.25, 0.35, 0.70], [0.70, 0.65, 0.20], [0.30, 0.60, 0.35], [0.8, 0.8, 0.8]])
NOISE = 1.5 / 255
Array = npt.NDArray[np.floating]


def main() -> None:
    """Print the table, and the time."""
    warnings.simplefilter("ignore")
    runtime.init("cpu")
    print("| surface | pattern | gamma | known | correlation | fringe, dB | relative error |")
    print("|---|---|---|---|---|---|---|")
    for code in (None, "contrast"):
        rig = simulated_rig(code=code)
        for name, gamma, frame, white, matrix in (*skins(rig), *painted(rig)):
            known = rig.model_copy(update={"crosstalk_matrix": matrix})
            for calibration, says in ((known, "calibrated"), (None, "nothing")):
                decoder = Decoder(DecodeSettings(code=code), calibration, arch="cpu")
                decoded = decoder.decode(frame.image)
                row = judged(linear_light(decoded.texture), white, frame, decoded.mask, decoded.period_px or 1.0)
                print(f"| {name} | {code or 'plain'} | {gamma} | {says} | {row} |", flush=True)
    light, surface = decoded._measured.light, decoded._measured.surface
    assert light is not None
    times = []
    for _ in range(20):
        start = time.perf_counter()
        measure_texture(light, surface.unwrapped, surface.mask, decoded.period_px or 1.0)
        times.append(time.perf_counter() - start)
    print(f"\na texture of 640x480 takes {1e3 * min(times):.0f} ms, and keeping the image for it", end=" ")
    image = np.empty_like(frame.image)
    start = time.perf_counter()
    for _ in range(100):
        np.copyto(image, frame.image)
    print(f"{10 * (time.perf_counter() - start):.2f} ms")


def judged(texture: Array, white: Array, frame: SimulatedFrame, mask: npt.NDArray[np.bool_], period_px: float) -> str:
    """Return a row's figures."""
    lit = mask & frame.mask
    seen, true = texture[lit], white[lit]
    scale = (seen * true).sum(axis=0) / (true**2).sum(axis=0)
    correlation = min(np.corrcoef(seen[:, k], true[:, k])[0, 1] for k in range(3))
    error = np.sqrt(((seen / (scale * true) - 1) ** 2).mean())
    return f"{correlation:.3f} | {ripple_below_frame_db(texture, white, frame, lit, period_px):.0f} | {error:.3f}"


Case = tuple[str, float, SimulatedFrame, Array, npt.NDArray[np.float64]]


def skins(rig: Calibration) -> Iterator[Case]:
    """Yield the simulated scenes."""
    cases = [("bust", gamma, "broad") for gamma in (1.0, 1.4, 2.0, 2.4)]
    for scene, gamma, bands in (*cases, ("bust", 2.0, "narrow"), *((s, 2.0, "broad") for s in ("objects", "plane"))):
        settings = SimulationSettings(scene=scene, gamma=gamma, reflectance_bands=bands)
        name = f"{scene}, skin" + (", narrow bands" if bands == "narrow" else "")
        yield name, gamma, simulate_frame(rig, settings), white_frame(rig, settings), settings.crosstalk_matrix


def painted(rig: Calibration) -> Iterator[Case]:
    """Yield a plane with pictures on it."""
    settings = SimulationSettings(scene="plane", texture=0.0, reflectance=(1, 1, 1), noise_levels=0, bits=16)
    blank, white = simulate_frame(rig, settings), white_frame(rig, settings)
    noise = NOISE * np.random.default_rng(1).standard_normal(blank.image.shape)
    for name, picture in pictures(blank.mask.shape):
        light = blank.image / blank.white_level * picture
        light = 0.9 / np.quantile(light, 0.995) * light + noise
        levels = np.rint(255 * np.clip(light, 0, 1)).astype(np.uint8)
        frame = replace(blank, image=levels, white_level=255)
        yield f"plane, {name}", 2.0, frame, white * picture, settings.crosstalk_matrix


def pictures(shape: tuple[int, int]) -> Iterator[tuple[str, Array]]:
    """Yield reflectances, (H, W, 3), blurred as a lens does."""
    y, x = np.indices(shape)
    text = np.full((*shape, 3), 204, np.uint8)
    for row in range(30, shape[0], 40):
        cv2.putText(text, "colour phase 0123456789", (5, row), cv2.FONT_HERSHEY_SIMPLEX, 1.0, (64, 64, 64), 2)
    for name, picture in (
        ("print, grey", text / 255),
        ("paint, stripes across", PAINTS[x // 60 % 5]),
        ("paint, stripes along", PAINTS[y // 50 % 5]),
        ("paint, squares", PAINTS[(x // 70 + 2 * (y // 70)) % 5]),
    ):
        yield name, cv2.GaussianBlur(picture, (0, 0), 0.5)


if __name__ == "__main__":
    main()
