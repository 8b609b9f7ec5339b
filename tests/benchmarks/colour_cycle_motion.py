"""Measure what an exposure costs that is not a whole number of the projector's colour cycles.

The exposure is off by a fraction d of itself. In that time one colour is on, and of it either every mirror for the
share of its level ("even"), or those of the levels above half only ("top bit"); with a rolling shutter another colour
from row to row ("rolling", four cycles from the first row to the last). Printed is by how much the decoded phase moves,
noise and all else staying: its constant, its RMS around that, what 99.9 % of the pixels stay below, and the limit by
`hardware.colour_cycle.phase_error_limit`. Frames have 16 bits, so that rounding moves nothing.

    python tests/benchmarks/colour_cycle_motion.py
"""

import argparse

import numpy as np
import numpy.typing as npt

from hardware.colour_cycle import phase_error_limit
from pipeline import Decoder, DecodeSettings
from pipeline.pattern.fringes import make_pattern
from pipeline.simulation import SimulatedFrame, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

KINDS = ("even", "top bit", "rolling")
SHARE = 1 / 3


def exposed(
    codes: npt.NDArray[np.float32], deviation: float, kind: str, channel: int, gamma: float
) -> npt.NDArray[np.float32]:
    """Return the codes that make the light of an exposure that is longer by so much, all of it in one channel."""
    light = np.rint(255 * codes.astype(np.float64) ** gamma) / 255
    on = light > 0.5 if kind == "top bit" else light
    light[..., channel] += (deviation / SHARE * on)[..., channel]
    return (light ** (1 / gamma)).astype(np.float32)


def simulate_exposure(
    deviation: float, kind: str, scene: str = "plane", size_px: tuple[int, int] = (640, 480), channel: int = 0
) -> SimulatedFrame:
    """Photograph a scene with such an exposure."""
    rig = simulated_rig(size_px, period_px=768 / 44 * 640 / size_px[0])
    settings = SimulationSettings(scene=scene, bits=16, noise_levels=0.5, exposure=0.8)
    codes = make_pattern((1024, 768), rig.geometry().pattern)
    channels = range(3) if kind == "rolling" else (channel,)
    how = "top bit" if kind == "rolling" else kind
    frames = [simulate_frame(rig, settings, exposed(codes, deviation, how, c, settings.gamma)) for c in channels]
    if kind == "rolling":
        bands = np.arange(size_px[1]) * 12 // size_px[1] % 3
        for c in (1, 2):
            frames[0].image[bands == c] = frames[c].image[bands == c]
    return frames[0]


def moved(decoder: Decoder, straight: SimulatedFrame, other: SimulatedFrame) -> npt.NDArray[np.float64]:
    """Return by how much the phase differs where both are measured, rad."""
    first = decoder.decode(straight.image).wrapped_phase.copy()
    second = decoder.decode(other.image).wrapped_phase
    difference = (second - first)[np.isfinite(first) & np.isfinite(second)]
    return np.asarray(np.angle(np.exp(1j * difference.astype(np.float64))))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="plane")
    scene = parser.parse_args().scene
    runtime.init("cpu")
    settings = SimulationSettings()
    decoder = Decoder(DecodeSettings(crosstalk_matrix=settings.crosstalk_matrix), arch="cpu")
    straight = simulate_exposure(0.0, "even", scene)
    print("| extra light | d | constant, rad | RMS, rad | 99.9 %, rad | limit, rad |")
    print("|---|---|---|---|---|---|")
    for kind in KINDS:
        for deviation in (0.002, 0.005, 0.01, 0.03, 0.1):
            by = moved(decoder, straight, simulate_exposure(deviation, kind, scene))
            most = np.quantile(np.abs(by), 0.999)
            limit = phase_error_limit(deviation, SHARE)
            row = f"| {kind} | {deviation} | {by.mean():.4f} | {by.std():.4f} | {most:.4f} | {limit:.3f} |"
            print(row, flush=True)


if __name__ == "__main__":
    main()
