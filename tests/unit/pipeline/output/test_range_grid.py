"""A frame's places in the camera's grid."""

import numpy as np
import pytest
from support.tilted_sheets import BLUE, HEIGHT, RED, WIDTH, tilted_grid

from pipeline.output.mesh import RangeGrid


def test_records_are_in_metres_with_packed_colors():
    records = tilted_grid().records()
    assert records.shape == (HEIGHT, WIDTH) and records.dtype.names == ("x", "y", "z", "rgb", "sigma_mm")
    np.testing.assert_allclose(records["z"], tilted_grid().depth / 1000, rtol=1e-6)
    packed = np.ascontiguousarray(records["rgb"]).view(np.uint32)
    assert packed[0, 0] == RED[0] << 16 | RED[1] << 8 | RED[2]
    assert packed[-1, 0] == BLUE[0] << 16 | BLUE[1] << 8 | BLUE[2]


def test_records_of_others_become_a_grid_again():
    """Of numbers of any kind, in any order, with gaps; what lies behind the camera, or nowhere, is none."""
    grid = tilted_grid()
    layout = np.dtype(
        {
            "names": ["intensity", "z", "y", "x", "rgba", "_"],
            "formats": ["u1", ">f8", ">f8", ">f8", "<u4", "u1"],
            "offsets": [0, 8, 16, 24, 40, 3],
            "itemsize": 48,
        }
    )
    records = np.zeros((HEIGHT, WIDTH), layout)
    for axis, name in enumerate("xyz"):
        records[name] = grid.points[..., axis] / 1000.0
    records["intensity"], records["rgba"] = 7, 0xFF000000 | RED[0] << 16 | RED[1] << 8 | RED[2]
    records["z"][0, 0], records["x"][0, 1] = -0.5, np.inf
    read = RangeGrid.of_records(records)
    expected = grid.points.copy()
    expected[0, :2] = np.nan
    np.testing.assert_allclose(read.points, expected, rtol=1e-6)
    assert (read.texture == RED).all() and read.properties.keys() == {"intensity"}
    assert (read.properties["intensity"] == 7).all()
    for wrong in (records[:1], records[["x", "y", "rgba"]]):
        with pytest.raises(ValueError, match=r"points are no grid|no x, y and z"):
            RangeGrid.of_records(wrong)
