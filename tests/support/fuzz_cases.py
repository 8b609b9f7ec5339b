"""Cases of fuzzing by name and seed: damaged files, hostile frames, instruments that answer nonsense."""

from pathlib import Path
from typing import Any

import numpy as np
from support.file_samples import OTHERWISE, SAMPLES, Reading, damage_sample, outcome
from support.hostile_frames import decode_hostile
from support.hostile_instruments import INSTRUMENTS, talk

import tikernels

FRAMES = "frames"
_whole: dict[str, Reading] = {}


def start(kinds: list[str], samples: Path) -> None:
    """Get ready: read what is whole, and compile what decodes."""
    for kind in kinds:
        if kind in SAMPLES:
            _whole[kind] = SAMPLES[kind].read(samples / kind)
    if FRAMES in kinds:
        tikernels.init("cpu")
        for seed in range(30):
            decode_hostile(np.random.default_rng(seed))


def run_case(kind: str, seed: int, samples: Path, folder: Path) -> dict[str, Any]:
    """Go through one case; raises whatever a reader should not raise."""
    rng = np.random.default_rng(seed)
    if kind == FRAMES:
        return {"outcome": decode_hostile(rng)}
    if kind in INSTRUMENTS:
        return {"outcome": talk(kind, rng)}
    sample = SAMPLES[kind]
    intent = damage_sample(sample, samples / kind, folder / kind, rng)
    became = outcome(sample, folder / kind, _whole[kind])
    return {"outcome": became, "unnoticed": became == OTHERWISE and sample.checked and not intent}
