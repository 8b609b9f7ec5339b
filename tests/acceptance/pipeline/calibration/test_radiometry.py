"""Ramps in, response and crosstalk out: against the truth of a simulated rig, and what captures are refused."""

import numpy as np

from pipeline import Decoder, DecodeSettings
from pipeline.calibration.radiometry import (
    measure_radiometry,
    radiometry_codes,
    radiometry_sequence,
)
from pipeline.pattern import make_pattern
from pipeline.simulation import WHITE, SimulationSettings, simulate_frame, simulated_rig

SEQUENCE = radiometry_sequence((1024, 768))


def test_the_compensated_pattern_leaves_no_ripple(cpu):
    """Light that is sinusoidal needs no equalisation: 0.030 rad is noise, smoothed."""
    rig = simulated_rig()
    settings = SimulationSettings(scene="plane")
    captures = {}
    for seed, name in enumerate(SEQUENCE.names):
        flat = np.broadcast_to(radiometry_codes(name), (768, 1024, 3)).astype(np.float32)
        white = settings.model_copy(update={"reflectance": WHITE, "texture": 0.0, "seed": seed, "exposure": 0.9})
        captures[name] = simulate_frame(simulated_rig((96, 72)), white, codes=np.ascontiguousarray(flat)).image
    calibration = measure_radiometry(captures).add_to(rig)
    codes = np.rint(255 * make_pattern((1024, 768), rig.geometry().pattern, calibration.response)) / 255
    frames = {
        True: simulate_frame(rig, settings, codes=codes.astype(np.float32)),
        False: simulate_frame(rig, settings),  # a response that the pattern has not undone is undone in decoding
    }
    for compensated, truth in frames.items():
        for known in (None, compensated):  # what the pattern does not say, the frame tells
            pattern = rig.geometry().pattern.model_copy(update={"compensated": known})
            decoder = Decoder(
                DecodeSettings(equalize=False), calibration.model_copy(update={"pattern": pattern}), arch="cpu"
            )
            frame = decoder.decode(truth.image)
            inside = frame.mask[8:-8, 8:-8]
            error = np.exp(1j * (frame.wrapped_phase - truth.phase)[8:-8, 8:-8][inside])
            ripple = np.angle(error / error.mean())
            assert abs(np.angle(error.mean())) < 0.005
            assert np.sqrt((ripple**2).mean()) < 0.025, (compensated, known)
            third = 2 * abs((ripple * np.exp(-3j * truth.phase[8:-8, 8:-8][inside])).mean())
            assert third < 0.005
