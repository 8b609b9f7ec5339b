"""The lens against OpenCV's own projection."""

import cv2
import numpy as np
import pytest

from tikernels._taichi import F32Array1, F32Array2, ti, vec21
from tikernels.depth.lens_distortion import LENS_NUMBERS, distorted, pack_lens


@ti.kernel
def distort_kernel(
    rays: F32Array2,  # (N, 2) x, y at unit depth
    lens: F32Array1,  # (21,)
    out: F32Array2,  # (N, 2)
):
    for i in range(rays.shape[0]):
        bent = distorted(rays[i, 0], rays[i, 1], vec21([lens[j] for j in range(LENS_NUMBERS)]))
        out[i, 0] = bent.x
        out[i, 1] = bent.y


@pytest.mark.parametrize(
    "lens",
    [
        (0, 0, 0, 0),
        (-0.1, 0.05, 0.001, -0.002, 0.01),
        (0.2, 0, 0, 0.03, 0),
        (12.1, 40.2, 0.001, -0.002, 3.5, 12.2, 41.5, 5.1),  # rational: large numbers that nearly cancel
        (-0.1, 0.05, 0.001, -0.002, 0.01, 0, 0, 0, 0.02, -0.03, 0.01, 0.05),  # thin prism
        (0.3, -0.2, 0.001, 0.002, 0.1, 0.4, -0.1, 0.1, 0.02, -0.01, 0.01, 0.03, 0.08, -0.05),  # tilted
    ],
)
def test_as_opencv(arch, lens):
    """1e-6 of unit depth is a thousandth of a pixel at 1,000 px focal length."""
    rays = (np.random.default_rng(1).random((50, 2)) - 0.5).astype(np.float32)
    found = np.empty_like(rays)
    distort_kernel(rays, pack_lens(np.array(lens)).astype(np.float32), found)
    points = np.column_stack([rays, np.ones(50)])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(lens, np.float64))
    np.testing.assert_allclose(found, expected[:, 0], atol=1e-6)
