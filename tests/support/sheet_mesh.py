"""A mesh that several formats are tested with."""

import numpy as np
import pytest

from pipeline.output.mesh import Mesh


@pytest.fixture
def mesh() -> Mesh:
    """Return a bumpy 5 x 4 sheet some 700 mm before the camera."""
    rng = np.random.default_rng(3)
    row, column = np.mgrid[:4, :5]
    vertices = np.stack([column * 2.5, row * 2.0, 700 + rng.normal(0, 1, row.shape)], axis=-1).reshape(-1, 3)
    first = (row * 5 + column)[:-1, :-1].ravel()
    faces = np.concatenate([first[:, None] + (0, 5, 1), first[:, None] + (1, 5, 6)])
    return Mesh(
        vertices.astype(np.float32),
        faces.astype(np.int32),
        colors=rng.integers(0, 256, (20, 3), np.uint8),
        properties={name: rng.random(20, np.float32) for name in ("sigma_mm", "modulation")},
        normals=np.tile(np.array([0.6, 0.0, -0.8], np.float32), (20, 1)),
        flags=rng.integers(0, 4, 20, np.uint8),
    )
