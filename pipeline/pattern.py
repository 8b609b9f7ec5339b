"""The picture that the projector shows: three sinusoids, a third of a cycle apart, in red, green and blue, and a code.

The contrast of each cycle is one symbol of a sequence that never repeats. Every cycle is as bright as the projector can
be where it is brightest, so that less contrast costs as little modulation as possible: the background is
1 - modulation. Both go in straight lines from the middle of one cycle to the middle of the next. Their spectra then
have a double zero at one per cycle, so the code hardly leaks into the balance of the channels, which shows the
surface's colour; and there is no edge that blur could soften. `docs/coded_pattern.md` derives symbols and sequence.
"""

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration import Pattern
from pipeline.errors import OutputError, SettingsError
from pipeline.files import write_atomically

#: Contrast of the three symbols, modulation over background; a plain pattern's is 1.
CONTRASTS = (0.72, 0.86, 1.0)
#: One digit a cycle, from the projector's first row (or column) on. No two stretches of five cycles change alike.
SYMBOLS = (
    "02110212222212202220002020101200122102022110011202100200012120200212102101210002202120122012011220022120"
    "00021022001002222020211201022210"
)
CYCLES = len(SYMBOLS)
# Responses of which the code's levels are known, the weakest one first.
_GAMMAS = (3.0, 2.6, 2.3, 2.0, 1.8, 1.6, 1.4, 1.2, 1.0, 0.8)
#: Phase of R, G and B relative to the pattern's, rad.
CHANNEL_PHASES = (-2 * np.pi / 3, 0.0, 2 * np.pi / 3)


def cycle_contrasts() -> npt.NDArray[np.float64]:
    """Return the (CYCLES,) contrast in the middle of each cycle."""
    return np.array(CONTRASTS)[[int(symbol) for symbol in SYMBOLS]]


def modulation_at(cycles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the pattern's modulation at a phase in cycles, as a fraction of full scale."""
    contrasts = cycle_contrasts()
    return np.asarray(np.interp(cycles, np.arange(CYCLES), contrasts / (1 + contrasts)))


@cache
def _levels_by_response() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the (R,) strengths of the code by responses of different gamma, rising, and the (R, CYCLES) levels."""
    within = np.linspace(-0.5, 0.5, 129)  # cycles
    weight = (1 - (2 * within) ** 2) ** 2
    projected = modulation_at(np.arange(CYCLES)[:, None] + within)
    # What of the light's own cycle is background and modulation, for every modulation of the codes.
    modulations = np.linspace(projected.min(), projected.max(), 65)
    wave = np.cos(2 * np.pi * np.arange(64) / 64)
    codes = np.maximum(1 - modulations[:, None] * (1 - wave), 0)
    levels = []
    for gamma in _GAMMAS:
        background, modulation = (codes**gamma).mean(axis=1), 2 * (codes**gamma * wave).mean(axis=1)
        seen = [np.interp(projected, modulations, values) @ weight for values in (modulation, background)]
        levels.append(np.log(seen[0] / seen[1]))
    spans = np.ptp(levels, axis=1)
    return spans / np.ptp(levels[_GAMMAS.index(1.0)]), np.array(levels)


def contrast_levels(strength: float = 1.0) -> npt.NDArray[np.float64]:
    """Return the logarithm of each cycle's contrast, as it is read.

    A cycle's contrast is `measure_contrast_kernel`'s, to which its neighbours' symbols contribute 8 % each. In linear
    light the strength is 1. A response that is not linear makes the differences smaller, and more so between the
    symbols of high contrast: the levels are those of the gamma that leaves this strength.

    Parameters
    ----------
    strength : float
        The levels' differences relative to those in linear light; 0: there is no code.

    Returns
    -------
    (CYCLES,) float64
        Natural logarithm.
    """
    strengths, levels = _levels_by_response()
    within = min(max(strength, strengths[0]), strengths[-1])
    row = min(int(np.searchsorted(strengths, within, side="right")) - 1, len(strengths) - 2)
    share = (within - strengths[row]) / (strengths[row + 1] - strengths[row])
    return np.asarray((strength / within) * ((1 - share) * levels[row] + share * levels[row + 1]))


def contrast_steps(strength: float = 1.0) -> npt.NDArray[np.float64]:
    """Return by how much `contrast_levels` rises from each cycle to the next, (CYCLES - 1,) float64."""
    return np.diff(contrast_levels(strength))


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
        How much of the light there is to be, above 0 to 1; without a response, of the codes.

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
    phase = 2 * np.pi / pattern.period_px * np.arange(length)
    modulation: npt.NDArray[np.float64] | float = 0.5
    if pattern.code == "contrast":
        if length > CYCLES * pattern.period_px:
            raise SettingsError(
                f"the code distinguishes {CYCLES} cycles, but {length} px hold {length / pattern.period_px:.0f} of "
                f"{pattern.period_px:g} px: take a period of {length / CYCLES:.3g} px or more, or no code"
            )
        modulation = modulation_at(np.arange(length) / pattern.period_px)[:, None]
    codes = brightness * (1 - modulation + modulation * np.cos(phase[:, None] + np.array(CHANNEL_PHASES)))
    if response is not None:
        # Every response rises from 0 to 1, so the whole range of light is there to be used.
        codes = np.stack([codes_for_light(codes[:, j], response[j]) for j in range(3)], axis=-1)
    codes = codes.astype(np.float32)
    line = codes[:, None] if pattern.stripes == "horizontal" else codes[None]
    return np.ascontiguousarray(np.broadcast_to(line, (height, width, 3)))


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
