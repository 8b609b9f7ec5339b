"""A frame's places in the camera's grid."""

import numpy as np
from support.tilted_sheets import BLUE, HEIGHT, RED, WIDTH, tilted_grid


def test_records_are_in_metres_with_packed_colors():
    records = tilted_grid().records()
    assert records.shape == (HEIGHT, WIDTH) and records.dtype.names == ("x", "y", "z", "rgb", "sigma_mm")
    np.testing.assert_allclose(records["z"], tilted_grid().depth / 1000, rtol=1e-6)
    packed = np.ascontiguousarray(records["rgb"]).view(np.uint32)
    assert packed[0, 0] == RED[0] << 16 | RED[1] << 8 | RED[2]
    assert packed[-1, 0] == BLUE[0] << 16 | BLUE[1] << 8 | BLUE[2]
