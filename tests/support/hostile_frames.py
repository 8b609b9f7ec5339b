"""Frames and settings that no camera and no user means, and whether their results are sane."""

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
from support.file_samples import REFUSED

from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.decoding.frame import DecodedFrame
from pipeline.errors import CalibrationError, DecodeWarning
from pipeline.models import build
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels.errors import Error

DECODED = "decoded"
_SIZES = ((1, 1), (1, 300), (16, 16), (17, 23), (48, 64), (64, 48), (16, 700), (700, 16), (96, 128), (33, 250))
_EXTREMES = (0.0, 1e-30, 1e-6, 1.0, 37.0, 255.0, 65535.0, 2.0**24, 1e9)


def hostile_frame(rng: np.random.Generator) -> npt.NDArray[Any]:
    """Return levels of any type and kind."""
    height, width = _SIZES[rng.integers(len(_SIZES))]
    y, x = np.mgrid[:height, :width]
    kind = rng.integers(9)
    if kind == 0:
        light = rng.random((height, width, 3))
    elif kind == 1:
        light = np.full((height, width, 3), rng.choice([0, 1e-6, 0.5, 1]))
    elif kind == 2:
        light = np.stack([y / height, x / width, (x + y) / (height + width)], axis=-1)
    elif kind == 3:
        light = np.repeat(((y // rng.integers(1, 9) + x // rng.integers(1, 9)) % 2)[..., None], 3, axis=2)
    elif kind == 4:  # a fringe of any period, tilt and contrast, saturated or dark
        phase = 2 * np.pi * (y + rng.normal() * x) / rng.uniform(2, 100)
        shifts = np.array([-1, 0, 1]) * rng.choice([2 * np.pi / 3, 0, np.pi])
        light = rng.uniform(0, 1.5) * (0.5 + rng.uniform(0, 1) * np.cos(phase[..., None] + shifts))
    elif kind == 5:
        light = (rng.random((height, width, 3)) < 0.01).astype(float)
    else:
        rig = simulated_rig((64, 48), period_px=8 * 768 / 44)
        light = simulate_frame(rig, SimulationSettings(seed=int(rng.integers(4)))).image / 255
        for _ in range(rng.integers(0, 4)):
            place, size = rng.integers(0, 48, 2), rng.integers(1, 30, 2)
            patch = light[place[0] : place[0] + size[0], place[1] : place[1] + size[1]]
            patch[...] = rng.choice([0, 1]) if rng.random() < 0.5 else rng.random(patch.shape)
        light = light[:: rng.choice([1, -1]), :, rng.permutation(3)]
    light = np.clip(light, 0, 1)
    dtype = str(rng.choice(["uint8", "uint16", "float32", "float64", "int32", "bool"], p=[0.4, 0.2, 0.34, *3 * [0.02]]))
    if dtype.startswith("uint"):
        return (light * np.iinfo(dtype).max).astype(dtype)
    image = light.astype(dtype)
    if dtype == "float32" and rng.random() < 0.3:
        spoilt = rng.random(image.shape) < rng.choice([1e-4, 0.1, 1])
        image[spoilt] = rng.choice([np.nan, np.inf, -np.inf, -1, 1e30, -0.0, 1e-45])
    return image[..., : rng.choice([1, 2, 3, 4], p=[0.02, 0.02, 0.94, 0.02])]


def hostile_settings(rng: np.random.Generator) -> dict[str, Any]:
    """Return values of settings, most of them at the ends of what is allowed, or beyond."""

    def extreme() -> float:
        return float(_EXTREMES[rng.integers(len(_EXTREMES))]) if rng.random() < 0.5 else float(10 ** rng.uniform(-6, 7))

    choices: dict[str, Any] = {
        "camera_period_px": lambda: float(rng.choice([4, 12, 50, 1e3, 1e4, 1e5])),
        "stripes": lambda: str(rng.choice(["horizontal", "vertical"])),
        "crosstalk_matrix": lambda: (np.eye(3) * extreme() + rng.random((3, 3)) * rng.choice([0, 0.2, 1])).tolist(),
        "reflectance_bands": lambda: str(rng.choice(["broad", "narrow"])),
        "transfer": lambda: str(rng.choice(["linear", "srgb", "bt709"])),
        "equalize": lambda: bool(rng.integers(2)),
        "smoothing_px": lambda: int(rng.choice([0, 1, 3, 7, 15])),
        "code": lambda: "contrast",
        "fields": lambda: {"cycle_s": extreme()},
        "frame_s": extreme,
        "row_s": extreme,
        "noise": lambda: [extreme(), extreme()],
        "white_level": extreme,
        "min_intensity": extreme,
        "min_modulation": extreme,
    }
    return {name: make() for name, make in choices.items() if rng.random() < 0.15}


def hostile_calibration(rng: np.random.Generator, size_px: tuple[int, int]) -> dict[str, Any]:
    """Return a calibration for frames of a size, some of its numbers at the ends of what is allowed."""
    rig = simulated_rig(size_px, period_px=8 * 768 / 44).model_dump(mode="json")
    rig["depth_range_mm"] = [500.0, 1500.0]
    for _ in range(rng.integers(0, 4)):
        part = rig if rng.random() < 0.3 else rig[str(rng.choice(["camera", "projector", "pattern"]))]
        name = str(rng.choice(list(part)))
        values = part[name]
        if isinstance(values, int | float):
            part[name] = values * 10 ** rng.uniform(-9, 9)
        elif isinstance(values, list) and name != "size_px":
            row = int(rng.integers(len(values)))
            if isinstance(values[row], list):
                column = int(rng.integers(len(values[row])))
                values[row][column] = float(values[row][column] * 10 ** rng.uniform(-9, 9))
            else:
                values[row] = float((values[row] or 1) * rng.choice([1, -1]) * 10 ** rng.uniform(-9, 9))
    return rig


def decode_hostile(rng: np.random.Generator) -> str:
    """Decode a frame, twice, the second time with the first one before it; return what became of it.

    Raises
    ------
    Exception
        Anything but the project's own errors; AssertionError: a result is not sane.
    """
    image = hostile_frame(rng)
    try:
        settings = DecodeSettings(**hostile_settings(rng))
        calibration = None
        if rng.random() < 0.3:
            calibration = build(Calibration, hostile_calibration(rng, image.shape[1::-1]), CalibrationError, "rig")
        decoder = Decoder(settings, calibration, arch="cpu")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DecodeWarning)
            before = decoder.decode(image)
            check_sane(before)
            check_sane(decoder.decode(image, previous=before))
    except Error as error:
        if "\n" in str(error):
            raise AssertionError(f"{error} is not one line") from error
        return REFUSED
    return DECODED


def check_sane(frame: DecodedFrame) -> None:
    """Check what every result promises, whatever the frame was."""
    mask = frame.mask
    for name in ("wrapped_phase", "unwrapped_phase", "modulation", "phase_sigma"):
        values = getattr(frame, name)[mask]
        assert np.isfinite(values).all(), f"{name} is not finite in {(~np.isfinite(values)).sum()} pixels of the mask"
    assert (frame.phase_sigma[mask] > 0).all(), "phase_sigma is not positive"
    probability = frame.order_error_probability[mask & frame.absolute]
    assert ((probability >= 0) & (probability <= 1)).all(), "order_error_probability is none"
    assert (frame.region[mask] > 0).all() and (frame.region[~mask] == 0).all(), "regions are not those of the mask"
    assert np.isnan(frame.unwrapped_phase[~mask]).all(), "there are phases off the mask"
    assert not (frame.absolute & ~mask).any(), "orders are absolute off the mask"
    turns = (frame.unwrapped_phase[mask] - frame.wrapped_phase[mask]) / (2 * np.pi)
    # A float32 of a large phase is sure to some parts in ten million of it.
    slack = 1e-3 + 1e-6 * np.abs(turns)
    assert (np.abs(turns - frame.fringe_order[mask]) <= slack).all(), "unwrapped phases are not wrapped ones and orders"
