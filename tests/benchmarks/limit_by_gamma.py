"""How close the phase comes to the information limit, by the projector's response.

python tests/benchmarks/limit_by_gamma.py [--scenes plane ball ...]

Simulated frames at 640x480 are decoded without smoothing, with the true matrix and response, with the matrix alone, and
with nothing known. A figure is the error's RMS over the lit pixels, one constant removed, over the RMS of their bounds
of Cramer and Rao, first of pixels whose brightness is known, then of those whose brightness has to be found, too;
behind it the amplitude of the error's third harmonic, mrad, and how much of the error lies within one standard
deviation.
"""

import argparse
import warnings

import _tests_path  # noqa: F401 - puts support on the path
import numpy as np
from support.phase_limit import phase_limit

import tikernels
from pipeline import Decoder, DecodeSettings
from pipeline.simulation import SKIN, WHITE, SimulationSettings, simulate_frame, simulated_rig

GAMMAS = (1.0, 1.4, 1.8, 2.0, 2.3)
KNOWN = ("response", "matrix", "nothing")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["plane", "waves", "bust", "ball"])
    scenes = parser.parse_args().scenes
    warnings.simplefilter("ignore")
    tikernels.init("cpu")
    rig = simulated_rig()
    print(f"{'scene':7} {'surface':7} gamma", *(f"{known:>24}" for known in KNOWN))
    ratios: dict[str, list[list[float]]] = {known: [] for known in KNOWN}
    for scene in scenes:
        for name, color in (("white", WHITE), ("skin", SKIN)):
            for gamma in GAMMAS:
                settings = SimulationSettings(scene=scene, gamma=gamma, reflectance=color)
                truth = simulate_frame(rig, settings)
                limits = [phase_limit(truth, settings, brightness_known=known) for known in (True, False)]
                row = []
                for known in KNOWN:
                    told = {}
                    if known != "nothing":
                        told["crosstalk_matrix"] = settings.crosstalk_matrix
                    if known == "response":
                        told["response"] = np.tile(np.linspace(0, 1, 256) ** gamma, (3, 1))
                    calibration = rig.model_copy(update=told) if told else None
                    frame = Decoder(DecodeSettings(smoothing_px=1), calibration, arch="cpu").decode(truth.image)
                    judged = frame.mask & truth.mask & (truth.image.mean(axis=-1) > 20) & np.isfinite(limits[0])
                    error = frame.unwrapped_phase[judged] - truth.phase[judged]
                    error = np.angle(np.exp(1j * error) / np.exp(1j * error).mean())
                    third = 2 * abs((error * np.exp(-3j * truth.phase[judged])).mean())
                    within = (np.abs(error) < frame.phase_sigma[judged]).mean()
                    rms = [float(np.sqrt((error**2).mean() / (limit[judged] ** 2).mean())) for limit in limits]
                    ratios[known].append(rms)
                    row.append(f"{rms[0]:7.3f} {rms[1]:5.3f} {1e3 * third:5.1f} {within:4.2f}")
                print(f"{scene:7} {name:7} {gamma:5.1f}", *row, flush=True)
    for known, found in ratios.items():
        print(f"{known}: median {np.median(found, axis=0)}, worst {np.max(found, axis=0)}")


if __name__ == "__main__":
    main()
