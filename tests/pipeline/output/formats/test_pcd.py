"""Grids as PCD: the header, and what follows it."""

from dataclasses import replace

import numpy as np
from support.tilted_sheets import HEIGHT, WIDTH, tilted_grid

from pipeline.output.formats.file_text import Heading
from pipeline.output.formats.pcd import encode_pcd


def test_the_grid_is_kept_row_by_row():
    grid = tilted_grid()
    content = encode_pcd(grid, Heading("g", {"unit": "m"}))[".pcd"]
    head, _, body = content.partition(b"DATA binary\n")
    assert head.decode().splitlines()[1:] == [
        "# unit m",
        "VERSION 0.7",
        "FIELDS x y z rgb sigma_mm",
        "SIZE 4 4 4 4 4",
        "TYPE F F F F F",
        "COUNT 1 1 1 1 1",
        f"WIDTH {WIDTH}",
        f"HEIGHT {HEIGHT}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {WIDTH * HEIGHT}",
    ]
    values = np.frombuffer(body, "<f4").reshape(HEIGHT, WIDTH, 5)
    np.testing.assert_allclose(values[..., :3], grid.points / 1000, rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(values[..., 2]), np.isnan(grid.depth))


def test_without_a_texture_there_is_no_color():
    head = encode_pcd(replace(tilted_grid(), texture=None, properties={}), Heading("g", {}))[".pcd"]
    assert b"FIELDS x y z\n" in head
