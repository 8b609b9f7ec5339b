"""What a frame tells of its rig's light: board-free estimation against the truth, and the doctor's hits and misses.

python tests/benchmarks/light_knowledge.py board-free | doctor [frames a fault]
"""

import sys
from collections import Counter

import _tests_path  # noqa: F401 - puts support on the path
import cv2
import numpy as np
from support.single_faults import FAULTS, diagnosed, diagnosed_as_known, photographed

from pipeline import Decoder, DecodeSettings
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, WHITE, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime

SCENES = ("bust", "plane", "waves", "objects", "ball")


def error(frame, truth):
    """RMS of the phase error, rad, 4 px inside the rim, one constant removed; and the constant."""
    inside = cv2.erode((frame.mask & truth.mask).astype(np.uint8), np.ones((9, 9))) > 0
    turned = np.exp(1j * (frame.wrapped_phase - truth.phase)[inside])
    constant = np.angle(turned.mean())
    return float(np.sqrt((np.angle(turned * np.exp(-1j * constant)) ** 2).mean())), float(constant)


def drop(scene, gamma, matrix, reflectance, seed):
    """Return what share of the drop that the truth gives a frame's own estimate gives, and its constant if known."""
    chosen = {"scene": scene, "gamma": gamma, "crosstalk_matrix": matrix, "reflectance": reflectance, "seed": seed}
    truth = simulate_frame(simulated_rig(), SimulationSettings(**chosen))
    pattern = truth.rig.geometry().pattern.model_copy(update={"compensated": False})
    response = np.tile(np.linspace(0, 1, 256) ** gamma, (3, 1))
    known = truth.rig.model_copy(update={"crosstalk_matrix": matrix, "response": response, "pattern": pattern})
    plain = DecodeSettings(equalize=False)
    alone, _ = error(Decoder(DecodeSettings(equalize=False, crosstalk_matrix=np.eye(3))).decode(truth.image), truth)
    best, _ = error(Decoder(plain, known).decode(truth.image), truth)
    frame = Decoder(plain).decode(truth.image)
    own, constant = error(frame, truth)
    return (alone - own) / (alone - best), abs(constant) if frame.constant_known else 0.0


def study_board_free():
    """Print the least and the median share over two sets of rigs."""
    rng = np.random.default_rng(1)
    usual = [
        (scene, gamma, np.array(TYPICAL_CROSSTALK), color, 0)
        for scene in SCENES for color in (SKIN, WHITE) for gamma in (1.0, 1.2, 1.6, 2.4)
    ]  # fmt: skip
    others = []
    for k in range(24):
        matrix = np.eye(3) + rng.uniform(0, 0.2, (3, 3)) * (1 - np.eye(3))
        others.append((SCENES[k % 5], (1.0, 1.4, 1.8, 2.2)[k % 4], matrix, (SKIN, WHITE)[k % 2], k))
    for name, cases in (("usual crosstalk", usual), ("random crosstalk to 0.2", others)):
        shares, constants = zip(*(drop(*case) for case in cases), strict=True)
        print(f"{name}: {len(cases)} frames, least {min(shares):.3f}, median {np.median(shares):.3f}, "
              f"constant where known up to {max(constants):.3f} rad", flush=True)  # fmt: skip


def study_doctor(count):
    """Print how often each fault is named alone, or in a set of what cannot be told apart."""
    cases = [*FAULTS, ("clipping", {"exposure": 1.4}), (None, {})]
    for cause, fault in cases:
        right, answers = 0, Counter()
        for seed in range(count):
            scene = ("plane", "ball", "waves", "bust")[(seed + seed // 4) % 4]
            found = diagnosed(*photographed(scene, seed, **fault))
            names = [finding.causes for finding in found.findings]
            right += names == [] if cause is None else len(names) == 1 and cause in names[0]
            answers[str(names)] += 1
        shown = {
            key: value.round(2).tolist() if isinstance(value, np.ndarray) else value for key, value in fault.items()
        }
        print(f"{right}/{count} {cause} {shown}: {dict(answers) if right < count else ''}", flush=True)
    study_known_light(count)


def study_known_light(count):
    """Print how often a clean frame under the coded pattern, whose rig's light is known, has no finding."""
    for compensated in (True, False):
        for blur_px in (0.0, 0.6):
            answers = Counter()
            for seed in range(count):
                scene = ("plane", "ball", "waves", "bust")[(seed + seed // 4) % 4]
                blur = (blur_px,) * 3
                found = diagnosed_as_known(scene, seed, compensated=compensated, projector_blur_px=blur)
                answers[str([(finding.causes, finding.size) for finding in found.findings])] += 1
            pattern = "compensated" if compensated else "coded in plain sinusoids"
            shown = dict(answers) if answers["[]"] < count else ""
            print(f"{answers['[]']}/{count} clean, response known, {pattern}, blur {blur_px} px: {shown}", flush=True)


if __name__ == "__main__":
    runtime.init("cpu")
    if sys.argv[1:2] == ["doctor"]:
        study_doctor(int(sys.argv[2]) if len(sys.argv) > 2 else 20)
    else:
        study_board_free()
