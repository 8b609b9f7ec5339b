"""Possible error of the phase where two surfaces meet.

There a pixel sees both, by the camera's blur, and is decoded as one of them; and where exactly they meet is known to a
pixel or two. Light of surface a that is decoded as b's turns the phase by the effect of T_b^-1 T_a of `surfaces.py`.
"""

import cv2
import numpy as np
import numpy.typing as npt

from tikernels import runtime
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import BINS
from tikernels.phase.phase_vector import channel_waves
from tikernels.phase.surfaces import NO_SURFACE

# Pixels that are this near to another surface, across the stripes and along them, px, are off by half of what they
# would be if they were the other's: a mixture of any share has 0.29, and some are the other's.
_NEAR_PX, _PART = (2, 3), 0.5


def turns_by_confusion(crosstalk: Crosstalk) -> npt.NDArray[np.float64]:
    """Return by how much the phase is off if light of surface a is decoded as b's, (N, N), rad: RMS over a cycle."""
    mixing, unmixing = (table.astype(np.float64) for table in (crosstalk.surfaces.mixing, crosstalk.surfaces.unmixing))
    phase = np.linspace(-np.pi, np.pi, BINS, endpoint=False)
    pixel = np.stack([np.ones(BINS), 0.5 * np.cos(phase), 0.5 * np.sin(phase)])
    neutral = crosstalk.matrix.astype(np.float64) @ channel_waves(crosstalk.lag) @ pixel
    seen = np.einsum("bij,ajk,kp->abip", unmixing, mixing, neutral)
    balanced = seen / seen.mean(axis=3, keepdims=True)
    cosine, sine, _ = np.moveaxis(crosstalk.weights.astype(np.float64) @ balanced, 2, 0)
    off = np.angle((cosine + 1j * sine) * np.exp(-1j * phase))
    return np.asarray(np.sqrt((off**2).mean(axis=2)))


def edge_variance(crosstalk: Crosstalk) -> npt.NDArray[np.float32]:
    """Return the variance of the phase that edges between surfaces make, (H, W) float32, rad^2; 0 elsewhere."""
    labels = runtime.to_host(crosstalk.surfaces.labels)
    window = np.ones([2 * reach + 1 for reach in _NEAR_PX], np.uint8)
    # Of two surfaces around a pixel these are the one and the other; where there are three, two of them.
    first = cv2.erode(labels, window)
    last = cv2.dilate(np.where(labels == NO_SURFACE, 0, labels).astype(np.uint8), window)
    variances = np.zeros((NO_SURFACE + 1, NO_SURFACE + 1), np.float32)
    turns = turns_by_confusion(crosstalk)
    count = len(turns)
    variances[:count, :count] = (_PART * np.maximum(turns, turns.T)) ** 2
    np.fill_diagonal(variances, 0)
    return np.asarray(variances[first, last])
