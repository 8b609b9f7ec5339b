"""Frames of a rig with a single fault, by which the ripple doctor is judged, and what it says of them."""

from typing import Any

import numpy as np

from pipeline import Decoder, DecodeSettings
from pipeline.diagnosis.channel_spectra import KnownLight
from pipeline.diagnosis.ripple import diagnose
from pipeline.pattern import make_pattern
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, WHITE, SimulationSettings, simulate_frame, simulated_rig

MIXING = np.array(TYPICAL_CROSSTALK)
RESPONSE = np.tile(np.linspace(0, 1, 256) ** 2.0, (3, 1))
HALF_MIXING = np.diag(np.diag(MIXING)) + (MIXING - np.diag(np.diag(MIXING))) / 2


def shifted(px):
    return np.array([[0, -px], [0, 0], [0, px]])


def photographed(scene, seed, *, size_px=(640, 480), modulation=None, offset=None, gain=None, **settings):
    """Return a frame of a rig without faults but those that are named, and full scale; its fringes have 12 px."""
    rig = simulated_rig(size_px, period_px=640 / size_px[0] * 768 / 44, tilt_deg=(-12.0, 0.0, 9.0)[seed % 3])
    chosen = {"gamma": 1.0, "crosstalk_matrix": np.eye(3), "reflectance": (SKIN, WHITE)[seed % 2], "seed": seed}
    codes = None
    if modulation is not None:
        geometry = rig.geometry()
        plain = make_pattern(geometry.projector.size_px, geometry.pattern)
        codes = (0.5 + (plain - 0.5) * np.array(modulation)).astype(np.float32)
    if offset is not None or gain is not None:
        chosen.update(noise_levels=0.0, bits=16)
    truth = simulate_frame(rig, SimulationSettings(**{**chosen, "scene": scene, **settings}), codes=codes)
    if offset is None and gain is None:
        return truth.image, truth.white_level
    light = 0.9 * truth.image / truth.white_level * np.array(gain or (1, 1, 1)) + np.array(offset or (0, 0, 0))
    light += 1.5 / 255 * np.random.default_rng(seed).standard_normal(light.shape)
    return np.rint(255 * np.clip(light, 0, 1)).astype(np.uint8), 255


def diagnosed(image, white_level):
    settings = DecodeSettings(equalize=False, crosstalk_matrix=np.eye(3))
    frame = Decoder(settings, arch="cpu").decode(image)
    return diagnose(image, white_level, frame.unwrapped_phase, frame.mask)


def diagnosed_as_known(scene, seed, *, compensated, size_px=(640, 480), known=None, code="contrast", **settings):
    """Return what is said of a frame under a coded pattern, whose rig is known; `known` is what is known wrongly."""
    period_px = 640 / size_px[0] * 768 / 44
    rig = simulated_rig(size_px, period_px=period_px, tilt_deg=(-12.0, 0.0, 9.0)[seed % 3], code=code)
    geometry = rig.geometry()
    codes = make_pattern(geometry.projector.size_px, geometry.pattern, RESPONSE if compensated else None)
    codes = (np.rint(255 * codes) / 255).astype(np.float32)
    chosen = {"scene": scene, "gamma": 2.0, "reflectance": (SKIN, WHITE)[seed % 2], "seed": seed, **settings}
    truth = simulate_frame(rig, SimulationSettings(**chosen), codes)
    pattern = geometry.pattern.model_copy(update={"compensated": compensated})
    light = {"crosstalk_matrix": MIXING, "response": RESPONSE, "pattern": pattern, **(known or {})}
    calibration = rig.model_copy(update=light)
    frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(truth.image)
    undone = KnownLight.of(DecodeSettings(), calibration, calibration.pattern.code)
    return diagnose(truth.image, 255, frame.unwrapped_phase, frame.mask, undone, "linear", frame.absolute)


#: Each fault at its usual size and at half of it: the cause that must be named, and what `photographed` takes.
FAULTS: list[tuple[str, dict[str, Any]]] = [
    ("crosstalk", {"crosstalk_matrix": MIXING}),
    ("crosstalk", {"crosstalk_matrix": HALF_MIXING}),
    ("response", {"gamma": 2.0}),
    ("response", {"gamma": 1.4}),
    ("transfer", {"transfer": "srgb"}),
    ("black level", {"offset": (0.05, 0.0, 0.0)}),
    ("black level", {"offset": (0.0, 0.0, 0.025)}),
    ("projector amplitude", {"modulation": (1.0, 0.8, 1.0)}),
    ("projector amplitude", {"modulation": (1.0, 0.9, 1.0)}),
    ("lateral colour of the camera", {"camera_shift_px": shifted(0.5)}),
    ("lateral colour of the camera", {"camera_shift_px": shifted(0.25)}),
    ("lateral colour of the projector", {"projector_shift_px": shifted(0.7)}),
    ("motion between colour fields", {"field_motion_mm": (0.0, 0.0, 0.7)}),
    ("motion between colour fields", {"field_motion_mm": (0.0, 0.0, 0.36)}),
    ("camera defocus", {"camera_blur_px": (1.2, 0.0, 0.0)}),
]
