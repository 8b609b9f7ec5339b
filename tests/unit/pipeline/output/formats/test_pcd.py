"""Grids as PCD: the header, what follows it, and back."""

from dataclasses import replace

import numpy as np
import pytest
from support.tilted_sheets import HEIGHT, WIDTH, tilted_grid

from pipeline.output.formats import Heading
from pipeline.output.formats.camera_grids import decode_pcd, encode_pcd


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


def same(read, grid):
    np.testing.assert_allclose(read.points, grid.points, rtol=1e-5)
    np.testing.assert_array_equal(read.properties["sigma_mm"], grid.properties["sigma_mm"])
    np.testing.assert_array_equal(read.texture, grid.texture)


def test_a_grid_comes_back():
    same(decode_pcd(encode_pcd(tilted_grid(), Heading("g", {}))[".pcd"]), tilted_grid())


def test_ascii_is_read():
    grid = tilted_grid()
    whole = encode_pcd(grid, Heading("g", {}))[".pcd"]
    head, _, body = whole.partition(b"DATA binary\n")
    rows = np.frombuffer(body, "<f4").reshape(-1, 5)
    text = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in rows)
    same(decode_pcd(head + b"DATA ascii\n" + text.encode()), grid)


def test_other_types_are_read():
    head = b"VERSION .7\nFIELDS x y z rgba label\nSIZE 8 8 8 4 2\nTYPE F F F U U\nCOUNT 1 1 1 1 1\nWIDTH 2\nHEIGHT 2\n"
    points = np.zeros((2, 2), "f8,f8,f8,u4,u2")
    points["f2"], points["f3"], points["f4"] = [[1, 2], [-1, 3]], 0xFF010203, 7
    read = decode_pcd(head + b"POINTS 4\nDATA binary\n" + points.tobytes())
    np.testing.assert_array_equal(read.depth, [[1000, 2000], [np.nan, 3000]])  # nothing lies behind a camera
    assert (read.texture == (1, 2, 3)).all() and (read.properties["label"] == 7).all()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"DATA binary\n", b"DATA binary_compressed\n", "pcl_convert_pcd_ascii_binary IN OUT 1"),
        (b"\nHEIGHT 24", b"\nHEIGHT 1", "are no grid"),
        (b"\nHEIGHT 24", b"\nHEIGHT 25", "truncated"),
        (b"\nHEIGHT 24", b"\nHEIGHT 999999999", "set COLORPHASE_MAX_PIXELS"),
        (b"\nHEIGHT 24", b"\nHEIGHT -4", "no HEIGHT"),
        (b"FIELDS x y z", b"FIELDS x y q", "no x, y and z"),
        (b"COUNT 1 1", b"COUNT 1 33", "single numbers"),
        (b"TYPE F F", b"TYPE F Q", "no known type"),
        (b"DATA binary\n", b"", "no end"),
    ],
)
def test_what_is_wrong_is_said(old, new, said):
    whole = encode_pcd(tilted_grid(), Heading("g", {}))[".pcd"]
    with pytest.raises(ValueError, match=said):
        decode_pcd(whole.replace(old, new, 1))
