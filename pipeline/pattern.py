"""The picture that the projector shows: three sinusoids, a third of a cycle apart, in red, green and blue, and a code.

The code (`contrast_code.py`) is the contrast. Every cycle is as bright as the projector can be where it is brightest,
so that less contrast costs as little modulation as possible: the background is 1 - modulation. Both go in straight
lines from the middle of one cycle to the middle of the next. Their spectra then have a double zero at one per cycle, so
the code hardly leaks into the balance of the channels, which shows the surface's colour; and there is no edge that blur
could soften. `docs/coded_pattern.md` derives it.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration import Pattern
from pipeline.contrast_code import CYCLES, ContrastCode
from pipeline.errors import OutputError, SettingsError
from pipeline.files import write_atomically

#: Phase of R, G and B relative to the pattern's, rad.
CHANNEL_PHASES = (-2 * np.pi / 3, 0.0, 2 * np.pi / 3)


def make_pattern(
    size_px: tuple[int, int],
    pattern: Pattern,
    response: npt.NDArray[np.float64] | None = None,
    brightness: float = 1.0,
) -> npt.NDArray[np.float32]:
    """Return the pattern's projector codes.

    Parameters
    ----------
    size_px : (width, height)
        The projector's size in px.
    pattern : Pattern
        Its period, the direction of its stripes, and its code.
    response : (3, N) float64, optional
        Light of N evenly spaced codes of R, G, B, rising from 0 to 1. With it the light, not the codes, is sinusoidal.
    brightness : float
        Fraction of the full light, above 0 to 1; without a response, of the codes.

    Returns
    -------
    (height, width, 3) float32
        Codes of R, G, B, 0..1. The phase is zero, and green brightest, at the centre of the first row (or column).

    Raises
    ------
    SettingsError
        The size is not positive, or holds less than one cycle, or more of them than the code distinguishes; or the
        brightness is not above 0 and at most 1.
    """
    if not 0 < brightness <= 1:
        raise SettingsError(f"a brightness of {brightness:g}: give more than 0 and at most 1, as in 0.85")
    width, height = size_px
    length = height if pattern.stripes == "horizontal" else width
    if width < 1 or height < 1 or pattern.period_px > length:
        raise SettingsError(f"a pattern of {width}x{height} px cannot hold a cycle of {pattern.period_px} px")
    cycles = np.arange(length) / pattern.period_px
    modulation = np.full((length, 1), 0.5)
    code = ContrastCode.of(pattern)
    if code is not None:
        if length > CYCLES * pattern.period_px:
            raise SettingsError(
                f"the code distinguishes {CYCLES} cycles, but {length} px hold {length / pattern.period_px:.0f} of "
                f"{pattern.period_px:g} px: take a period of {length / CYCLES:.3g} px or more, or no code"
            )
        along = 1 if code.cell_px is None else width + height - length
        modulation = code.modulation(cycles[:, None], np.arange(along))
    wave = np.cos(2 * np.pi * cycles[:, None] + np.array(CHANNEL_PHASES))
    codes = brightness * (1 - modulation[..., None] * (1 - wave[:, None]))
    if response is not None:
        # Every response rises from 0 to 1, so the whole range of light is there to be used.
        codes = np.stack([codes_for_light(codes[..., j], response[j]) for j in range(3)], axis=-1)
    codes = codes.astype(np.float32)
    rows = codes if pattern.stripes == "horizontal" else codes.swapaxes(0, 1)
    return np.ascontiguousarray(np.broadcast_to(rows, (height, width, 3)))


def codes_for_light(light: npt.NDArray[np.float64], response: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the codes, 0..1, by which a projector of this response makes the wanted light, 0..1."""
    codes = np.linspace(0, 1, len(response))
    rising = np.concatenate([[True], np.diff(response) > 0])  # where it is flat, the smallest code does
    return np.asarray(np.interp(light, response[rising], codes[rising]))


def write_pattern(
    path: str | Path,
    size_px: tuple[int, int],
    pattern: Pattern,
    response: npt.NDArray[np.float64] | None = None,
    brightness: float = 1.0,
) -> None:
    """Write the pattern as an 8-bit PNG, and next to it, as JSON, what a calibration stores of it.

    Parameters
    ----------
    path : str or Path
        The PNG; the JSON has the same name.
    size_px, pattern, response, brightness
        See `make_pattern`.

    Raises
    ------
    OutputError
        The name does not end in .png, or the place cannot be written.
    SettingsError
        The size cannot hold the pattern, or there is no such brightness.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise OutputError(f"a pattern is written as PNG, not as {path.suffix or 'a name without suffix'}: name it .png")
    codes = np.rint(make_pattern(size_px, pattern, response, brightness) * 255).astype(np.uint8)
    write_atomically(path, cv2.imencode(".png", codes[..., ::-1])[1].tobytes())
    described = pattern.model_dump(exclude={"compensated"})
    if response is not None:
        described["compensated"] = True
    write_atomically(path.with_suffix(".json"), (json.dumps(described) + "\n").encode())
