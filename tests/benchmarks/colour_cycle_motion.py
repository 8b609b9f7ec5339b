"""Measure what an exposure costs that is not a whole number of the projector's colour cycles.

The exposure is off by a fraction d of itself. In that time one colour is on, and of it either every mirror for the
share of its level ("even"), or those of the levels above half only ("top bit"); with a rolling shutter another colour
from row to row ("rolling", four cycles from the first row to the last). Printed is by how much the decoded phase moves,
noise and all else staying: its constant, its RMS around that, what 99.9 % of the pixels stay below, and the limit by
`hardware.colour_cycle.phase_error_limit`. Frames have 16 bits, so that rounding moves nothing.

    python tests/benchmarks/colour_cycle_motion.py
"""

import argparse

import _tests_path  # noqa: F401 - puts support on the path
import numpy as np
from support.exposures_off_cycle import KINDS, SHARE, moved, simulate_exposure

from hardware.colour_cycle import phase_error_limit
from pipeline import Decoder, DecodeSettings
from pipeline.simulation import SimulationSettings
from tikernels import runtime


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
