"""Depth errors that a calibration's own uncertainty foretells, beside those that there are."""

import numpy as np
from support.posed_boards import CAMERA_PX, PATTERN, PROJECTOR_PX, exact_poses, rig

from pipeline.calibration.rig_geometry import solve_geometry
from tikernels.depth.triangulation import triangulate


def test_the_depth_bias_is_what_was_foretold(cpu):
    """Over eight noisy rigs the RMS error of depth on a plane 900 mm away is the predicted one, within a third."""
    truth = rig().geometry()
    rays = truth.camera.rays()[48:432:48, 64:576:64]
    points = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1).astype(np.float64) * 900
    phase = 2 * np.pi * truth.pattern_cycles(points.reshape(-1, 3)).reshape(rays.shape[:2])
    squared = []
    for seed in range(8):
        found = solve_geometry(exact_poses(10, seed=seed), CAMERA_PX, PROJECTOR_PX, PATTERN).calibration
        geometry = found.geometry()
        seen = geometry.camera.rays()[48:432:48, 64:576:64]
        depth = triangulate(phase.astype(np.float32), np.ascontiguousarray(seen), geometry.for_triangulation())[..., 2]
        squared.append(((depth - 900) ** 2).mean() / found.uncertainty.depth_bias_mm**2)
    assert 0.66 < np.sqrt(np.mean(squared)) < 1.5
