"""The picture that the projector shows: three sinusoids, a third of a cycle apart, in red, green and blue."""

import json
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration import Pattern
from pipeline.errors import OutputError, SettingsError
from pipeline.files import write_atomically

#: Phase of R, G and B relative to the pattern's, rad.
CHANNEL_PHASES = (-2 * np.pi / 3, 0.0, 2 * np.pi / 3)


def make_pattern(size_px: tuple[int, int], pattern: Pattern) -> npt.NDArray[np.float32]:
    """Return the pattern's projector codes.

    Parameters
    ----------
    size_px : (width, height)
        The projector's size in px.
    pattern : Pattern
        Its period and the direction of its stripes.

    Returns
    -------
    (height, width, 3) float32
        Codes of R, G, B, 0..1. The phase is zero, and green brightest, at the centre of the first row (or column).

    Raises
    ------
    SettingsError
        The size is not positive, or holds less than one cycle.
    """
    width, height = size_px
    length = height if pattern.stripes == "horizontal" else width
    if width < 1 or height < 1 or pattern.period_px > length:
        raise SettingsError(f"a pattern of {width}x{height} px cannot hold a cycle of {pattern.period_px} px")
    phase = 2 * np.pi / pattern.period_px * np.arange(length)
    codes = (0.5 + 0.5 * np.cos(phase[:, None] + np.array(CHANNEL_PHASES))).astype(np.float32)
    line = codes[:, None] if pattern.stripes == "horizontal" else codes[None]
    return np.ascontiguousarray(np.broadcast_to(line, (height, width, 3)))


def write_pattern(path: str | Path, size_px: tuple[int, int], pattern: Pattern) -> None:
    """Write the pattern as an 8-bit PNG, and beside it, as JSON, what a calibration stores of it.

    Raises
    ------
    OutputError
        The name does not end in .png, or the place cannot be written.
    SettingsError
        The size cannot hold the pattern.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise OutputError(f"a pattern is written as PNG, not as {path.suffix or 'a name without suffix'}: name it .png")
    codes = np.rint(make_pattern(size_px, pattern) * 255).astype(np.uint8)
    write_atomically(path, cv2.imencode(".png", codes[..., ::-1])[1].tobytes())
    write_atomically(path.with_suffix(".json"), (json.dumps(pattern.model_dump()) + "\n").encode())
