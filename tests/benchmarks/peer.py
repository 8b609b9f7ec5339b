"""The same chain out of OpenCV, NumPy and scikit-image: what a user would write without us."""

import cv2
import numpy as np
import numpy.typing as npt
from skimage.restoration import unwrap_phase


def decode(
    image: npt.NDArray[np.uint8], crosstalk_matrix: npt.NDArray[np.float64], period_px: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return unwrapped phase (rad, NaN outside) and mask of an 8-bit frame with horizontal stripes."""
    light = image.astype(np.float32) / 255
    matrix = crosstalk_matrix / crosstalk_matrix.sum(axis=1, keepdims=True)
    window = {"ksize": (0, 0), "sigmaX": period_px, "sigmaY": 0.85 * period_px}
    mean = cv2.GaussianBlur(light, **window)
    balanced = cv2.transform(light / np.maximum(mean, 1e-3), np.linalg.inv(matrix).astype(np.float32))
    red, green, blue = cv2.split(balanced)
    y, x = np.float32(3**0.5) * (red - blue), 2 * green - red - blue
    phase = cv2.phase(x, y)
    phase -= np.where(phase > np.pi, np.float32(2 * np.pi), np.float32(0))
    modulation = cv2.magnitude(x, y) * (mean.mean(axis=2) / 3)
    mask = (modulation > 6 / 255) & (light.mean(axis=2) > 0.02)
    counts, edges = np.histogram(phase[mask][::2], 256, (-np.pi, np.pi))
    correction = 2 * np.pi * np.concatenate([[0], np.cumsum(counts)]) / max(counts.sum(), 1) - np.pi - edges
    phase = phase + np.interp(phase, edges, correction - correction.mean()).astype(np.float32)
    cosine, sine = cv2.blur(np.cos(phase), (5, 1)), cv2.blur(np.sin(phase), (5, 1))
    phase = np.arctan2(sine, cosine)
    unwrapped = unwrap_phase(np.ma.masked_array(phase, mask=~mask)).filled(np.nan)
    return unwrapped.astype(np.float32), mask
